"""D4RL's layout is read as D4RL means it: what follows what, where episodes end, and what is left out."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.sources.d4rl import load_d4rl
from datamodules.sources.goal import relabel_to_goal
from datamodules.trajectories import Trajectories
from dds_lightning.tasks import Task, get_task, task_names
from tests.recordings import Episode, d4rl_rows, record, write_d4rl_file

ROWS = [name for name in task_names() if "d4rl" in get_task(name).data_ids]
ONE_OF_EACH = ["hopper-medium", "halfcheetah-medium", "walker2d-medium", "antmaze-umaze", "kitchen-partial"]


@cache
def _recorded(env_id: str, name: str, steps: int = 90) -> list[Episode]:
    return record(get_task(name), steps, episode_steps=40)


def _episodes(name: str) -> list[Episode]:
    """One recording for all tasks in the same world."""
    task = get_task(name)
    same = next(one for one in ROWS if (get_task(one).env_id, get_task(one).subtasks) == (task.env_id, task.subtasks))
    return _recorded(task.env_id, same)


def _as_read(episodes: list[Episode], *, ends_are_terminals: bool = False) -> list[dict[str, Any]]:
    """What D4RL's layout keeps of recorded episodes, without the fast path."""
    kept = []
    for episode in episodes:
        steps = len(episode["rewards"])
        over = bool(episode["terminations"][-1]) or ends_are_terminals
        states = np.concatenate([episode["observations"][:steps], episode["observations"][steps - 1 : steps]])
        steps = steps if over else steps - 1
        end = np.arange(steps) == steps - 1
        if steps:
            kept.append(
                {
                    "observations": states[: steps + 1],
                    "actions": episode["actions"][:steps],
                    "rewards": episode["rewards"][:steps],
                    "terminations": end & over,
                    "truncations": end & (not over),
                }
            )
    return kept


def _same(found: Trajectories, expected: Trajectories) -> None:
    for key, array in expected.arrays().items():
        np.testing.assert_array_equal(getattr(found, key), array, err_msg=key)
        assert getattr(found, key).dtype == array.dtype


def _change(path: Path, **arrays: Any) -> Path:
    with h5py.File(path, "r+") as file:
        for key, array in arrays.items():
            if key in file:
                del file[key]
            if array is not None:
                file[key] = array
    return path


# ---------------------------------------------------------------------- every row of the table


@pytest.mark.parametrize("name", ROWS)
def test_files_of_every_row_load(name: str, tmp_path: Path) -> None:
    task = get_task(name)
    path = write_d4rl_file(tmp_path / task.data_ids["d4rl"], task, _episodes(name))
    data = load_trajectories(f"d4rl:{path}", name)
    assert (data.observation_dim, data.action_dim) == (task.observation_dim, task.action_dim)
    assert data.num_steps >= 80
    assert data.name == path.stem


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_the_fast_path_equals_from_episodes(name: str, tmp_path: Path) -> None:
    task, episodes = get_task(name), _episodes(name)
    path = write_d4rl_file(tmp_path / "file.hdf5", task, episodes)
    kitchen = task.family == "kitchen"
    if kitchen:  # rewards of the file count what is done in the row's own state
        rewards = np.split(d4rl_rows(task, episodes)["rewards"], np.cumsum([len(e["rewards"]) for e in episodes])[:-1])
        episodes = [{**episode, "rewards": values} for episode, values in zip(episodes, rewards, strict=True)]
    expected = Trajectories.from_episodes("file", _as_read(episodes, ends_are_terminals=kitchen))
    _same(load_d4rl(str(path), task), expected)
    assert expected.terminations.any() or name not in ("hopper-medium", "walker2d-medium")


def test_without_a_task_the_widths_are_the_files_own(tmp_path: Path) -> None:
    for name in ("hopper-medium", "antmaze-umaze"):
        path = write_d4rl_file(tmp_path / f"{name}.hdf5", get_task(name), _episodes(name))
        _same(load_trajectories(f"d4rl:{path}"), load_trajectories(f"d4rl:{path}", name))


def test_columns_of_one_and_numbers_as_flags_are_read(tmp_path: Path) -> None:
    task = get_task("hopper-medium")
    path = write_d4rl_file(tmp_path / "file.hdf5", task, _episodes(task.name))
    before, rows = load_d4rl(str(path), task), d4rl_rows(task, _episodes(task.name))
    flags = {key: rows[key].astype(np.float32)[:, None] for key in ("terminals", "timeouts")}
    _change(path, rewards=rows["rewards"][:, None].astype(np.float64), **flags)
    _same(load_d4rl(str(path), task), before)


