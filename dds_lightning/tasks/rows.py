"""The rows of the task table. Facts: D4RL's source (commit 89141a6) and gymnasium-robotics 1.4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dds_lightning.envs.mazes import D4RL_ANTMAZES, LARGE, MEDIUM, UMAZE, d4rl_antmaze_id
from dds_lightning.tasks.task import Cell, Task

_KINDS = ("", "_Diverse_G", "_Diverse_GR")
"""gymnasium-robotics' names of one maze with different goals and starts."""


def _with_variants(task: Task, **others: Mapping[str, Any]) -> Task:
    """Add variants to a row: physics -> the attributes that differ from the row's."""
    differ = dict.fromkeys(name for changes in others.values() for name in changes)
    own = {name: getattr(task, name) for name in differ}
    return replace(task, variants={task.physics: own, **{name: {**own, **changes} for name, changes in others.items()}})


# ---------------------------------------------------------------------- locomotion


def _locomotion() -> tuple[Task, ...]:
    """Three bodies, three data qualities. D4RL recorded in Gym's v2 classes, whose closest successor is v4.

    Rewards are scaled so that ten steps of an expert are worth about 3: unscaled, the critic's targets run into the
    hundreds and the advantage weights are clipped throughout.
    """
    bodies = (
        ("halfcheetah", "HalfCheetah", 17, 6, 0.05, -280.178953, 12135.0, (42.5, 41.6, 94.2)),
        ("hopper", "Hopper", 11, 3, 0.008, -20.272305, 3234.3, (84.7, 84.6, 109.8)),
        ("walker2d", "Walker2d", 17, 6, 0.008, 1.629008, 4592.3, (75.1, 72.9, 108.3)),
    )
    layouts = {
        "halfcheetah": "z, pitch, 6 joint angles, then velocities of x, z, pitch and the 6 joints",
        "hopper": "z, pitch, 3 joint angles, then velocities of x, z, pitch and the 3 joints, cut to +-10",
        "walker2d": "z, pitch, 6 joint angles, then velocities of x, z, pitch and the 6 joints, cut to +-10",
    }
    return tuple(
        _with_variants(
            Task(
                name=f"{name}-{quality}",
                family="locomotion",
                env_id=f"{camel}-v4",
                observation_dim=observations,
                observation_layout=layouts[name],
                action_dim=actions,
                max_episode_steps=1000,
                step_seconds=seconds,
                physics="v4",
                measures_success=False,
                reward_scale=round(300 / highest, 3),
                score_min=lowest,
                score_max=highest,
                evaluation_episodes=20,
                data_ids={
                    "local": f"{name}-{quality}-v0",
                    "d4rl": f"{name}_{quality.replace('-', '_')}-v2.hdf5",
                    **({"minari": f"mujoco/{name}/medium-v0"} if quality == "medium" else {}),
                },
                data_env_ids=(f"{camel}-v2", f"{camel}-v3"),
                paper_score=score,
            ),
            v5={"env_id": f"{camel}-v5", "data_env_ids": ()},
        )
        for name, camel, observations, actions, seconds, lowest, highest, scores in bodies
        for quality, score in zip(("medium", "medium-replay", "medium-expert"), scores, strict=True)
    )


# ---------------------------------------------------------------------- mazes


def _antmaze(size: str, *, file: str, goals: tuple[Cell, ...], scores: Any) -> tuple[Task, ...]:
    """Both data recipes of one AntMaze, in D4RL's physics and in gymnasium-robotics' (`@robotics`).

    Args:
        size: "umaze", "medium" or "large".
        file: The part of D4RL's file names that identifies the maze.
        goals: Cells among which D4RL's generation maps draw goals.
        scores: Recipe -> the paper's score.

    Rewards are learnt as 0.1 * (r - 1), IQL's convention for AntMaze at the scale of the other mazes.
    """
    camel = "UMaze" if size == "umaze" else size.capitalize()
    maze = D4RL_ANTMAZES[camel]
    robotics = tuple(
        f"AntMaze_{camel}{kind}{dense}-v{version}" for version in (4, 5) for kind in _KINDS for dense in ("", "Dense")
    )

    def row(recipe: str) -> Task:
        name = f"antmaze-{size}{f'-{recipe}' if recipe else ''}"
        many = recipe == "diverse" or (size == "umaze" and recipe != "")
        start = "False" if name == "antmaze-umaze" else "True"
        task = Task(
            name=name,
            family="antmaze",
            env_id=d4rl_antmaze_id(camel),
            observation_dim=29,
            observation_layout="x, y, z, quaternion (w, x, y, z), 8 joint angles, then velocities: 3 linear, "
            "3 angular, 8 joints",
            action_dim=8,
            max_episode_steps=maze.cap,
            step_seconds=0.1,
            physics="d4rl",
            maze_map=maze.maze_map,
            cell_size=maze.cell_size,
            origin="start",
            start_cell=maze.start_cell,
            goal_cell=maze.goal_cell,
            goal_radius=maze.goal_radius,
            goal_noise=0.75,  # the mean of U(0, 1) + U(0, 0.5)
            data_reward="arrival",
            reward_scale=0.1,
            reward_shift=-1.0,
            data_ids={
                "local": f"{name}-v0",
                "d4rl": f"Ant_maze_{file}_noisy_multistart_{start}_multigoal_{many}_sparse_fixed.hdf5",
                "minari": f"D4RL/antmaze/{name.removeprefix('antmaze-')}-v1",
            },
            data_start_cells=(maze.start_cell,) if name == "antmaze-umaze" else None,
            data_goal_cells=(maze.goal_cell,) if name == "antmaze-umaze" else goals if recipe == "play" else None,
            paper_score=scores[recipe],
        )
        return _with_variants(
            task,
            robotics={
                "env_id": f"AntMaze_{camel}-v4",
                "adapter": "maze",
                "step_seconds": 0.05,
                "origin": "centre",
                "goal_radius": 0.45,
                "goal_noise": 0.0,
                "data_env_ids": robotics,
                "data_reward": "goal",
                "data_ids": {**task.data_ids, "local": f"{name}-robotics-v0"},  # both can be collected
            },
        )

    return tuple(row(recipe) for recipe in scores)


