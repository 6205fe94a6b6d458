"""Which family has a collector, what one shares with the others, and how a new one is added."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import minari
import numpy as np
import pytest

from datamodules.collect import antmaze, collectors
from datamodules.collect.antmaze import AntMazeRecipe
from datamodules.collect.collecting import Collector, DataSetPlan
from datamodules.collect.collectors import (
    COLLECTORS,
    can_collect,
    collect,
    collection_command,
    collector_of,
    refuse_uncollectable,
)
from datamodules.sources import load_trajectories
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.study.contestants import behaviour_controller
from dds_lightning.tasks import Task, get_task, task_names

POINT = "pointmaze-umaze-play"


def test_every_collector_serves_the_tasks_that_it_is_registered_for() -> None:
    rows = [get_task(name) for name in task_names()]
    every = [*rows, *(task.variant(physics) for task in rows for physics in task.variants)]
    served = [task for task in every if can_collect(task)]
    assert {(task.family, task.physics) for task in served} == set(COLLECTORS)
    for task in served:
        collector = collector_of(task)
        assert collector is not None
        assert collector.family == task.family
        assert collector.physics is None or task.physics in collector.physics
        collector.recipe()


def test_a_task_without_a_collector_says_where_data_come_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collectors, "COLLECTORS", {})
    for name in task_names():
        with pytest.raises(UserError, match=rf"'{name}'.*arrays:DIR, d4rl:FILE or minari:ID") as refused:
            refuse_uncollectable(get_task(name))
        assert (f"dds data fetch {name}" in str(refused.value)) == ("d4rl" in get_task(name).data_ids)
        assert behaviour_controller(get_task(name)) is None


# ---------------------------------------------------------------------- a new one: one record and one entry


@dataclass(frozen=True)
class ToyRecipe:
    """What the toy behaviour does."""

    push: float = 0.5


class ToyRecorder:
    """Records one episode of a body that stands still."""

    def __init__(self, steps: int, recipe: ToyRecipe) -> None:
        self.steps, self.rounds, self.recipe = steps, 1, recipe

    def __call__(self, number: int) -> list[dict[str, Any]]:
        steps, goals = self.steps, np.zeros((self.steps + 1, 2))
        return [
            {
                "observations": {"observation": np.ones((steps + 1, 4)), "achieved_goal": goals, "desired_goal": goals},
                "actions": np.full((steps, 2), self.recipe.push, np.float32),
                "rewards": np.zeros(steps),
                "terminations": np.zeros(steps, bool),
                "truncations": np.arange(steps) == steps - 1,
            }
        ]


class ToyActor:
    """Pushes."""

    def __init__(self, task: Task, recipe: ToyRecipe) -> None:
        self.task, self.recipe = task, recipe


def plan_toys(task: Task, seed: int, steps: int, recipe: ToyRecipe) -> DataSetPlan:
    env = build_env(task.env_id)
    return DataSetPlan(ToyRecorder(steps, recipe), env, "toy", "toys", {"toys": 1})


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> Task:
    """A task whose family nothing but a toy collects."""
    module = ModuleType("toy_collector")
    module.COLLECTOR = Collector("pointmaze", None, 30, ToyRecipe, plan_toys, ToyActor)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "toy_collector", module)
    monkeypatch.setattr(collectors, "COLLECTORS", {("pointmaze", ""): "toy_collector"})
    return get_task(POINT)


def test_a_new_collector_is_one_record_and_one_entry(toys: Task, tmp_path: Path) -> None:
    assert can_collect(toys)
    assert not can_collect(get_task("kitchen-mixed"))
    folder = collect(toys, 20, seed=4, out=tmp_path, workers=1, recipe={"push": 0.25})
    assert (load_trajectories(f"local:{folder}", POINT, reward="recorded").actions == 0.25).all()
    assert collection_command(folder) == f"dds data collect {POINT} --steps=20 --seed=4 --recipe.push=0.25"
    made = json.loads((folder / "data" / "metadata.json").read_text())["collection"]
    assert made == {"task": POINT, "seed": 4, "steps": 20, "push": 0.25, "toys": 1}
    with pytest.raises(UserError, match=r"recipe.speed: .* has no such setting; it has push"):
        collect(toys, 20, out=tmp_path, recipe={"speed": 3})
    actor = behaviour_controller(toys)
    assert isinstance(actor, ToyActor)
    assert actor.recipe == ToyRecipe()


def test_a_collector_takes_its_recipe_whole_or_in_parts(toys: Task, tmp_path: Path) -> None:
    collector = collector_of(toys)
    assert collector is not None
    given = {"whole": {"recipe": ToyRecipe(0.1)}, "parts": {"push": 0.1}, "both": {"recipe": ToyRecipe(), "push": 0.1}}
    for name, options in given.items():
        folder = collector.collect(POINT, out=tmp_path, workers=1, dataset_id=name, progress=False, **options)
        loaded = load_trajectories(f"local:{folder}")
        assert np.allclose(loaded.actions, 0.1)
        assert loaded.num_steps == collector.steps
    with pytest.raises(UserError, match="'kitchen-mixed' cannot be collected here, expected a task of pointmaze"):
        collector.collect("kitchen-mixed", out=tmp_path)


def test_a_recipe_says_what_the_behaviour_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[AntMazeRecipe] = []

    def plan(task: Task, seed: int, steps: int, recipe: AntMazeRecipe) -> DataSetPlan:
        asked.append(recipe)
        raise KeyboardInterrupt

    monkeypatch.setattr(antmaze, "COLLECTOR", replace(antmaze.COLLECTOR, plan=plan))
    with pytest.raises(KeyboardInterrupt):
        collect("antmaze-umaze", 100, out=tmp_path, recipe={"action_noise": 0.1, "end_when_flipped": True})
    assert asked == [AntMazeRecipe(action_noise=0.1, end_when_flipped=True)]


# ---------------------------------------------------------------------- the behaviours as actors


@pytest.mark.parametrize("name", ["pointmaze-large-play", "antmaze-umaze", "hopper-medium-replay", "kitchen-partial"])
def test_a_behaviour_acts_the_same_whichever_environments_have_finished(name: str) -> None:
    task = get_task(name)
    env = task.make_env()
    start = np.stack([env.reset(seed=seed)[0] for seed in range(3)]).astype(np.float32)
    env.close()
    actor = behaviour_controller(task)
    acted = []
    for live in ([0, 1, 2], [0, 2]):
        rows = np.array(live)
        actor.reset(3, seed=1)
        actions = [actor.act(start, np.ones(3, bool), np.arange(3))[[0, 2]]]
        for _ in range(40):  # long enough for the kitchen's arm to give up a move, and draw again
            chosen = actor.act(start[rows], np.zeros(len(rows), bool), rows)
            actions.append(chosen[[0, -1]])
        acted.append(np.stack(actions))
    np.testing.assert_array_equal(acted[0], acted[1])
    assert not np.array_equal(acted[0][0], acted[0][1]), "the noise stands still"
    actor.reset(3, seed=1)
    np.testing.assert_array_equal(actor.act(start, np.ones(3, bool))[[0, 2]], acted[0][0])


# ---------------------------------------------------------------------- recipes and commands


@pytest.mark.parametrize(
    ("task", "recipe", "message"),
    [
        ("antmaze-umaze", {"noise": 0.1}, r"recipe.noise: 'antmaze-umaze' has no such setting; it has action_noise, "),
        ("antmaze-umaze", {"action_noise": -1}, "action_noise: got -1, expected"),
        ("hopper-medium", {"action_noise": "much"}, "recipe.action_noise: got 'much', expected a number"),
        ("pointmaze-umaze-play", {"overwrite": True}, "recipe.overwrite: .* has no such setting; it has episode_steps"),
    ],
)
def test_a_recipe_out_of_range_is_refused(task: str, recipe: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        collect(task, 100, out=tmp_path, recipe=recipe)
    assert list(tmp_path.iterdir()) == []


def test_a_collected_set_knows_the_command_that_makes_it_again(tmp_path: Path) -> None:
    recipe = {"action_noise": 0.06}
    folder = collect("hopper-medium", 40, seed=3, out=tmp_path, workers=1, recipe=recipe)
    assert collection_command(folder) == (
        "dds data collect hopper-medium --steps=40 --seed=3 --recipe.action_noise=0.06"
    )
    point = collect("pointmaze-umaze-diverse", 40, out=tmp_path, workers=1, recipe={"speed": 3, "episode_steps": 20})
    assert collection_command(point) == (
        "dds data collect pointmaze-umaze-diverse --steps=40 --seed=0 --recipe.episode_steps=20 --recipe.speed=3"
    )
    (folder / "data" / "metadata.json").write_text('{"collection": {"task": "mine"}}')
    assert collection_command(folder) is None
    code = tmp_path / "task.py"
    code.write_text("raise SystemExit('a name in a file of a stranger was run')")
    stranger = {"collection": {"task": str(code), "steps": 1, "seed": 0}}
    (folder / "data" / "metadata.json").write_text(json.dumps(stranger))
    assert collection_command(folder) is None
    assert collection_command(tmp_path) is None


# ---------------------------------------------------------------------- Minari's side


def first_row(rows: Any) -> Any:
    return {key: first_row(inner) for key, inner in rows.items()} if isinstance(rows, dict) else rows[0]


@pytest.mark.parametrize("name", [POINT, "antmaze-umaze-diverse", "hopper-medium", "kitchen-mixed"])
def test_observations_are_stored_as_the_environment_declares_them(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = collect(name, 300, 0, tmp_path, workers=1)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    stored = minari.load_dataset(folder.name)
    env = stored.recover_environment()
    assert stored.observation_space == env.observation_space
    assert env.observation_space.contains(first_row(stored[0].observations))
    description = stored.storage.metadata["description"]
    assert ("install it from its checkout" in description) == name.startswith("antmaze")
    env.close()
