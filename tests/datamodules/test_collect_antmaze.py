"""AntMaze data by D4RL's recipe: what is in them, that they repeat, go on after an interruption, and load."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
import minari
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.collect import antmaze, recording
from datamodules.collect.antmaze import AntMazeRecipe, AntNavigator, collect_antmaze
from datamodules.physics.check import replay_check
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.tasks import get_task

TASK = "antmaze-umaze-diverse"
SHORT = AntMazeRecipe(episode_steps=60)


def collect(out: Path, steps: int = 1000, seed: int = 3, **options: Any) -> Path:
    options = {"task": TASK, "workers": 1, "recipe": SHORT, "progress": False, **options}
    return collect_antmaze(options.pop("task"), steps, seed, out, **options)


def arrays(folder: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        file.visititems(lambda name, node: found.update({name: node[()]}) if isinstance(node, h5py.Dataset) else None)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1,000 steps: 16 episodes of 60 steps and one of 40."""
    return collect(tmp_path_factory.mktemp("data"))


def test_every_step_that_was_asked_for_is_there(folder: Path) -> None:
    data = load_trajectories(f"local:{folder}", TASK, reward="recorded")
    assert data.num_steps == 1000
    assert sorted(data.lengths.tolist()) == [40] + [60] * 16
    assert data.truncations.sum() == 17
    assert not data.terminations.any()
    assert np.isin(data.rewards, (0.0, 1.0)).all()


def test_any_number_of_workers_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    other = collect(tmp_path, workers=2)
    assert (folder / "data" / "main_data.hdf5").read_bytes() == (other / "data" / "main_data.hdf5").read_bytes()
    assert not np.array_equal(
        arrays(collect(tmp_path / "seed", 60, seed=4))["episode_0/actions"], arrays(folder)["episode_0/actions"]
    )


def test_an_interrupted_collection_goes_on_and_ends_with_the_same_bytes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded: list[int] = []
    original = antmaze._Recorder.__call__

    def count(self: Any, number: int) -> Any:
        if len(recorded) == 1 and not (tmp_path / "again").exists():
            raise KeyboardInterrupt
        recorded.append(number)
        return original(self, number)

    monkeypatch.setattr(antmaze._Recorder, "__call__", count)
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path)
    (left,) = tmp_path.iterdir()
    assert left.name == f".{folder.name}.recording"
    (tmp_path / "again").mkdir()
    resumed = collect(tmp_path)
    assert recorded == [0, 1]  # the first round was not recorded twice
    assert (folder / "data" / "main_data.hdf5").read_bytes() == (resumed / "data" / "main_data.hdf5").read_bytes()
    assert not left.exists()


def test_chunks_of_other_settings_are_not_taken(tmp_path: Path) -> None:
    first = recording.PartialRecording(tmp_path / "set", {"seed": 0})
    first.open()
    first.write(0, [{"rewards": np.arange(3.0), "infos": {"goal": np.ones((4, 2))}}])
    (episode,) = first.read(0)
    np.testing.assert_array_equal(episode["infos"]["goal"], np.ones((4, 2)))
    again = recording.PartialRecording(tmp_path / "set", {"seed": 0})
    again.open()
    assert again.has(0)
    other = recording.PartialRecording(tmp_path / "set", {"seed": 1})
    other.open()
    assert not other.has(0)


def test_rewards_are_those_of_the_goal_that_the_evaluation_would_have_drawn(folder: Path) -> None:
    task = get_task(TASK)
    centre = task.cell_to_xy(task.goal_cell)
    found = arrays(folder)
    for number in range(17):
        episode = {key.split("/", 1)[1]: value for key, value in found.items() if key.startswith(f"episode_{number}/")}
        goals = episode["infos/evaluation_goal"]
        assert (goals == goals[0]).all()
        assert ((goals[0] >= centre) & (goals[0] < centre + 1.5)).all()
        near = np.linalg.norm(episode["observations"][1:, :2] - goals[0], axis=1) <= 0.5
        np.testing.assert_array_equal(episode["rewards"], near)


def test_minari_opens_the_set(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder.parent))
    data = minari.load_dataset("antmaze-umaze-diverse-v0")
    assert (data.total_episodes, data.total_steps) == (17, 1000)
    assert data.observation_space.shape == (29,)
    collection = json.loads((folder / "data" / "metadata.json").read_text())["collection"]
    assert collection["action_noise"] == 0.2
    assert len(collection["controller"]) == 64


