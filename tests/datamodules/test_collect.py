from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest

from datamodules import WaypointController, collect_pointmaze, load_trajectories
from datamodules.collect import pointmaze
from datamodules.collect.behaviour import QUIET, PointMazeRecipe
from datamodules.trajectories import DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

LARGE = "pointmaze-large-diverse"


def _arrays(folder: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        file.visititems(lambda name, node: found.update({name: node[()]}) if isinstance(node, h5py.Dataset) else None)
    return found


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2,250 steps: four episodes of 500 and one of 250."""
    return collect_pointmaze(LARGE, 2_250, 7, tmp_path_factory.mktemp("data"), workers=1, progress=False)


@pytest.fixture(scope="module")
def large_play(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("play")
    return collect_pointmaze("pointmaze-large-play", 3_000, 1, root, workers=1, progress=False, action_noise=0.0)


def test_the_same_seed_gives_the_same_bytes_whatever_the_workers(large: Path, tmp_path: Path) -> None:
    two = collect_pointmaze(LARGE, 2_250, 7, tmp_path, workers=2, progress=False)
    first, second = _arrays(large), _arrays(two)
    assert first.keys() == second.keys()
    assert len(first) == 5 * 8
    for name, array in first.items():
        assert array.dtype == second[name].dtype
        assert array.tobytes() == second[name].tobytes(), name
    assert (large / "data" / "main_data.hdf5").read_bytes() == (two / "data" / "main_data.hdf5").read_bytes()


def test_another_seed_gives_other_data(large: Path, tmp_path: Path) -> None:
    other = collect_pointmaze(LARGE, 500, 8, tmp_path, workers=1, progress=False)
    assert not np.array_equal(_arrays(other)["episode_0/actions"], _arrays(large)["episode_0/actions"])


def test_minari_opens_it_and_makes_the_same_environments(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(large.parent))
    data = minari.load_dataset("pointmaze-large-diverse-v0")
    assert (data.total_episodes, data.total_steps) == (5, 2_250)
    assert data.spec.dataset_id == "pointmaze-large-diverse-v0"
    spec = data.spec.env_spec
    assert spec is not None
    assert spec.id == "PointMaze_Large-v3"
    assert spec.max_episode_steps == 500
    assert (spec.kwargs["continuing_task"], spec.kwargs["reset_target"]) == (True, True)
    metadata = data.storage.metadata
    for key in ("author", "algorithm_name", "description", "minari_version", "requirements", "eval_env_spec"):
        assert metadata[key], key
    for number, episode in enumerate(data.iterate_episodes()):
        steps = 250 if number == 4 else 500
        assert len(episode.actions) == len(episode.rewards) == steps
        assert len(episode.observations["observation"]) == len(episode.infos["success"]) == steps + 1
        for t in (0, steps):
            assert data.observation_space.contains({k: v[t] for k, v in episode.observations.items()})
        assert data.action_space.contains(episode.actions[0])
        np.testing.assert_array_equal(episode.truncations, np.arange(steps) == steps - 1)
        assert not episode.terminations.any()
    evaluation = data.recover_environment(eval_env=True)
    observation, _ = evaluation.reset(seed=0)
    task = get_task(LARGE)
    assert tuple(task.xy_to_cell(observation["achieved_goal"])) == task.start_cell
    assert tuple(task.xy_to_cell(observation["desired_goal"])) == task.goal_cell
    assert evaluation.spec is not None
    assert evaluation.spec.max_episode_steps == task.max_episode_steps
    recorded = data.recover_environment()
    assert recorded.spec is not None
    assert recorded.spec.kwargs["continuing_task"] is True
    for env in (evaluation, recorded):
        env.close()
        os.unlink(env.unwrapped.tmp_xml_file_path)  # type: ignore[attr-defined]


def test_rewards_success_and_goals_are_the_environments(large_play: Path) -> None:
    reached = 0
    for number in range(6):
        episode = {k.partition("/")[2]: v for k, v in _arrays(large_play).items() if k.startswith(f"episode_{number}/")}
        places, goals = episode["observations/achieved_goal"], episode["observations/desired_goal"]
        np.testing.assert_array_equal(places, episode["observations/observation"][:, :2])
        near = np.linalg.norm(places - goals, axis=1) <= 0.45
        np.testing.assert_array_equal(episode["infos/success"], near)
        np.testing.assert_array_equal(episode["rewards"], near[1:].astype(float))
        changed = np.any(np.diff(goals, axis=0) != 0, axis=1)
        # A goal is seen once reached; the next state already shows the next one.
        np.testing.assert_array_equal(changed[1:], near[1:-1])
        reached += int(near[1:].sum())
    assert reached > 5


def test_replaying_the_actions_in_the_recovered_environment_gives_the_recorded_states(large: Path) -> None:
    episode = {k: v for k, v in _arrays(large).items() if k.startswith("episode_2/")}
    states, actions = episode["episode_2/observations/observation"], episode["episode_2/actions"]
    env = get_task(LARGE).make_env()
    env.reset(seed=0)
    body = env.unwrapped.point_env  # type: ignore[attr-defined]
    body.set_state(states[0, :2], states[0, 2:])
    for t in range(200):
        np.testing.assert_allclose(body.step(actions[t])[0], states[t + 1], rtol=0, atol=1e-9)
    env.close()


def test_play_travels_between_hand_picked_cells_and_diverse_anywhere(large: Path, large_play: Path) -> None:
    task = get_task("pointmaze-large-play")
    picked = set(task.data_goal_cells or ())

    def cells(folder: Path, field: str, rows: Any) -> set[tuple[int, int]]:
        arrays = [v[rows] for k, v in _arrays(folder).items() if k.endswith(field)]
        return {(int(i), int(j)) for i, j in task.xy_to_cell(np.concatenate(arrays))}

    assert cells(large_play, "desired_goal", slice(None)) <= picked
    assert cells(large_play, "achieved_goal", slice(0, 1)) <= picked
    assert len(cells(large, "desired_goal", slice(None)) - picked) > 3


def test_episodes_start_at_rest_anywhere_in_a_cell(large: Path) -> None:
    task = get_task(LARGE)
    for number in range(5):
        start = _arrays(large)[f"episode_{number}/observations/observation"][0]
        np.testing.assert_array_equal(start[2:], 0)
        offset = start[:2] - task.cell_to_xy(task.xy_to_cell(start[:2]))
        assert np.abs(offset).max() <= 0.38


def test_the_data_press_against_walls_and_come_to_rest(large: Path) -> None:
    task = get_task(LARGE)
    states = np.concatenate([v for k, v in _arrays(large).items() if k.endswith("/observation")])
    from_centre = np.abs(states[:, :2] - task.cell_to_xy(task.xy_to_cell(states[:, :2])))
    assert set(map(tuple, task.xy_to_cell(states[:, :2]).tolist())) <= set(task.free_cells())
    assert (from_centre.max(axis=1) > 0.38).any()
    speed = np.linalg.norm(states[:, 2:], axis=1)
    assert 2.5 < np.median(speed) < 5
    assert (speed < 0.05).mean() > 0.005


def test_what_was_collected_loads_for_its_task_only(large: Path) -> None:
    data = load_trajectories(f"local:{large}", LARGE)
    assert data.observation_dim == 4
    assert data.rewards.sum() == data.terminations.sum()
    with pytest.raises(DataError, match="recorded in PointMaze_Large-v3, but task 'pointmaze-umaze-play' needs"):
        load_trajectories(f"local:{large}", "pointmaze-umaze-play")
    recorded = load_trajectories(f"local:{large}", LARGE, reward="recorded")
    assert (recorded.num_episodes, recorded.num_steps) == (5, 2_250)


def test_flipped_bytes_of_the_data_are_noticed(large: Path, tmp_path: Path) -> None:
    whole = (large / "data" / "main_data.hdf5").read_bytes()
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "metadata.json").write_bytes((large / "data" / "metadata.json").read_bytes())
    needle = _arrays(large)["episode_1/observations/observation"].tobytes()[800:864]
    place = whole.index(needle)
    for offset in range(0, 64, 16):
        broken = bytearray(whole)
        broken[place + offset] ^= 1
        (tmp_path / "data" / "main_data.hdf5").write_bytes(broken)
        with pytest.raises(DataError, match=r"episode_1, observations/observation: .* is damaged there"):
            load_trajectories(f"local:{tmp_path}", LARGE)


def test_an_interrupted_collection_goes_on_and_ends_with_the_same_bytes(
    large: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = pointmaze._Recorder.__call__
    recorded = []

    def stop(self: pointmaze._Recorder, number: int) -> list[dict[str, Any]]:
        if number == 4 and 4 not in recorded:
            recorded.append(4)
            raise KeyboardInterrupt
        recorded.append(number)
        return record(self, number)

    def collect() -> Path:
        return collect_pointmaze(LARGE, 2_250, 7, tmp_path, workers=1, progress=False)

    monkeypatch.setattr(pointmaze._Recorder, "__call__", stop)
    with pytest.raises(KeyboardInterrupt):
        collect()
    assert [path.name for path in tmp_path.iterdir()] == [f".{large.name}.recording"]  # no set, and what was recorded
    again = collect()
    assert recorded == [0, 1, 2, 3, 4, 4]  # the first chunk was not recorded twice
    assert (large / "data" / "main_data.hdf5").read_bytes() == (again / "data" / "main_data.hdf5").read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == [large.name]


def _script(tmp_path: Path, body: str) -> Path:
    script = tmp_path / "script.py"
    script.write_text(f"from datamodules import collect_pointmaze\n{body}\n")
    return script


def test_ctrl_c_with_many_processes_leaves_no_set(tmp_path: Path) -> None:
    out = tmp_path / "out"
    call = f"collect_pointmaze({LARGE!r}, 2_000_000, 0, {str(out)!r}, workers=2, progress=False)"
    script = _script(tmp_path, f"if __name__ == '__main__':\n    {call}")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, script],
        env=environment,
        start_new_session=True,
        # A shell that runs the tests in the background lets its children ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while not (out.is_dir() and any(out.glob(".*/data/main_data.hdf5"))):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=60) != 0
    assert [path.suffix for path in out.iterdir()] == [".recording"]  # for the next call; no set, no half of one


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    out = tmp_path / "out"
    script = _script(tmp_path, f"collect_pointmaze({LARGE!r}, 5_000, 0, {str(out)!r}, workers=2, progress=False)")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert run.returncode != 0
    assert "a script must call this under `if __name__ == '__main__':`" in run.stderr
    assert not list(out.glob("[!.]*"))


def test_an_existing_set_is_kept_unless_overwriting(tmp_path: Path) -> None:
    first = collect_pointmaze(LARGE, 20, 0, tmp_path, workers=1, progress=False)
    with pytest.raises(UserError, match="exists already"):
        collect_pointmaze(LARGE, 30, 0, tmp_path, workers=1, progress=False)
    collect_pointmaze(LARGE, 30, 0, tmp_path, workers=1, progress=False, overwrite=True)
    assert load_trajectories(f"local:{first}").num_steps == 30
    assert [path.name for path in tmp_path.iterdir()] == ["pointmaze-large-diverse-v0"]


def test_progress_counts_steps_on_standard_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    collect_pointmaze(LARGE, 30, 0, tmp_path, workers=1)
    out, err = capfd.readouterr()
    assert out == ""
    assert re.search(r"pointmaze-large-diverse-v0.*30/30", err)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps: got 0"),
        ({"workers": 0}, "workers: got 0"),
        ({"seed": -1}, "seed is -1, expected a whole number"),
        ({"speed": 6.0}, "speed: got 6.0"),
        ({"waypoint_offset": 0.5}, "waypoint_offset: got 0.5, expected 0 to 0.4"),
        ({"start_offset": -0.1}, "start_offset: got -0.1"),
        ({"action_noise": float("nan")}, "action_noise: got nan"),
        ({"rest_share": 1.5}, r"rest_share: got 1\.5, expected 0 to 1"),
        ({"burst_probability": 2.0}, "burst_probability: got 2.0"),
        ({"burst_steps": (50, 10)}, r"burst_steps: got \(50, 10\)"),
        ({"task": "pointmaze-giant"}, "no task 'pointmaze-giant'"),
    ],
)
def test_settings_out_of_range_are_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        collect_pointmaze(**{"task": LARGE, "steps": 10, "out": tmp_path, **options})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("recipe", [QUIET, PointMazeRecipe()])
def test_the_controller_crosses_the_large_maze_well_within_the_cap(recipe: PointMazeRecipe) -> None:
    task = get_task(LARGE)
    env, actor = task.make_env(), WaypointController(task, recipe)
    actor.reset(1, seed=0)
    lengths = []
    for seed in range(4):
        observation, _ = env.reset(seed=seed)
        restarted, steps, done = True, 0, False
        while not done:
            action = actor.act(observation[None], np.array([restarted]))[0]
            observation, _, terminated, truncated, _ = env.step(action)
            restarted, steps, done = False, steps + 1, terminated or truncated
        assert terminated
        lengths.append(steps)
    assert 300 <= np.median(lengths) <= 550
    env.close()


def test_the_controller_acts_for_a_batch_and_repeats_with_its_seed() -> None:
    actor = WaypointController(LARGE, PointMazeRecipe())
    observations = np.tile(np.array([-4.5, -3.0, 0, 0], np.float32), (3, 1))
    runs = []
    for _ in range(2):
        actor.reset(3, seed=5)
        runs.append(np.stack([actor.act(observations, np.zeros(3, bool)) for _ in range(1_000)]))
    assert runs[0].shape == (1_000, 3, 2)
    assert runs[0].dtype == np.float32
    assert np.abs(runs[0]).max() <= 1
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0][:, 0], runs[0][:, 1])
