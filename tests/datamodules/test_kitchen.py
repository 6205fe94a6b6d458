"""The kitchen's two rewards and two file layouts, from the same real steps of the simulator."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import check_dataset, load_trajectories
from datamodules.sources.subtasks import relabel_subtasks, subtasks_completed
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.envs.kitchen import SUBTASKS, goal_vector
from dds_lightning.tasks import Task, get_task
from tests.minari_recordings import change_metadata, doing, write_minari_set
from tests.recordings import Episode, record, write_d4rl_file

MIXED = get_task("kitchen-mixed")
STEPS = 14
DONE = {2: "microwave", 4: "hinge cabinet", 5: "kettle", 9: "light switch", 11: "kettle", STEPS + 3: "bottom burner"}
UNDONE = {7: "kettle"}
# What is done after each step: the hinge cabinet is none of the four, and the kettle is put back and forth.
COUNTS = [[0, 0, 1, 1, 1, 2, 2, 1, 1, 2, 2, 3, 3, 3], [0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]]
ONCE = [[0, 0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]]


@cache
def _recorded(task: Task = MIXED) -> list[Episode]:
    env = task.make_env()
    try:
        return record(task, 2 * STEPS, episode_steps=STEPS, env=env, act=doing(env, DONE, UNDONE))
    finally:
        env.close()


def _counting() -> Task:
    """The kitchen as Minari's published sets were recorded: subtasks stay on the list when they are done."""
    options = {**MIXED.env_options, "remove_task_when_completed": False, "terminate_on_tasks_completed": False}
    return replace(MIXED, env_options=options)


def _rewards(data: Trajectories) -> list[list[float]]:
    return [data.episode(number)["rewards"].tolist() for number in range(data.num_episodes)]


# ---------------------------------------------------------------------- one episode, four recordings


def test_the_environment_pays_once_and_the_learner_for_what_is_done(tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded())
    assert _rewards(load_trajectories(f"local:{folder}", MIXED, reward="recorded")) == ONCE
    assert _rewards(load_trajectories(f"local:{folder}", MIXED)) == COUNTS


def test_a_recording_that_counts_already_gives_the_same(tmp_path: Path) -> None:
    task = _counting()
    folder = write_minari_set(tmp_path, "kitchen-v0", task, _recorded(task))
    assert json.loads(json.loads((folder / "data" / "metadata.json").read_text())["env_spec"])["kwargs"] == {
        "tasks_to_complete": list(MIXED.subtasks),
        "remove_task_when_completed": False,
        "terminate_on_tasks_completed": False,
    }
    assert _rewards(load_trajectories(f"local:{folder}", "kitchen-mixed", reward="recorded")) == COUNTS
    assert _rewards(load_trajectories(f"local:{folder}", "kitchen-mixed")) == COUNTS


def test_d4rls_layout_gives_the_same(tmp_path: Path) -> None:
    """D4RL's rows count what is done in their own state, so what was recorded is a step late."""
    file = write_d4rl_file(tmp_path / "kitchen.hdf5", MIXED, _recorded())
    recorded = load_trajectories(f"d4rl:{file}", MIXED, reward="recorded")
    assert _rewards(recorded) == [[0, *episode[:-1]] for episode in COUNTS]
    learnt = load_trajectories(f"d4rl:{file}", MIXED)
    assert [episode[:-1] for episode in _rewards(learnt)] == [episode[:-1] for episode in COUNTS]
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded())
    other = load_trajectories(f"local:{folder}", MIXED)
    for number in range(2):
        ours, theirs = (data.episode(number)["observations"][:STEPS] for data in (learnt, other))
        np.testing.assert_array_equal(ours, theirs)


def test_an_environment_with_all_seven_tasks_is_counted_for_four(tmp_path: Path) -> None:
    task = replace(MIXED, env_options={})
    folder = write_minari_set(tmp_path, "kitchen-v0", task, _recorded(task))
    recorded = load_trajectories(f"local:{folder}", MIXED, reward="recorded")
    assert recorded.rewards.sum() == np.sum(ONCE) + 1  # the hinge cabinet
    assert _rewards(load_trajectories(f"local:{folder}", MIXED)) == COUNTS
    np.testing.assert_allclose(recorded.observations[:, 30:], np.tile(goal_vector(MIXED.subtasks), (30, 1)), rtol=1e-6)


def test_without_a_task_the_goal_is_the_recordings(tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded())
    data = load_trajectories(f"local:{folder}")
    np.testing.assert_allclose(data.observations[0, 30:], goal_vector(MIXED.subtasks), rtol=1e-6)
    assert _rewards(data) == ONCE


# ---------------------------------------------------------------------- scores


