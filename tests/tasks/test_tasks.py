from __future__ import annotations

import glob
import multiprocessing
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor

import gymnasium as gym
import numpy as np
import pytest

from datamodules.collect.planner import planner_for
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task, known_env_ids, task_for_env, task_names, task_table

POINTMAZES = [f"pointmaze-{size}-{recipe}" for size in ("umaze", "medium", "large") for recipe in ("play", "diverse")]
PAPER = {  # table 1 of the paper, its own method
    "halfcheetah-medium": 42.5,
    "hopper-medium": 84.7,
    "walker2d-medium": 75.1,
    "halfcheetah-medium-replay": 41.6,
    "hopper-medium-replay": 84.6,
    "walker2d-medium-replay": 72.9,
    "halfcheetah-medium-expert": 94.2,
    "hopper-medium-expert": 109.8,
    "walker2d-medium-expert": 108.3,
    "antmaze-umaze": 95.6,
    "antmaze-umaze-diverse": 94.5,
    "antmaze-medium-play": 88.5,
    "antmaze-medium-diverse": 89.1,
    "antmaze-large-play": 81.9,
    "antmaze-large-diverse": 82.6,
    "kitchen-partial": 65.1,
    "kitchen-mixed": 67.5,
}
ANTMAZES = [name for name in PAPER if name.startswith("antmaze")]


def every_task() -> list[Task]:
    """All rows in all variants."""
    rows = [get_task(name) for name in task_names()]
    return [one for row in rows for one in (row, *(row.variant(name) for name in row.variants))]


def test_the_table_has_the_papers_seventeen_tasks_one_kitchen_more_and_six_pointmazes() -> None:
    assert len(PAPER) == 17
    assert set(task_names()) == {*PAPER, "kitchen-complete", *POINTMAZES}
    table = task_table()
    assert list(table["task"]) == list(task_names())
    assert table.set_index("task").loc["pointmaze-large-play", "steps"] == 800
    assert table["task"].is_unique


def test_paper_scores_are_those_of_its_table_1() -> None:
    assert {name: score for name in task_names() if (score := get_task(name).paper_score) is not None} == PAPER


def test_an_unknown_task_lists_the_nearest_names() -> None:
    with pytest.raises(UserError, match="no task 'pointmaze-larg-play'; did you mean pointmaze-large-play"):
        get_task("pointmaze-larg-play")
    with pytest.raises(UserError, match="no task 'zzz': `dds tasks` lists them"):
        get_task("zzz")


@pytest.mark.parametrize("name", [*POINTMAZES, *ANTMAZES, *(f"{name}@robotics" for name in ANTMAZES)])
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
    size = name.partition("@")[0].split("-")[1]
    assert steps == {"umaze": 6, "medium": 10, "large": 17 if task.family == "pointmaze" else 14}[size]


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


# ---------------------------------------------------------------------- rows and their variants


def test_d4rl_files_of_the_antmazes_are_named_as_their_recipes() -> None:
    files = {name: get_task(name).data_ids["d4rl"].removeprefix("Ant_maze_") for name in ANTMAZES}
    assert files == {
        "antmaze-umaze": "u-maze_noisy_multistart_False_multigoal_False_sparse_fixed.hdf5",
        "antmaze-umaze-diverse": "u-maze_noisy_multistart_True_multigoal_True_sparse_fixed.hdf5",
        "antmaze-medium-play": "big-maze_noisy_multistart_True_multigoal_False_sparse_fixed.hdf5",
        "antmaze-medium-diverse": "big-maze_noisy_multistart_True_multigoal_True_sparse_fixed.hdf5",
        "antmaze-large-play": "hardest-maze_noisy_multistart_True_multigoal_False_sparse_fixed.hdf5",
        "antmaze-large-diverse": "hardest-maze_noisy_multistart_True_multigoal_True_sparse_fixed.hdf5",
    }