def _pointmaze(
    size: str, *, maze_map: tuple[str, ...], cap: int, start: Cell, goal: Cell, play: tuple[Cell, ...]
) -> tuple[Task, ...]:
    """Both data recipes of one PointMaze; `play` are the hand-picked cells between which `-play` data travel.

    Rewards are learnt as 0.1 * (r - 1): every step on the way costs the same, as IQL does for AntMaze, and a
    skill of ten steps costs about one.
    """
    camel = "UMaze" if size == "umaze" else size.capitalize()

    def row(recipe: str, cells: tuple[Cell, ...] | None) -> Task:
        name = f"pointmaze-{size}-{recipe}"
        published = {"minari": f"D4RL/pointmaze/{size}-v2"} if recipe == "diverse" else {}
        return Task(
            name=name,
            family="pointmaze",
            env_id=f"PointMaze_{camel}-v3",
            observation_dim=4,
            observation_layout="x, y, then their velocities",
            action_dim=2,
            max_episode_steps=cap,
            step_seconds=0.01,
            adapter="maze",
            maze_map=maze_map,
            start_cell=start,
            goal_cell=goal,
            data_reward="goal",
            reward_scale=0.1,
            reward_shift=-1.0,
            data_ids={"local": f"{name}-v0", **published},
            data_env_ids=tuple(f"PointMaze_{camel}{kind}{dense}-v3" for dense in ("", "Dense") for kind in _KINDS),
            data_start_cells=cells,
            data_goal_cells=cells,
        )

    return row("play", play), row("diverse", None)


# ---------------------------------------------------------------------- kitchen


def _kitchen(quality: str, file: str, subtasks: tuple[str, ...], score: float | None) -> Task:
    """Four of the kitchen's subtasks; rewards are learnt as 0.1 times the number done at each step."""
    return Task(
        name=f"kitchen-{quality}",
        family="kitchen",
        env_id="FrankaKitchen-v1",
        observation_dim=60,
        observation_layout="9 joint angles of the robot, 21 positions of objects, 30 goal positions (0 except those "
        "of the four subtasks)",
        action_dim=9,
        max_episode_steps=280,
        step_seconds=0.08,
        env_options={"tasks_to_complete": list(subtasks)},
        adapter="kitchen",
        subtasks=subtasks,
        data_reward="subtasks",
        reward_scale=0.1,
        score_max=4.0,
        evaluation_episodes=20,
        data_ids={
            "local": f"kitchen-{quality}-v0",
            "d4rl": f"{file}-v0.hdf5",
            "minari": f"D4RL/kitchen/{quality}-v2",
        },
        paper_score=score,
    )


ROWS: tuple[Task, ...] = (
    *_locomotion(),
    *_antmaze(
        "umaze",
        file="u-maze",
        goals=(),
        scores={"": 95.6, "diverse": 94.5},
    ),
    *_antmaze(
        "medium",
        file="big-maze",
        goals=((2, 6), (5, 1), (6, 5)),
        scores={"play": 88.5, "diverse": 89.1},
    ),
    *_antmaze(
        "large",
        file="hardest-maze",
        goals=((1, 6), (3, 5), (3, 10), (5, 2), (7, 4), (7, 6), (7, 9)),
        scores={"play": 81.9, "diverse": 82.6},
    ),
    _kitchen(
        "partial",
        "kitchen_microwave_kettle_light_slider",
        ("microwave", "kettle", "light switch", "slide cabinet"),
        65.1,
    ),
    _kitchen(
        "mixed",
        "kitchen_microwave_kettle_bottomburner_light",
        ("microwave", "kettle", "bottom burner", "light switch"),
        67.5,
    ),
    _kitchen(
        "complete",
        "mini_kitchen_microwave_kettle_light_slider",
        ("microwave", "kettle", "light switch", "slide cabinet"),
        None,
    ),
    *_pointmaze("umaze", maze_map=UMAZE, cap=300, start=(1, 1), goal=(3, 1), play=((1, 1), (1, 3), (3, 3), (3, 1))),
    *_pointmaze(
        "medium",
        maze_map=MEDIUM,
        cap=600,
        start=(1, 1),
        goal=(6, 6),
        play=((1, 1), (1, 6), (4, 1), (4, 4), (6, 1), (6, 6)),
    ),
    *_pointmaze(
        "large",
        maze_map=LARGE,
        cap=800,
        start=(7, 1),
        goal=(1, 10),
        play=((7, 1), (1, 1), (1, 4), (7, 4), (1, 6), (5, 6), (7, 10), (5, 10), (3, 8), (1, 10)),
    ),
)
