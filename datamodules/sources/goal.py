"""Rewards of one goal for data that were recorded with many, as D4RL relabels its mazes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datamodules.trajectories import DataError, Trajectories
from datamodules.windows import ranges
from dds_lightning.tasks import Task


def relabel_to_goal(trajectories: Trajectories, task: Task, drawn: bool = False) -> Trajectories:
    """Give every step the reward of the task's goal, and end episodes where it is reached.

    `r_t = 1` if the position after step t lies within `goal_radius` of the goal, else 0. Reaching the goal
    ends the episode (termination); what follows becomes a new episode that starts outside it, see
    `cut_at_goal`. Terminations of other goals become truncations: for this task nothing ended there.

    Args:
        trajectories: Positions are the first two columns of the observations.
        task: A maze task.
        drawn: Whether every episode has its own goal, as where `task.goal_noise` moves it in evaluations; always the
            same ones.

    Raises:
        DataError: When every recorded state lies on the goal, so that nothing is left.
    """
    goals = np.tile(task.goal_xy(), (trajectories.num_episodes, 1))
    if drawn:
        longer, shorter = np.random.default_rng(0).uniform(0.0, task.goal_noise, (2, *goals.shape))
        goals += (4 * longer + 2 * shorter) / 3 - task.goal_noise  # U(0, 4/3 noise) + U(0, 2/3 noise) from the centre
    away = trajectories.observations[:, :2] - np.repeat(goals, trajectories.lengths + 1, axis=0)
    return _cut(trajectories, np.linalg.norm(away, axis=1) <= task.goal_radius)


def cut_at_arrivals(trajectories: Trajectories, task: Task) -> Trajectories:
    """End episodes where the recording was rewarded for reaching its goal; what follows is a new episode.

    For data whose goal differs from recording to recording (D4RL's AntMaze draws it): the rewards show where it is.

    Args:
        trajectories: Rewards are 1 where a step leads to the goal, else 0.
        task: A maze task.

    Raises:
        DataError: When there are other rewards, or every recorded state lies on the goal.
    """
    odd = trajectories.rewards[(trajectories.rewards != 0) & (trajectories.rewards != 1)]
    if len(odd):
        raise DataError(
            f"data set '{trajectories.name}', rewards: got {odd[0]:g}, expected 0 or 1 (on the goal) for task "
            f"'{task.name}'"
        )
    inside = np.zeros(len(trajectories.observations), bool)
    steps = np.flatnonzero(trajectories.rewards == 1)
    inside[steps + trajectories.episode_of(steps) + 1] = True
    return _cut(trajectories, inside)


def _cut(trajectories: Trajectories, inside: NDArray[np.bool_]) -> Trajectories:
    """Episodes that end where `inside` (N + E,) begins, rewarded there."""
    first, last, reached = cut_at_goal(inside, trajectories.lengths + 1)
    if not len(first):
        raise DataError(f"data set '{trajectories.name}': every recorded state lies on the goal, so nothing is left")
    lengths = last - first
    # State row s + e belongs to step s of episode e.
    episodes = np.searchsorted(trajectories.observation_offsets, first, side="right") - 1
    terminations, truncations = ends_of(lengths, reached)
    return Trajectories(
        name=trajectories.name,
        observations=trajectories.observations[ranges(first, lengths + 1)],
        actions=trajectories.actions[ranges(first - episodes, lengths)],
        rewards=terminations.astype(np.float32),
        terminations=terminations,
        truncations=truncations,
        lengths=lengths,
        action_low=trajectories.action_low,
        action_high=trajectories.action_high,
    )


def cut_at_goal(
    inside: NDArray[np.bool_], lengths: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Cut recorded episodes into those that end where the goal is first reached.

    What follows an arrival is a new episode, which begins with the first state outside: no action starts from a state
    where the task has ended, and standing on the goal is never rewarded twice.

        outside outside INSIDE inside inside outside outside
        └── terminated ──────┘ └─ left out ┘ └─ new episode ...

    Args:
        inside: (S,) whether each state lies on the goal, episode after episode.
        lengths: (E,) states of each recorded episode, at least 1; they add up to S.

    Returns:
        First state, last state and whether that is the goal, of each new episode of at least one step.
    """
    final = np.zeros(len(inside), bool)
    final[np.cumsum(lengths) - 1] = True
    away = ~inside
    follows = np.zeros(len(inside), bool)  # whether the state before is outside too, in the same episode
    follows[1:] = away[:-1] & ~final[:-1]
    leads = np.append(follows[1:] & away[1:], False)
    first, last = np.flatnonzero(away & ~follows), np.flatnonzero(away & ~leads)
    reached = ~final[last]
    last = last + reached
    whole = last > first
    return first[whole], last[whole], reached[whole]


def ends_of(lengths: NDArray[np.int64], terminated: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Terminations and truncations, (N,) each, of episodes of `lengths` (E,), of which some `terminated` (E,)."""
    last = np.cumsum(lengths) - 1
    terminations = np.zeros(int(lengths.sum()), bool)
    truncations = terminations.copy()
    terminations[last] = terminated
    truncations[last] = ~terminated
    return terminations, truncations