@pytest.mark.parametrize("family", ["locomotion", "antmaze", "kitchen"])
def test_caps_and_episodes_are_the_papers(family: str) -> None:
    rows = [task for task in every_task() if task.family == family]
    caps = {task.base_name: task.max_episode_steps for task in rows}
    if family == "antmaze":
        assert caps == {name: 700 if "umaze" in name else 1000 for name in ANTMAZES}
        assert {task.evaluation_episodes for task in rows} == {100}
    else:
        assert set(caps.values()) == {1000 if family == "locomotion" else 280}
        assert min(task.evaluation_episodes for task in rows) >= 10


@pytest.mark.parametrize(
    ("prefix", "returns"),
    [
        ("halfcheetah", (-280.178953, 12135.0)),
        ("hopper", (-20.272305, 3234.3)),
        ("walker2d", (1.629008, 4592.3)),
        ("antmaze", (0.0, 1.0)),
        ("kitchen", (0.0, 4.0)),
        ("pointmaze", (0.0, 1.0)),
    ],
)
def test_d4rls_reference_returns_score_0_and_100(prefix: str, returns: tuple[float, float]) -> None:
    tasks = [task for task in every_task() if task.name.startswith(prefix)]
    assert tasks
    for task in tasks:
        np.testing.assert_allclose(task.normalised_score(returns), [0.0, 100.0], atol=1e-12)
        middle = sum(returns) / 2
        assert task.normalised_score(middle) == pytest.approx(50.0)


def test_a_variant_changes_the_physics_and_never_the_widths_the_maze_or_the_scores() -> None:
    kept = ("family", "observation_dim", "observation_layout", "action_dim", "max_episode_steps", "maze_map")
    kept += ("cell_size", "start_cell", "goal_cell", "score_min", "score_max", "paper_score", "reward_scale")
    found = set()
    for name in task_names():
        row = get_task(name)
        assert not row.is_pinned
        assert row.physics in (*row.variants, "")
        for physics in row.variants:
            variant = get_task(f"{name}@{physics}")
            assert (variant.name, variant.base_name, variant.physics) == (f"{name}@{physics}", name, physics)
            assert variant.is_pinned
            assert (variant.env_id == row.env_id) == (physics == row.physics)
            for attribute in kept:
                assert getattr(variant, attribute) == getattr(row, attribute), (variant.name, attribute)
            found.add((row.family, physics))
    assert found == {("locomotion", "v4"), ("locomotion", "v5"), ("antmaze", "d4rl"), ("antmaze", "robotics")}


def test_a_variant_is_asked_for_by_name() -> None:
    assert get_task("hopper-medium").env_id == get_task("hopper-medium@v4").env_id == "Hopper-v4"
    assert get_task("hopper-medium@v5").env_id == "Hopper-v5"
    assert get_task("antmaze-large-play@robotics").env_id == "AntMaze_Large-v4"


@pytest.mark.parametrize("name", ["hopper-medium@v3", "antmaze-umaze@v5", "hopper-medium@", "kitchen-mixed@d4rl"])
def test_an_unknown_variant_is_refused_with_those_there_are(name: str) -> None:
    base, _, physics = name.partition("@")
    known = ", ".join(f"{base}@{one}" for one in get_task(base).variants) or "no variants"
    with pytest.raises(UserError, match=f"'{base}' has no physics '{physics}'; it has {known}"):
        get_task(name)


@pytest.mark.parametrize(
    ("name", "env_id", "expected"),
    [
        ("hopper-medium", "Hopper-v2", "hopper-medium"),
        ("hopper-medium", "Hopper-v5", "hopper-medium@v5"),
        ("hopper-medium", "Walker2d-v4", None),
        ("hopper-medium@v4", "Hopper-v5", None),  # whoever says which, means it
        ("hopper-medium@v5", "Hopper-v5", "hopper-medium@v5"),
        ("hopper-medium@v5", "Hopper-v2", None),
        ("antmaze-large-play", "dds/AntMazeD4RL_Large-v0", "antmaze-large-play"),
        ("antmaze-large-play", "AntMaze_Large_Diverse_GR-v4", "antmaze-large-play@robotics"),
        ("antmaze-large-play", "AntMaze_Large-v5", "antmaze-large-play@robotics"),
        ("antmaze-large-play", "AntMaze_Medium-v4", None),
        ("antmaze-large-play@d4rl", "AntMaze_Large-v4", None),
        ("kitchen-mixed", "FrankaKitchen-v1", "kitchen-mixed"),
        ("pointmaze-umaze-play", "PointMaze_Medium-v3", None),
    ],
)
def test_recordings_of_an_environment_choose_the_variant_they_belong_in(
    name: str, env_id: str, expected: str | None
) -> None:
    found = task_for_env(get_task(name), env_id)
    assert (found.name if found else None) == expected
    assert expected is None or env_id in known_env_ids()


