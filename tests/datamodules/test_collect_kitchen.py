"""The arm, its moves, and the data sets that it makes in the real kitchen."""

from __future__ import annotations

import json
import pickle
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import mujoco
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.collect import kitchen, recording
from datamodules.collect.franka import CLOSED, OPEN, Aim, FrankaArm, pointing
from datamodules.collect.kitchen import QUIET, KitchenDemonstrator, KitchenRecipe, collect_kitchen, draw_subtasks
from datamodules.collect.kitchen_moves import SCRIPTS, KitchenController
from datamodules.sources.subtasks import subtasks_completed
from dds_lightning.envs.build import build_env
from dds_lightning.envs.kitchen import SUBTASKS, kitchen_layout, subtasks_done
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

PARTIAL, MIXED = get_task("kitchen-partial"), get_task("kitchen-mixed")
STEP = 0.08


@pytest.fixture(scope="module")
def env() -> gym.Env[Any, Any]:
    """All seven subtasks; only the clock ends an episode."""
    return build_env("FrankaKitchen-v1", terminate_on_tasks_completed=False)


@pytest.fixture(scope="module")
def arm(env: gym.Env[Any, Any]) -> FrankaArm:
    return FrankaArm(env.unwrapped.model, STEP)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One whole episode."""
    return collect_kitchen(PARTIAL, 60, 3, tmp_path_factory.mktemp("data"), workers=1, progress=False)


def _positions(env: gym.Env[Any, Any], seed: int = 0) -> np.ndarray:
    return kitchen_layout(env.reset(seed=seed)[0]["observation"])


# ---------------------------------------------------------------------- the arm


def test_the_hand_points_where_yaw_and_pitch_say() -> None:
    axes = pointing(0.3, -0.2, 0.7)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(pointing(0.0, 0.0, 0.0)[:, 1:], [[1, 0], [0, 1], [0, 0]], atol=1e-12)
    assert pointing(0.3, 0.0, 0.0)[0, 2] < 0  # left
    assert pointing(0.0, 0.3, 0.0)[2, 2] < 0  # down


def test_an_arm_at_rest_does_not_sink_as_it_does_without_action(env: gym.Env[Any, Any], arm: FrankaArm) -> None:
    sunk = {}
    for held in (True, False):
        start = positions = _positions(env)
        for _ in range(15):
            arm.see(positions)
            seen, *_ = env.step(arm.action(np.zeros(7), OPEN) if held else np.zeros(9))
            positions = kitchen_layout(seen["observation"])
        sunk[held] = np.abs(positions - start)[:7].max()
    assert sunk[True] < 0.03
    assert sunk[False] > 0.15


def test_the_hand_gets_where_it_should_and_no_faster_than_it_may(env: gym.Env[Any, Any], arm: FrankaArm) -> None:
    arm.see(_positions(env))
    start, _ = arm.hand()
    aim = Aim(start + np.array([-0.1, 0.1, -0.1]), (0.2, 0.1, 0.0), speed=0.3)
    points = [start]
    for _ in range(25):
        seen, *_ = env.step(arm.action(arm.velocity(aim, SCRIPTS["microwave"].posture), CLOSED))
        arm.see(kitchen_layout(seen["observation"]))
        points.append(arm.hand()[0])
    distance, angle = arm.error(aim)
    assert np.linalg.norm(distance) < 0.015
    assert np.linalg.norm(angle) < 0.05
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() / STEP < 0.36


def test_actions_lie_in_the_box_whatever_the_velocity(env: gym.Env[Any, Any], arm: FrankaArm) -> None:
    arm.see(_positions(env))
    slow, fast = (arm.action(np.arange(1.0, 8.0) * scale, CLOSED) for scale in (0.01, 100.0))
    still = arm.action(np.zeros(7), CLOSED)
    assert np.abs(fast).max() <= 1.0
    # Slower, but the same way: offsets from standing still keep their proportions.
    np.testing.assert_allclose((fast - still)[:7] / (fast - still)[0], (slow - still)[:7] / (slow - still)[0])


def test_a_handle_goes_where_the_simulator_says(env: gym.Env[Any, Any], arm: FrankaArm) -> None:
    for script in SCRIPTS.values():
        if script.joint == "kettle":
            continue
        arm.see(_positions(env))
        predicted = arm.moved(script.joint, arm.site(script.handle), 0.2)
        arm.data.joint(script.joint).qpos[0] += 0.2
        mujoco.mj_kinematics(arm.model, arm.data)
        np.testing.assert_allclose(predicted, arm.site(script.handle), atol=1e-9)


# ---------------------------------------------------------------------- its moves


def _play(
    env: gym.Env[Any, Any], controller: KitchenController, subtasks: tuple[str, ...], seed: int, **noise: float
) -> tuple[list[str], int]:
    """What was completed, and how long it took."""
    rng = np.random.default_rng(seed)
    positions, info, steps = _positions(env, seed), {"episode_task_completions": []}, 0
    action_noise = noise.pop("action_noise", 0.0)
    controller.start(subtasks, rng, **noise)
    while steps < 280 and (action := controller.act(positions)) is not None:
        seen, _, _, _, info = env.step(np.clip(action + action_noise * rng.standard_normal(9), -1.0, 1.0))
        positions, steps = kitchen_layout(seen["observation"]), steps + 1
    return list(info["episode_task_completions"]), steps


@pytest.mark.parametrize("subtask", SUBTASKS)
def test_every_subtask_is_done_at_the_first_try_without_noise(env: gym.Env[Any, Any], subtask: str) -> None:
    controller = KitchenController(env.unwrapped.model, STEP, tries=1)
    done, steps = _play(env, controller, (subtask,), 0)
    assert done == [subtask]
    assert steps < 90
    assert controller.missed == []


def test_the_subtasks_of_partial_are_done_in_order_in_the_noise_of_the_data(env: gym.Env[Any, Any]) -> None:
    recipe = KitchenRecipe()
    noise = {name: getattr(recipe, name) for name in ("action_noise", "waypoint_noise", "speed_noise")}
    done, steps = _play(env, KitchenController(env.unwrapped.model, STEP), PARTIAL.subtasks, 1, **noise)
    assert done == list(PARTIAL.subtasks)
    assert steps < 280


def test_a_subtask_that_fails_is_tried_again_and_then_given_up(env: gym.Env[Any, Any]) -> None:
    stuck = _positions(env)  # nothing ever moves
    spent: list[int] = []
    for tries in (1, 2):
        controller = KitchenController(env.unwrapped.model, STEP, tries=tries)
        controller.start(("light switch", "slide cabinet"))
        spent.append(0)
        while controller.act(stuck) is not None:
            spent[-1] += controller.subtask == "light switch"
        assert controller.missed == ["light switch", "slide cabinet"]
    first = 45 + 20 + 12 + 15  # the moves' time-outs, and the patience of the third
    assert spent == [first, 2 * first]


# ---------------------------------------------------------------------- what an episode does


def test_episodes_do_four_subtasks_in_an_order_in_which_none_is_in_the_way() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_subtasks(PARTIAL, rng, 0.7) for _ in range(2_000)]
    assert {len(set(subtasks)) for subtasks in drawn} == {4}
    for subtasks in drawn:
        assert "microwave" not in subtasks[1:]
        assert "hinge cabinet" not in subtasks[:-1]
    orders = Counter(drawn)
    assert orders["microwave", "kettle", "light switch", "slide cabinet"] > 20
    assert orders["microwave", "kettle", "slide cabinet", "light switch"] > 20
    wanted = {"kettle", "bottom burner", "light switch", "slide cabinet"}
    aimed = np.mean(["microwave" in s and len(wanted.intersection(s)) >= 2 for s in drawn])
    assert aimed == pytest.approx(0.7, abs=0.03)
    # Every choice of four of the seven.
    assert len({frozenset(subtasks) for subtasks in drawn}) == 35


def test_no_episode_of_mixed_does_all_four_and_every_one_of_complete_does() -> None:
    rng = np.random.default_rng(0)
    assert not any(set(draw_subtasks(MIXED, rng, 0.7)) == set(MIXED.subtasks) for _ in range(1_000))
    complete = get_task("kitchen-complete")
    assert {draw_subtasks(complete, rng, 0.7) for _ in range(50)} == {tuple(complete.subtasks)}


# ---------------------------------------------------------------------- the data set


def test_the_set_is_the_environments_own_layout(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(small.parent))
    data = minari.load_dataset("kitchen-partial-v0")
    assert data.env_spec.id == "FrankaKitchen-v1"
    assert set(data.env_spec.kwargs["tasks_to_complete"]) == set(PARTIAL.subtasks)
    assert data.total_steps >= 60
    for episode in data.iterate_episodes():
        length = len(episode.rewards)
        assert 150 < length <= 280
        assert episode.observations["observation"].shape == (length + 1, 59)
        assert episode.observations["achieved_goal"]["kettle"].shape == (length + 1, 7)
        assert np.ptp(episode.observations["desired_goal"]["microwave"]) == 0.0
        assert episode.actions.shape == (length, 9)
        assert np.abs(episode.actions).max() <= 1.0
        ended = episode.terminations | episode.truncations
        assert ended.tolist() == [False] * (length - 1) + [True]


def test_it_loads_for_its_task_with_the_rewards_of_both_kinds(small: Path) -> None:
    paid = load_trajectories(f"local:{small}", PARTIAL, reward="recorded")
    learnt = load_trajectories(f"local:{small}", PARTIAL)
    assert paid.observations.shape[1] == 60
    scores = subtasks_completed(learnt, PARTIAL)
    assert scores.min() >= 1
    for number, score in enumerate(scores):
        rewards = paid.episode(number)["rewards"]
        assert set(np.unique(rewards)) <= {0.0, 1.0}
        assert rewards.sum() == score
        assert learnt.episode(number)["rewards"].max() <= score


def test_it_tells_what_the_arm_was_doing_and_how_much_was_done(small: Path) -> None:
    names = list(SUBTASKS)
    with h5py.File(small / "data" / "main_data.hdf5") as file:
        for group in file.values():
            doing, count = group["infos/subtask"][()], group["infos/subtasks_done"][()]
            assert len(dict.fromkeys(doing[doing >= 0])) == 4 or len(doing) == 281
            np.testing.assert_array_equal(np.diff(count), group["rewards"][()])
            states = kitchen_layout(group["observations/observation"][()])
            for name in PARTIAL.subtasks:
                done = subtasks_done(states, [name])[:, 0]
                if done.any():  # nothing is done before the arm has begun with it
                    assert names.index(name) in doing[: done.argmax() + 1]


def test_the_metadata_say_how_it_was_made(small: Path) -> None:
    facts = json.loads((small / "data" / "metadata.json").read_text())["collection"]
    assert facts["seed"] == 3
    assert facts["action_noise"] == 0.1
    assert len(facts["moves"]) == 16


def test_a_round_does_not_depend_on_what_was_recorded_before() -> None:
    recorder = kitchen._Recorder(replace(MIXED, max_episode_steps=40), 5, 10_000, KitchenRecipe())
    fresh = pickle.loads(pickle.dumps(recorder))
    recorder(0)
    (after,), (alone,) = recorder(1), fresh(1)
    for name in ("actions", "rewards"):
        assert after[name].tobytes() == alone[name].tobytes()
    assert after["observations"]["observation"].tobytes() == alone["observations"]["observation"].tobytes()


def test_an_interrupted_collection_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[int] = []
    interruptions = [2]

    def round_of(self: kitchen._Recorder, number: int) -> list[recording.Episode]:
        if number in interruptions:
            interruptions.clear()
            raise KeyboardInterrupt
        recorded.append(number)
        seen, _ = self.kitchen()[0].reset(seed=number)
        ends = np.arange(100) == 99
        steps = {"actions": np.zeros((100, 9), np.float32), "rewards": np.zeros(100)}
        return [
            {
                "observations": kitchen._stacked([seen] * 101),
                **steps,
                "terminations": ends & False,
                "truncations": ends,
                "infos": {"subtask": np.full(101, -1)},
            }
        ]

    monkeypatch.setattr(kitchen._Recorder, "__call__", round_of)
    with pytest.raises(KeyboardInterrupt):
        collect_kitchen(PARTIAL, 350, 0, tmp_path, workers=1, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == [".kitchen-partial-v0.recording"]
    folder = collect_kitchen(PARTIAL, 350, 0, tmp_path, workers=1, progress=False)
    assert recorded == [0, 1, 2, 3]  # four whole episodes are enough
    assert [path.name for path in tmp_path.iterdir()] == ["kitchen-partial-v0"]
    assert load_trajectories(f"local:{folder}", PARTIAL).num_episodes == 4


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("hopper-medium", {}, "expected a task of kitchen"),
        ("kitchen-mixed", {"steps": 0}, "steps: got 0"),
        ("kitchen-mixed", {"seed": -1}, "seed is -1, expected a whole number"),
    ],
)
def test_a_wrong_wish_is_refused_at_once(task: str, options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        collect_kitchen(task, **{"steps": 100, "seed": 0, "out": tmp_path, **options})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [("action_noise", -0.1), ("waypoint_noise", 0.2), ("speed_noise", 2.0), ("aimed_share", -1.0), ("tries", 0)],
)
def test_a_recipe_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(UserError, match=f"{name}: got {value}"):
        KitchenRecipe(**{name: value})


# ---------------------------------------------------------------------- as an actor


def test_the_demonstrator_does_the_tasks_subtasks_in_the_evaluation() -> None:
    env, actor = MIXED.make_env(), KitchenDemonstrator(MIXED)
    actor.reset(1, seed=0)
    observation, info = env.reset(seed=0)
    ended, restarted = False, True
    while not ended:
        action = actor.act(observation[None], np.array([restarted]))[0]
        observation, _, terminated, truncated, info = env.step(action)
        ended, restarted = terminated or truncated, False
    assert info["subtasks_done"] == 4
    assert QUIET.action_noise == 0.0