def test_the_kitchens_rewards_stay_as_recorded_if_asked(tmp_path: Path) -> None:
    task = get_task("kitchen-partial")
    path = write_d4rl_file(tmp_path / "file.hdf5", task, _episodes(task.name))
    counts = np.arange(90) % 5
    _change(path, rewards=counts.astype(np.float32))
    np.testing.assert_array_equal(load_trajectories(f"d4rl:{path}", task, reward="recorded").rewards, counts)


# ---------------------------------------------------------------------- where episodes end


def _line(task: Task, rows: int, **arrays: Any) -> dict[str, Any]:
    """Rows whose numbers tell where they come from: observation t holds t, action t is t / 1000."""
    observations = np.tile(np.arange(rows, dtype=np.float32)[:, None], (1, task.observation_dim))
    actions = np.tile((np.arange(rows, dtype=np.float32) / 1000)[:, None], (1, task.action_dim))
    flags = {"terminals": np.zeros(rows, bool), "timeouts": np.zeros(rows, bool)}
    return {"observations": observations, "actions": actions, "rewards": np.arange(rows), **flags, **arrays}


def _write(path: Path, rows: dict[str, Any]) -> str:
    with h5py.File(path, "w") as file:
        for key, array in rows.items():
            if array is not None:
                file[key] = array
    return str(path)


def _parts(data: Trajectories) -> list[tuple[list[int], list[int], str]]:
    """Rows whose states and whose actions are in each episode, and how it ended."""
    parts = []
    for e in range(data.num_episodes):
        episode = data.episode(e)
        states = [int(row) for row in episode["observations"][:, 2]]
        actions = [round(1000 * float(value)) for value in episode["actions"][:, 0]]
        parts.append((states, actions, "terminated" if episode["terminations"][-1] else "truncated"))
    return parts


HOPPER = get_task("hopper-medium")


def _at(rows: int, *places: int) -> Any:
    return np.isin(np.arange(rows), places)


def test_time_outs_drop_their_step_and_terminals_keep_it(tmp_path: Path) -> None:
    rows = _line(HOPPER, 8, timeouts=_at(8, 3), terminals=_at(8, 5))
    assert _parts(load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER)) == [
        ([0, 1, 2, 3], [0, 1, 2], "truncated"),
        ([4, 5, 5], [4, 5], "terminated"),
        ([6, 7], [6], "truncated"),
    ]


def test_next_observations_tell_where_every_last_step_led(tmp_path: Path) -> None:
    rows = _line(HOPPER, 8, timeouts=_at(8, 3), terminals=_at(8, 5))
    rows["next_observations"] = rows["observations"] + 1
    rows["next_observations"][[3, 5, 7]] = [[103], [105], [107]]
    assert _parts(load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER)) == [
        ([0, 1, 2, 3, 103], [0, 1, 2, 3], "truncated"),
        ([4, 5, 105], [4, 5], "terminated"),
        ([6, 7, 107], [6, 7], "truncated"),
    ]


def test_next_observations_that_differ_from_the_next_row_end_an_episode(tmp_path: Path) -> None:
    rows = _line(HOPPER, 30, timeouts=_at(30, 29))
    rows["next_observations"] = rows["observations"] + 1
    rows["next_observations"][9] = 109
    parts = _parts(load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER))
    assert [(states[-1], len(actions)) for states, actions, _ in parts] == [(109, 10), (30, 20)]


def test_an_episode_of_one_row_holds_no_step_unless_it_terminated(tmp_path: Path) -> None:
    rows = _line(HOPPER, 5, timeouts=_at(5, 0, 1), terminals=_at(5, 2))
    assert _parts(load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER)) == [
        ([2, 2], [2], "terminated"),
        ([3, 4], [3], "truncated"),
    ]


def test_without_time_outs_the_cap_cuts(tmp_path: Path) -> None:
    rows = _line(HOPPER, 2300, terminals=_at(2300, 99, 1299), timeouts=None)
    rows["actions"] *= 0.1
    data = load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER)
    np.testing.assert_array_equal(data.lengths, [100, 999, 200, 999])  # two cuts after 1000 rows, one at the file's end
    np.testing.assert_array_equal(np.flatnonzero(data.terminations), [99, 1298])


def test_with_time_outs_longer_recordings_stay_whole(tmp_path: Path) -> None:
    rows = _line(HOPPER, 1200, timeouts=_at(1200, 1199))
    rows["actions"] *= 0.1
    assert load_d4rl(_write(tmp_path / "f.hdf5", rows), HOPPER).lengths == [1199]


# ---------------------------------------------------------------------- AntMaze walks on through the goal

ANT = get_task("antmaze-umaze")


