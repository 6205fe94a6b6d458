"""The kitchen: our facts are gymnasium-robotics' own, and four subtasks make an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium_robotics.envs.franka_kitchen import kitchen_env

from dds_lightning.envs.kitchen import SUBTASK_RADIUS, SUBTASKS, goal_vector, kitchen_layout, subtasks_done
from dds_lightning.tasks import get_task

STILL = np.zeros(9, np.float32)


@pytest.fixture(scope="module")
def env() -> Any:
    """The environment of `kitchen-mixed`."""
    made = get_task("kitchen-mixed").make_env()
    yield made
    made.close()


def put(env: Any, *subtasks: str) -> None:
    """Set objects to where they belong, all the rest as at a reset."""
    robot = env.unwrapped.robot_env
    qpos = robot.init_qpos.copy()
    for name in subtasks:
        columns, values = SUBTASKS[name]
        qpos[list(columns)] = values
    robot.set_state(qpos, np.zeros(robot.model.nv))


def test_columns_goals_and_radius_are_gymnasium_robotics() -> None:
    assert kitchen_env.BONUS_THRESH == SUBTASK_RADIUS
    assert set(SUBTASKS) == set(kitchen_env.OBS_ELEMENT_INDICES) == set(kitchen_env.OBS_ELEMENT_GOALS)
    for name, (columns, values) in SUBTASKS.items():
        np.testing.assert_array_equal(columns, kitchen_env.OBS_ELEMENT_INDICES[name])
        np.testing.assert_array_equal(values, kitchen_env.OBS_ELEMENT_GOALS[name])


def test_the_goal_is_zero_but_for_the_four_subtasks() -> None:
    goal = goal_vector(get_task("kitchen-partial").subtasks)
    expected = np.zeros(30)
    expected[[17, 18]] = -0.69, -0.05
    expected[19] = 0.37
    expected[22] = -0.75
    expected[23:30] = -0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06
    np.testing.assert_array_equal(goal, expected)


def test_an_observation_is_positions_of_robot_and_objects_then_the_goal(env: Any) -> None:
    observation, info = env.reset(seed=0)
    assert (observation.shape, observation.dtype) == ((60,), np.float32)
    assert (info["subtasks_done"], info["success"]) == (0, False)
    np.testing.assert_array_equal(observation[30:], goal_vector(env.task.subtasks).astype(np.float32))
    np.testing.assert_allclose(observation[:30], env.unwrapped.data.qpos, atol=0.02)  # the sensors' noise
    robot = env.unwrapped.robot_env
    assert robot.dt == pytest.approx(env.task.step_seconds)
    raw = np.arange(59.0)  # robot positions 9 and velocities 9, object positions 21 and velocities 20
    np.testing.assert_array_equal(kitchen_layout(raw), [*range(9), *range(18, 39)])


def test_rewards_count_a_subtask_once_and_four_end_the_episode(env: Any) -> None:
    env.reset(seed=0)
    subtasks = env.task.subtasks
    for done in range(1, 5):
        for repeat in range(2):
            put(env, *subtasks[:done])
            _, reward, terminated, truncated, info = env.step(STILL)
            assert reward == (1.0 if repeat == 0 else 0.0)
            assert info["subtasks_done"] == done
            assert (terminated, info["success"], truncated) == (done == 4, done == 4, False)
            if terminated:
                break
    assert env.task.normalised_score([4.0])[0] == 100.0


def test_subtasks_of_another_task_count_nothing(env: Any) -> None:
    env.reset(seed=0)
    put(env, "slide cabinet", "hinge cabinet", "top burner")
    _, reward, terminated, _, info = env.step(STILL)
    assert (reward, terminated, info["subtasks_done"]) == (0.0, False, 0)


def test_subtasks_done_agree_with_the_simulator_on_both_sides_of_the_radius(env: Any) -> None:
    subtasks = env.task.subtasks
    observation, _ = env.reset(seed=0)
    assert not subtasks_done(observation, subtasks).any()
    for index, name in enumerate(subtasks):
        columns, values = SUBTASKS[name]
        states = np.tile(observation, (2, 1)).astype(np.float64)
        states[:, list(columns)] = values
        states[:, columns[0]] += [0.29, 0.31]
        np.testing.assert_array_equal(subtasks_done(states, subtasks)[:, index], [True, False])
        np.testing.assert_array_equal(subtasks_done(states[:, :30], subtasks), subtasks_done(states, subtasks))


def test_an_episode_lasts_280_steps(env: Any) -> None:
    assert env.spec.max_episode_steps == env.task.max_episode_steps == 280
