"""The kitchen's 60 numbers and its subtasks: facts of D4RL's kitchen, shared by environments and data.

```
 0        9                  30                 60
 │ robot  │ objects          │ goal             │     positions only; the goal is 0 except for the four subtasks
```
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SUBTASK_RADIUS = 0.3
"""A subtask is done when its object lies within this (norm) of its goal."""

SUBTASKS: dict[str, tuple[tuple[int, ...], tuple[float, ...]]] = {
    "bottom burner": ((11, 12), (-0.88, -0.01)),
    "top burner": ((15, 16), (-0.92, -0.01)),
    "light switch": ((17, 18), (-0.69, -0.05)),
    "slide cabinet": ((19,), (0.37,)),
    "hinge cabinet": ((20, 21), (0.0, 1.45)),
    "microwave": ((22,), (-0.75,)),
    "kettle": ((23, 24, 25, 26, 27, 28, 29), (-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06)),
}
"""Subtask -> its columns of the observation, and their values when it is done."""


def kitchen_layout(observation: ArrayLike) -> NDArray[Any]:
    """Return the positions of robot and objects from gymnasium-robotics' observation.

    Args:
        observation: (..., 59) robot positions 9 and velocities 9, object positions 21 and velocities 20.

    Returns:
        (..., 30).
    """
    observation = np.asarray(observation)
    return np.concatenate([observation[..., :9], observation[..., 18:39]], axis=-1)


def goal_vector(subtasks: Sequence[str]) -> NDArray[np.float64]:
    """Return the 30 goal numbers of some subtasks."""
    goal = np.zeros(30)
    for name in subtasks:
        columns, values = SUBTASKS[name]
        goal[list(columns)] = values
    return goal


def subtasks_done(observations: ArrayLike, subtasks: Sequence[str]) -> NDArray[np.bool_]:
    """Return which subtasks are done in some states.

    Args:
        observations: (..., 30 or 60).
        subtasks: M names.

    Returns:
        (..., M).
    """
    observations = np.asarray(observations, dtype=np.float64)
    done = []
    for name in subtasks:
        columns, values = SUBTASKS[name]
        away = np.linalg.norm(observations[..., list(columns)] - np.asarray(values), axis=-1)
        done.append(away < SUBTASK_RADIUS)
    return np.stack(done, axis=-1)