def _walk(places: str, *, timeouts: tuple[int, ...] = (), **arrays: Any) -> dict[str, Any]:
    """An ant that stands on the goal where `places` says I and off it where it says O, relabelled as D4RL does:
    reward and terminal of a row speak of the position in the next one, whatever was recorded there."""
    on_goal = np.array([place == "I" for place in places])
    rows = _line(ANT, len(places), timeouts=_at(len(places), *timeouts))
    rows["observations"][:, 0] = ANT.goal_xy()[0] - np.where(on_goal, 0.3, 0.8)
    rows["observations"][:, 1] = ANT.goal_xy()[1]
    rows["rewards"] = np.append(on_goal[1:], False).astype(np.float32)
    rows["terminals"] = rows["rewards"].copy()
    return {**rows, **arrays}


def test_the_picture_of_the_module(tmp_path: Path) -> None:
    data = load_d4rl(_write(tmp_path / "f.hdf5", _walk("OOIIOOI", timeouts=(5,))), ANT)
    assert _parts(data) == [([0, 1, 2], [0, 1], "terminated"), ([4, 5], [4], "truncated")]
    np.testing.assert_array_equal(data.rewards, [0, 1, 0])


def test_rewards_are_paid_for_the_state_that_the_step_reaches(tmp_path: Path) -> None:
    data = load_d4rl(_write(tmp_path / "f.hdf5", _walk("OOOIIIOOIO")), ANT)
    after = np.concatenate([data.episode(e)["observations"][1:, :2] for e in range(data.num_episodes)])
    near = np.linalg.norm(after - ANT.goal_xy(), axis=1) <= ANT.goal_radius
    np.testing.assert_array_equal(data.rewards, near)
    np.testing.assert_array_equal(data.terminations, near)
    assert near.sum() == 2


@pytest.mark.parametrize("seed", range(8))
def test_cutting_at_terminals_equals_relabelling_by_position(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    places = "O" + "".join(rng.choice(["O", "I"], p=[0.7, 0.3], size=199))  # no row speaks of the first state
    ends = np.unique([*rng.integers(5, 190, 4), 199])
    rows = _walk(places, timeouts=tuple(ends))
    found = load_d4rl(_write(tmp_path / "f.hdf5", rows), ANT)
    whole = []
    for first, last in zip(np.append(0, ends[:-1] + 1), ends, strict=True):
        end = np.arange(last - first) == last - first - 1
        part = {key: rows[key][first:last] for key in ("actions", "rewards")}
        part |= {
            "terminations": end & False,
            "truncations": end,
            "observations": rows["observations"][first : last + 1],
        }
        if last > first:
            whole.append(part)
    expected = relabel_to_goal(Trajectories.from_episodes("f", whole), ANT)
    _same(found, expected)


def test_a_recording_that_stops_at_the_goal_is_a_termination(tmp_path: Path) -> None:
    rows = _walk("OOOOOO", terminals=_at(6, 2, 5), rewards=_at(6, 2, 5).astype(np.float32))
    rows["observations"][3:, 1] = 0  # the next episode starts far away
    data = load_d4rl(_write(tmp_path / "f.hdf5", rows), ANT)
    assert _parts(data) == [([0, 1, 2, 2], [0, 1, 2], "terminated"), ([3, 4, 5, 5], [3, 4, 5], "terminated")]
    np.testing.assert_array_equal(data.rewards, [0, 0, 1, 0, 0, 1])


def test_a_jump_is_a_reset_where_the_time_out_is_missing(tmp_path: Path) -> None:
    rows = _walk("OOOOOO")
    rows["observations"][3:, 1] = 0
    assert _parts(load_d4rl(_write(tmp_path / "f.hdf5", rows), ANT)) == [
        ([0, 1, 2], [0, 1], "truncated"),
        ([3, 4, 5], [3, 4], "truncated"),
    ]


def test_real_ants_never_jump(tmp_path: Path) -> None:
    def act(observation: Any, rng: np.random.Generator) -> Any:
        return rng.choice([-1.0, 1.0], 8)

    episodes = record(ANT, 300, episode_steps=100, act=act)
    data = load_d4rl(str(write_d4rl_file(tmp_path / "f.hdf5", ANT, episodes)), ANT)
    np.testing.assert_array_equal(data.lengths, [99, 99, 99])


# ---------------------------------------------------------------------- a million rows


@pytest.mark.slow
def test_a_million_steps_load_in_ten_seconds_and_600_megabytes() -> None:
    script = Path(__file__).parents[2] / "benchmarks" / "load_d4rl.py"
    printed = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout
    words = printed.split()
    seconds, megabytes = float(words[words.index("loading") + 1]), float(words[words.index("peak") + 1]) * 1.048576
    assert "954,020 steps" in printed
    assert seconds < 10
    assert megabytes < 600