def test_diverse_starts_anywhere_play_heads_for_chosen_cells_and_umaze_goes_one_way(tmp_path: Path) -> None:
    recipe = AntMazeRecipe(episode_steps=1)
    many = {name: arrays(collect(tmp_path, 120, task=name, recipe=recipe)) for name in
            ("antmaze-medium-diverse", "antmaze-medium-play", "antmaze-umaze")}  # fmt: skip

    def cells(name: str, key: str) -> set[tuple[int, ...]]:
        values = np.stack([value[0] for path, value in many[name].items() if path.endswith(key)])
        return {tuple(cell) for cell in get_task(name).xy_to_cell(values[:, :2]).tolist()}

    medium = get_task("antmaze-medium-diverse")
    for name in ("antmaze-medium-diverse", "antmaze-medium-play"):
        assert len(cells(name, "/observations")) > 15
    assert len(cells("antmaze-medium-diverse", "infos/goal")) > 15
    assert cells("antmaze-medium-play", "infos/goal") <= set(medium.variant("d4rl").free_cells())
    assert cells("antmaze-medium-play", "infos/goal") == set(get_task("antmaze-medium-play").data_goal_cells or ())
    assert cells("antmaze-umaze", "/observations") == {(1, 1)}
    assert cells("antmaze-umaze", "infos/goal") == {(3, 1)}


def test_a_flipped_ant_lies_there_unless_told_otherwise() -> None:
    task = get_task(TASK)
    for ends in (False, True):
        recipe = AntMazeRecipe(episode_steps=80, end_when_flipped=ends)
        recorder = antmaze._Recorder(task, 0, 80, recipe)
        ant = antmaze._Ant(task, recorder.env())
        walk = antmaze._Walk(task, recipe, ant, np.random.default_rng(0), 80)
        qpos = ant.simulator.data.qpos.copy()
        qpos[2:7] = 0.3, 0.0, 1.0, 0.0, 0.0  # on its back
        ant.simulator.set_state(qpos, 0 * ant.simulator.data.qvel)
        while walk.left:
            walk.step(np.zeros(8))
        assert len(walk.episodes) > 1 if ends else len(walk.episodes) == 1
        assert sum(len(episode["rewards"]) for episode in walk.episodes) == 80


def test_in_robotics_physics_the_set_is_one_of_that_environment(tmp_path: Path) -> None:
    name = "antmaze-umaze-diverse@robotics"
    folder, task = collect(tmp_path, 200, task=name), get_task(name)
    found = arrays(folder)
    observations = found["episode_0/observations/observation"]
    assert observations.shape == (61, 27)
    np.testing.assert_array_equal(found["episode_0/observations/desired_goal"], np.tile(task.goal_xy(), (61, 1)))
    data = load_trajectories(f"local:{folder}", name)
    np.testing.assert_array_equal(data.observations[:61, 2:], observations.astype(np.float32))
    assert {tuple(cell) for cell in task.xy_to_cell(data.observations[[0, 61, 122]][:, :2]).tolist()} <= set(
        task.free_cells()
    )
    assert replay_check(f"local:{folder}", name, steps=20).fit


@pytest.mark.parametrize("physics", ["d4rl", "robotics"])
def test_the_navigator_reaches_the_goal(physics: str) -> None:
    task = dataclasses.replace(get_task(f"antmaze-umaze@{physics}"), max_episode_steps=400)
    result = rollout(task, [Contestant("navigator", AntNavigator(task), 4)], workers=0, progress=False)
    assert result.episodes["success"].sum() >= 3  # now and then an ant falls over


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "pointmaze-umaze-play"}, "cannot be collected here, expected a task of antmaze in d4rl or robotics"),
        ({"steps": 0}, "steps: got 0"),
        ({"seed": -1}, "seed is -1, expected a whole number"),
        ({"workers": 0}, "workers: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        collect(tmp_path, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("setting", [{"action_noise": -0.1}, {"waypoint_noise": 2.0}, {"episode_steps": 0}])
def test_recipes_out_of_range_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=f"{next(iter(setting))}: got"):
        AntMazeRecipe(**setting)