def test_subtasks_completed_are_the_environments_return(tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded())
    data = load_trajectories(f"local:{folder}", MIXED)
    done = subtasks_completed(data, MIXED)
    assert done.tolist() == [3, 1]
    assert done.tolist() == [episode["subtasks_done"][-1] for episode in _recorded()]
    assert done.tolist() == [episode["rewards"].sum() for episode in _recorded()]
    assert done.dtype.kind == "i"
    facts = check_dataset(f"local:{folder}", MIXED)
    assert facts["mean subtasks done"] == 2.0
    assert facts["mean normalised score"] == 50.0
    assert facts["mean return"] == np.sum(COUNTS) / 2


def test_when_all_four_are_done_the_environment_ends_and_the_last_step_is_worth_four(tmp_path: Path) -> None:
    env = MIXED.make_env()
    done = dict(zip((1, 2, 4, 6), MIXED.subtasks, strict=True))
    episodes = record(MIXED, 7, env=env, act=doing(env, done))
    env.close()
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, episodes)
    data = load_trajectories(f"local:{folder}", MIXED)
    assert data.rewards.tolist() == [0, 1, 2, 2, 3, 3, 4]
    assert data.terminations.tolist() == [False] * 6 + [True]
    assert subtasks_completed(data, MIXED).tolist() == [4]


# ---------------------------------------------------------------------- counted by hand


def _states(*done: tuple[str, ...]) -> Any:
    observations = np.zeros((len(done), 60), np.float32)
    for row, names in zip(observations, done, strict=True):
        for name in names:
            columns, values = SUBTASKS[name]
            row[list(columns)] = values
    return observations


def _trajectories(*episodes: Any) -> Trajectories:
    return Trajectories.from_episodes(
        "made",
        [
            {
                "observations": observations,
                "actions": np.zeros((len(observations) - 1, 9)),
                "rewards": np.full(len(observations) - 1, 99.0),
                "terminations": np.zeros(len(observations) - 1, bool),
                "truncations": np.arange(1, len(observations)) == len(observations) - 1,
            }
            for observations in episodes
        ],
    )


def test_what_a_step_finds_done_is_not_to_its_credit_but_counts() -> None:
    microwave, both = ("microwave",), ("microwave", "kettle")
    data = _trajectories(_states(microwave, microwave, both, microwave, ()), _states(both, ()), _states((), microwave))
    assert _rewards(relabel_subtasks(data, MIXED)) == [[1, 2, 1, 0], [0], [1]]
    # Only states that a step reached: what lay done at the start, and no longer after the first step, was not done.
    assert subtasks_completed(data, MIXED).tolist() == [2, 0, 1]


def test_an_object_counts_within_its_radius_and_not_beyond() -> None:
    near, far = _states(("microwave",)), _states(("microwave",))
    near[0, 22] += 0.29
    far[0, 22] += 0.31
    data = _trajectories(np.concatenate([far, near, far]))
    assert relabel_subtasks(data, MIXED).rewards.tolist() == [1, 0]


# ---------------------------------------------------------------------- other subtasks


def test_a_mixed_set_is_refused_for_partial_naming_both(tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-mixed-v0", MIXED, _recorded())
    with pytest.raises(
        DataError,
        match="'kitchen-mixed-v0' was recorded for the subtasks microwave, kettle, bottom burner, light switch, "
        "but task 'kitchen-partial' has microwave, kettle, light switch, slide cabinet; choose a task",
    ):
        load_trajectories(f"local:{folder}", "kitchen-partial")


def test_the_order_of_subtasks_does_not_matter_and_complete_fits_partial(tmp_path: Path) -> None:
    complete = get_task("kitchen-complete")
    backwards = {"tasks_to_complete": list(complete.subtasks)[::-1]}
    folder = write_minari_set(tmp_path, "kitchen-v0", complete, record(complete, 3), kwargs=backwards)
    assert load_trajectories(f"local:{folder}", "kitchen-partial").num_steps == 3


@pytest.mark.parametrize("names", [["microwave", "oven"], "microwave", [["microwave"]], {"microwave": 1}])
def test_subtasks_that_the_kitchen_has_not_are_refused(names: Any, tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded(), kwargs={"tasks_to_complete": names})
    for task in ("kitchen-mixed", None):
        with pytest.raises(DataError, match=r"tasks_to_complete is .*, expected some of bottom burner, top burner"):
            load_trajectories(f"local:{folder}", task)


def test_a_kitchen_of_59_flat_numbers_is_refused(tmp_path: Path) -> None:
    folder = write_minari_set(tmp_path, "kitchen-v0", MIXED, _recorded())
    box = {"type": "Box", "shape": [59], "low": [], "high": []}
    change_metadata(folder, {"observation_space": json.dumps(box)})
    with pytest.raises(DataError, match=r"a Box \(59,\), but task 'kitchen-mixed' needs a Dict of observation \(59,\)"):
        load_trajectories(f"local:{folder}", "kitchen-mixed")
