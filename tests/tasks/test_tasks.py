from __future__ import annotations

import glob
import multiprocessing
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from datamodules.collect.planner import planner_for
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task, known_env_ids, task_names, task_table

POINTMAZES = [f"pointmaze-{size}-{recipe}" for size in ("umaze", "medium", "large") for recipe in ("play", "diverse")]


def test_the_table_has_the_six_pointmazes() -> None:
    assert set(POINTMAZES) <= set(task_names())
    table = task_table()
    assert list(table["task"]) == list(task_names())
    assert table.set_index("task").loc["pointmaze-large-play", "steps"] == 800
    assert table["task"].is_unique


def test_an_unknown_task_lists_the_nearest_names() -> None:
    with pytest.raises(UserError, match="no task 'pointmaze-larg-play'; did you mean pointmaze-large-play"):
        get_task("pointmaze-larg-play")
    with pytest.raises(UserError, match="pointmaze-umaze-play"):
        get_task("zzz")


@pytest.mark.parametrize("name", POINTMAZES)
def test_start_and_goal_are_free_far_apart_and_connected(name: str) -> None:
    task = get_task(name)
    cells = task.free_cells()
    assert task.start_cell in cells
    assert task.goal_cell in cells
    assert set(task.data_start_cells or ()) | set(task.data_goal_cells or ()) <= set(cells)
    assert task.start_cell is not None
    assert task.goal_cell is not None
    planner = planner_for(task.maze_map or ())
    steps = len(planner.path(task.start_cell, task.goal_cell)) - 1
    assert steps == {"umaze": 6, "medium": 10, "large": 17}[name.split("-")[1]]


@pytest.mark.parametrize("name", POINTMAZES)
def test_cells_and_walls_are_the_environments_own(name: str) -> None:
    task = get_task(name)
    env = task.make_env()
    maze = env.unwrapped.maze  # type: ignore[attr-defined]
    assert tuple("".join(map(str, row)) for row in maze.maze_map) == task.maze_map
    for cell in task.free_cells():
        xy = task.cell_to_xy(cell)
        np.testing.assert_array_equal(xy, maze.cell_rowcol_to_xy(cell))
        np.testing.assert_array_equal(task.xy_to_cell(xy + 0.49), maze.cell_xy_to_rowcol(xy + 0.49))
        np.testing.assert_array_equal(task.xy_to_cell(xy), cell)
    env.close()


def test_hand_computed_coordinates_of_the_large_maze() -> None:
    task = get_task("pointmaze-large-diverse")
    np.testing.assert_allclose(task.start_xy(), [-4.5, -3.0])
    np.testing.assert_allclose(task.goal_xy(), [4.5, 3.0])
    np.testing.assert_array_equal(task.xy_to_cell([[-4.5, -3.0], [4.99, 3.49]]), [[7, 1], [1, 10]])


def test_scores_run_from_0_to_100() -> None:
    task = get_task("pointmaze-large-diverse")
    np.testing.assert_allclose(task.normalised_score([0.0, 0.5, 1.0]), [0, 50, 100])


def test_the_environment_starts_in_the_start_cell_with_the_goal_in_its_place() -> None:
    task = get_task("pointmaze-large-play")
    env = task.make_env()
    assert env.observation_space.shape == (4,)
    assert env.observation_space.dtype == np.float32
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        assert observation.dtype == np.float32
        assert tuple(task.xy_to_cell(observation[:2])) == task.start_cell
        np.testing.assert_array_equal(observation[2:], 0)
        np.testing.assert_array_equal(env.unwrapped.goal, task.goal_xy())  # type: ignore[attr-defined]
        assert info["success"] is False
        np.testing.assert_allclose(info["position"], observation[:2], rtol=1e-6)
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    np.testing.assert_array_equal(first, again)
    env.close()


def test_episodes_end_at_the_goal_or_at_the_cap() -> None:
    task = get_task("pointmaze-umaze-play")
    env = task.make_env()
    env.reset(seed=0)
    still = np.zeros(2, np.float32)
    for step in range(task.max_episode_steps):
        _, reward, terminated, truncated, info = env.step(still)
        assert (reward, terminated, info["success"]) == (0.0, False, False)
        assert truncated == (step == task.max_episode_steps - 1)
    env.reset(seed=0)
    inside = task.goal_xy() + np.array([task.goal_radius - 0.05, 0.0])
    env.unwrapped.point_env.set_state(inside, np.zeros(2))  # type: ignore[attr-defined]
    _, reward, terminated, truncated, info = env.step(still)
    assert (reward, terminated, truncated, info["success"]) == (1.0, True, False, True)
    env.close()


def _leftovers(directory: str) -> list[str]:
    return glob.glob(os.path.join(directory, "*ant_maze*")) + glob.glob(os.path.join(directory, "dds-env-*"))


def _build_and_step(directory: str) -> float:
    tempfile.tempdir = directory
    env = get_task("pointmaze-umaze-play").make_env()
    env.reset(seed=0)
    observation = env.step(np.ones(2, np.float32))[0]
    env.close()
    return float(observation.sum())


def test_no_temporary_file_is_left_and_processes_do_not_meet(tmp_path: str) -> None:
    # gymnasium-robotics writes the maze under the time of day and leaves it there.
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(2, context) as pool:
        sums = list(pool.map(_build_and_step, [str(tmp_path)] * 6))
    assert len(set(sums)) == 1
    assert _leftovers(str(tmp_path)) == []
    assert os.listdir(tmp_path) == []


def test_building_restores_the_temporary_directory_even_after_an_error() -> None:
    before = tempfile.tempdir
    with pytest.raises(Exception, match="NoSuch"):
        build_env("NoSuchEnvironment-v0")
    assert tempfile.tempdir == before


def test_every_environment_of_the_table_is_known() -> None:
    assert {"PointMaze_UMaze-v3", "PointMaze_Medium-v3", "PointMaze_Large-v3"} <= known_env_ids()
    assert "CartPole-v1" not in known_env_ids()
