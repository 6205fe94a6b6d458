"""Converts observations as environments record them to the flat ones of the task table; no other file does.

| layout | what is recorded at a step | flat observation |
|---|---|---|
| flat | Box (O,) | as it is |
| pointmaze | Dict: `observation` (4,) | `observation` |
| antmaze | Dict: `achieved_goal` (2,), `observation` (27,), in v5 (105,) with contact forces | both, 27 of the second |
| kitchen | Dict: `observation` (59,) | positions of robot and objects (30), goal of the subtasks (30) |
| a task's `observation_keys` | Dict: any arrays | those that the task names, end to end |

The goals of a recording are left out, unless the task names them: a task of the table has only one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dds_lightning.envs.kitchen import goal_vector, kitchen_layout
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import BODIES, Part, body_name

FLAT = "flat"
"""Layout of observations that are one array."""


class Layout(NamedTuple):
    """How the observations of one recording are flattened.

    Attributes:
        name: `FLAT`, or a robot of `tasks.bodies`.
        width: O of flat observations; None accepts any.
        subtasks: In the kitchen, the subtasks of the goal.
        keys: The task's `observation_keys`.
    """

    name: str
    width: int | None = None
    subtasks: Sequence[str] = ()
    keys: tuple[str, ...] = ()

    @property
    def parts(self) -> Mapping[str, Part]:
        """The arrays that are read from a dictionary; none where the observation is one array."""
        if self.name == FLAT:
            return dict.fromkeys(self.keys, Part((), None))
        return BODIES[self.name].parts

    def fits(self, space: Mapping[str, Any]) -> bool:
        """Whether the observations of a space (Minari's JSON) have this layout."""
        if not self.parts:
            shape = box_shape(space) or ()
            return len(shape) == 1 and self.width in (None, *shape)
        shapes = {name: box_shape(inner) for name, inner in _subspaces(space).items()}
        if self.keys:
            found = [shapes.get(key) or () for key in self.keys]
            return all(len(shape) == 1 for shape in found) and sum(map(sum, found)) == self.width
        return all(shapes.get(name) in [(width,) for width in part.widths] for name, part in self.parts.items())

    def __str__(self) -> str:
        """The space, for messages."""
        if not self.parts:
            return f"a Box ({'any' if self.width is None else self.width},)"
        if self.keys:
            return f"a Dict with {', '.join(self.keys)} of {self.width} columns in all"
        shapes = (f"{name} {' or '.join(f'({width},)' for width in part.widths)}" for name, part in self.parts.items())
        return f"a Dict of {', '.join(shapes)}"

    def flatten(self, arrays: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """The flat observations of one episode.

        Args:
            arrays: Those of `parts`, (T + 1, columns) each.

        Returns:
            (T + 1, O) in the type of the arrays.
        """
        columns = list(arrays.values())
        if self.name == "kitchen":
            positions = kitchen_layout(arrays["observation"])
            columns = [positions, np.tile(goal_vector(self.subtasks), (len(positions), 1))]
        return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)


def task_layout(task: Task) -> Layout:
    """The layout of recordings of a task's environments."""
    name = FLAT if task.adapter == "flat" else body_name(task)
    return Layout(name, task.observation_dim, task.subtasks, task.observation_keys)


def find_layout(space: Mapping[str, Any], subtasks: Sequence[str]) -> Layout | None:
    """The layout of a space when the task is unknown; None if it is not one of ours."""
    names = (FLAT, *(name for name, body in BODIES.items() if body.parts))
    return next((layout for name in names if (layout := Layout(name, subtasks=subtasks)).fits(space)), None)


def describe_space(space: Mapping[str, Any]) -> str:
    """A short description of a space, for messages."""
    inner = _subspaces(space)
    if inner:
        return f"a Dict of {', '.join(f'{name} {_size(one)}' for name, one in list(inner.items())[:6])}"
    return f"a Box {_size(space)}" if space.get("type") == "Box" else f"a {space.get('type')}"


def box_shape(space: Any) -> tuple[int, ...] | None:
    """Shape of a Box in Minari's JSON; None for anything else."""
    if not isinstance(space, Mapping) or space.get("type") != "Box" or not isinstance(space.get("shape"), list):
        return None
    sizes = space["shape"]
    return tuple(sizes) if all(type(size) is int and size >= 0 for size in sizes) else None


def _subspaces(space: Mapping[str, Any]) -> dict[str, Any]:
    inner = space.get("subspaces") if space.get("type") == "Dict" else None
    return inner if isinstance(inner, dict) else {}


def _size(space: Any) -> str:
    if not isinstance(space, Mapping):
        return "without a space"
    return str(box_shape(space) or space.get("shape")) if space.get("type") == "Box" else str(space.get("type"))
