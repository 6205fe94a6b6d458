"""Describes data sets; what `dds data check` and `dds data show` print."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from datamodules.sources import load_trajectories
from datamodules.sources.subtasks import subtasks_completed
from datamodules.trajectories import Trajectories
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import action_names, observation_names

BLOCK = 65_536
"""Rows that are processed together, so that a data set of a million steps is never copied as a whole."""


def check_dataset(spec: str, task: Task | str | None = None, *, horizon: int | None = None) -> dict[str, Any]:
    """Read a data set from end to end and describe it; raise an error if anything is wrong.

    Args:
        spec: As in `load_trajectories`.
        task: The task that it must fit, if any; in mazes, rewards are then those of the task's goal.
        horizon: H; if given, also count segments, and refuse data whose episodes are all shorter.

    Returns:
        The facts of `describe`.

    Raises:
        DataError: At the first thing wrong; the message names data set, episode, field and value.
    """
    trajectories = load_trajectories(spec, task)
    return describe(trajectories, task=trajectories.task, horizon=horizon)[0]


def describe(
    trajectories: Trajectories, *, task: Task | None = None, horizon: int | None = None
) -> tuple[dict[str, Any], pd.DataFrame]:
    """Summarise a data set.

    Args:
        trajectories: The data.
        task: Adds normalised scores, names of the dimensions and, in mazes, how many of the free cells were
            visited.
        horizon: Adds the number of segments with that many steps.

    Returns:
        Facts by name, and a table with one row per column of the observations and actions: `dimension`, `name`
        (from the task, "" without one), `lowest`, `mean`, `std`, `highest`.
    """
    lengths, returns = trajectories.lengths, trajectories.returns
    terminated = trajectories.terminations[trajectories.step_offsets[1:] - 1]
    facts: dict[str, Any] = {
        "data set": trajectories.name,
        "episodes": trajectories.num_episodes,
        "steps": trajectories.num_steps,
        "observation width": trajectories.observation_dim,
        "action width": trajectories.action_dim,
        "shortest episode": int(lengths.min()),
        "median episode": float(np.median(lengths)),
        "longest episode": int(lengths.max()),
        "terminated episodes": int(terminated.sum()),
        "truncated episodes": int((~terminated).sum()),
        "lowest return": round(float(returns.min()), 3),
        "mean return": round(float(returns.mean()), 3),
        "highest return": round(float(returns.max()), 3),
    }
    if task is not None:
        scored = returns
        if task.subtasks:  # rewards pay at every step for what is done, the score once
            scored = subtasks_completed(trajectories, task).astype(np.float64)
            facts["mean subtasks done"] = round(float(scored.mean()), 2)
        facts["mean normalised score"] = round(float(task.normalised_score(scored).mean()), 2)
        if task.maze_map is not None:
            facts["episodes that reach the goal"] = int(terminated.sum())
            facts["free cells visited"] = f"{_visited(trajectories, task)} of {len(task.free_cells())}"
    dimensions = dimension_table(trajectories, task)
    still = [j for j in range(trajectories.observation_dim) if dimensions["lowest"][j] == dimensions["highest"][j]]
    if still:
        facts["constant observation columns"] = ", ".join(map(str, still))
    rewards = trajectories.rewards
    if rewards.min() == rewards.max():
        facts["every reward"] = round(float(rewards[0]), 6)
    if trajectories.steps_left_out:
        facts["steps left out"] = trajectories.steps_left_out
    if repeats := count_repeats(trajectories):
        facts["repeated episodes"] = repeats
    if horizon is not None:
        facts[f"segments of {horizon} steps"] = len(trajectories.windows(horizon))
    facts["fingerprint"] = trajectories.fingerprint()
    return facts, dimensions


def count_repeats(trajectories: Trajectories) -> int:
    """Count the episodes whose observations and actions are those of an earlier one, to the bit."""
    seen: set[bytes] = set()
    for number in range(trajectories.num_episodes):
        episode = trajectories.episode(number)
        digest = hashlib.sha256(np.ascontiguousarray(episode["observations"]).data)
        digest.update(np.ascontiguousarray(episode["actions"]).data)
        seen.add(digest.digest())
    return trajectories.num_episodes - len(seen)


def dimension_table(trajectories: Trajectories, task: Task | None = None) -> pd.DataFrame:
    """The range of every column of the observations and actions, see `describe`."""
    parts = {
        "observation": (trajectories.observations, observation_names(task) if task else ()),
        "action": (trajectories.actions, action_names(task) if task else ()),
    }
    tables = []
    for kind, (values, names) in parts.items():
        width = values.shape[1]
        fitting = len(names) == width
        labels = {
            "dimension": [f"{kind} {j}" for j in range(width)],
            "name": list(names) if fitting else [""] * width,
        }
        tables.append(pd.DataFrame({**labels, **_moments(values)}))
    return pd.concat(tables, ignore_index=True)


def episode_table(trajectories: Trajectories) -> pd.DataFrame:
    """One row per episode: `episode`, `steps`, `return`, `terminated`, `truncated`."""
    last = trajectories.step_offsets[1:] - 1
    return pd.DataFrame(
        {
            "episode": np.arange(trajectories.num_episodes),
            "steps": trajectories.lengths,
            "return": trajectories.returns,
            "terminated": trajectories.terminations[last],
            "truncated": trajectories.truncations[last],
        }
    )


def visits(trajectories: Trajectories, task: Task, resolution: int = 1) -> NDArray[np.int64]:
    """Count the visits to every part of a maze.

    Args:
        trajectories: Positions are the first two columns of the observations.
        task: A maze task.
        resolution: n, squares per cell on each axis.

    Returns:
        (n * rows, n * columns) counts in the order of the map: row 0 is the map's first row. Positions outside
        the map are not counted.
    """
    assert task.maze_map is not None, "only mazes can be divided into cells"
    rows, columns = len(task.maze_map) * resolution, len(task.maze_map[0]) * resolution
    corner = task.cell_to_xy((-0.5, -0.5))
    step = (task.cell_to_xy((0.5, 0.5)) - corner) / resolution  # along x and down the map, with their signs
    counts = np.zeros(rows * columns, np.int64)
    for block in _blocks(trajectories.observations[:, :2]):
        j, i = np.floor((block - corner) / step).astype(np.int64).T
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        counts += np.bincount(i[inside] * columns + j[inside], minlength=rows * columns)
    return counts.reshape(rows, columns)


def _visited(trajectories: Trajectories, task: Task) -> int:
    counts = visits(trajectories, task)
    return sum(bool(counts[cell]) for cell in task.free_cells())


def _moments(values: NDArray[np.float32]) -> dict[str, NDArray[np.float64]]:
    """Lowest, mean, standard deviation and highest of each column (N, D)."""
    origin = values[0].astype(np.float64)  # sums of squares around a value of the data lose no digits
    total, squares = np.zeros_like(origin), np.zeros_like(origin)
    for block in _blocks(values):
        away = block - origin
        total += away.sum(axis=0)
        squares += np.einsum("nd,nd->d", away, away)
    mean = total / len(values)
    return {
        "lowest": values.min(axis=0).astype(np.float64),
        "mean": origin + mean,
        "std": np.sqrt(np.maximum(squares / len(values) - mean**2, 0.0)),
        "highest": values.max(axis=0).astype(np.float64),
    }


def _blocks(values: NDArray[np.float32]) -> Iterator[NDArray[np.float64]]:
    for first in range(0, len(values), BLOCK):
        yield values[first : first + BLOCK].astype(np.float64)