# ---------------------------------------------------------------------- frames of mazes


@pytest.mark.parametrize("name", ["antmaze-umaze", "antmaze-medium-play", "antmaze-large-play"])
def test_d4rls_frame_has_the_start_at_the_origin_and_y_down_the_map(name: str) -> None:
    task = get_task(name)
    centre = {"antmaze-umaze": (0, 8), "antmaze-medium-play": (20, 20), "antmaze-large-play": (32, 24)}[name]
    assert task.goal_cell is not None
    np.testing.assert_array_equal(task.start_xy(), [0.0, 0.0])
    np.testing.assert_array_equal(task.cell_to_xy(task.goal_cell), centre)
    np.testing.assert_array_equal(task.goal_xy(), np.array(centre) + 0.75)
    assert tuple(task.xy_to_cell(task.goal_xy())) == task.goal_cell
    theirs = get_task(f"{name}@robotics")
    assert theirs.maze_map is not None
    height, width = len(theirs.maze_map), len(theirs.maze_map[0])
    xy = theirs.cell_to_xy(task.free_cells())
    mirrored = np.stack([xy[:, 0] - (6 - 2 * width), (2 * height - 6) - xy[:, 1]], axis=-1)
    np.testing.assert_allclose(task.cell_to_xy(task.free_cells()), mirrored)


@pytest.mark.parametrize("physics", ["d4rl", "robotics"])
@pytest.mark.parametrize("name", ["antmaze-umaze", "antmaze-medium-play", "antmaze-large-play"])
def test_positions_and_cells_are_each_others_inverse(name: str, physics: str) -> None:
    task = get_task(f"{name}@{physics}")
    cells = np.stack(np.meshgrid(np.arange(-2, 14), np.arange(-2, 14)), axis=-1)  # beyond the walls too
    xy = task.cell_to_xy(cells)
    rng = np.random.default_rng(0)
    inside = rng.uniform(-0.499, 0.499, xy.shape) * task.cell_size
    np.testing.assert_array_equal(task.xy_to_cell(xy + inside), cells)
    np.testing.assert_allclose(task.cell_to_xy(task.xy_to_cell(xy)), xy)


# ---------------------------------------------------------------------- environments


@pytest.mark.parametrize("task", {task.env_id: task for task in every_task()}.values(), ids=lambda task: task.env_id)
def test_every_environment_is_as_wide_fast_and_long_as_its_row_says(task: Task) -> None:
    env = task.make_env()
    inner = env.unwrapped
    for part in ("point_env", "ant_env", "robot_env"):
        inner = getattr(inner, part, inner)
    observation, info = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == (task.observation_dim,)
    assert observation.dtype == np.float32
    assert isinstance(env.action_space, gym.spaces.Box)
    assert env.action_space.shape == (task.action_dim,)
    assert (env.action_space.low == task.action_low).all()
    assert (env.action_space.high == task.action_high).all()
    assert inner.dt == pytest.approx(task.step_seconds)  # type: ignore[attr-defined]
    assert env.spec is not None
    assert env.spec.max_episode_steps == task.max_episode_steps
    assert info["success"] is False
    observation, reward, terminated, truncated, info = env.step(np.zeros(task.action_dim, np.float32))
    assert observation.shape == (task.observation_dim,)
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    assert ("position" in info) == (task.maze_map is not None)
    env.close()


@pytest.mark.parametrize("name", ["antmaze-medium-play", "hopper-medium"])
def test_one_can_go_from_any_variant_to_any_other(name: str) -> None:
    task = get_task(name)
    for here in task.variants:
        for there in task.variants:
            assert task.variant(here).variant(there) == get_task(f"{name}@{there}")
