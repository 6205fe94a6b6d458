"""Rewards of one goal for data that were recorded with many, as D4RL relabels its mazes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.trajectories import DataError, Trajectories
from dds_lightning.tasks import Task


def relabel_to_goal(trajectories: Trajectories, task: Task) -> Trajectories:
    """Give every step the reward of the task's own goal, and end episodes where it is reached.

    `r_t = 1` if the position after step t lies within `goal_radius` of the goal, else 0. Reaching the goal
    ends the episode (termination). What follows is a new episode, which begins with the first state outside:
    nobody acts from a state where the task has ended, and standing on the goal is never paid twice.

        outside outside INSIDE inside inside outside outside
        └── terminated ──────┘ └─ left out ┘ └─ new episode ...

    Terminations of other goals become truncations: for this task nothing ended there.

    Args:
        trajectories: Positions are the first two columns of the observations.
        task: A maze task.

    Raises:
        DataError: When every recorded state lies on the goal, so that nothing is left.
    """
    inside = np.linalg.norm(trajectories.observations[:, :2] - task.goal_xy(), axis=1) <= task.goal_radius
    pieces: list[dict[str, Any]] = []
    for number in range(trajectories.num_episodes):
        episode = trajectories.episode(number)
        rows = slice(*trajectories.observation_offsets[number : number + 2])
        for first, last, reached in _pieces(inside[rows]):
            steps = last - first
            end = np.arange(steps) == steps - 1
            pieces.append(
                {
                    "observations": episode["observations"][first : last + 1],
                    "actions": episode["actions"][first:last],
                    "rewards": (end & reached).astype(np.float32),
                    "terminations": end & reached,
                    "truncations": end & (not reached),
                }
            )
    if not pieces:
        raise DataError(f"data set '{trajectories.name}': every state lies on the goal of task '{task.name}'")
    return Trajectories(
        name=trajectories.name,
        lengths=np.array([len(piece["rewards"]) for piece in pieces], np.int64),
        action_low=trajectories.action_low,
        action_high=trajectories.action_high,
        **{key: np.concatenate([piece[key] for piece in pieces]) for key in pieces[0]},
    )


def _pieces(inside: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Cut one episode: (first state, last state, whether the last is the goal) of each part."""
    parts: list[tuple[int, int, bool]] = []
    first, final = 0, len(inside) - 1
    while True:
        away = np.flatnonzero(~inside[first:])
        if not len(away) or first + away[0] >= final:
            return parts
        first += int(away[0])
        arrivals = np.flatnonzero(inside[first:])
        last = first + int(arrivals[0]) if len(arrivals) else final
        parts.append((first, last, bool(len(arrivals))))
        first = last
