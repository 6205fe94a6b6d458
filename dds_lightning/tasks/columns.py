"""What each number of an observation and of an action is, by name.

Names follow the joints and motors of the MuJoCo models, in the models' order; a test compares the two.
"""

from __future__ import annotations

from typing import NamedTuple

from dds_lightning.tasks.task import Task


class _Body(NamedTuple):
    """Names of one body's numbers.

    Attributes:
        observations: O names with their units.
        actions: A names.
    """

    observations: tuple[str, ...]
    actions: tuple[str, ...]


def observation_names(task: Task) -> tuple[str, ...]:
    """Name and unit of each of the O columns of a task's observations, for example "x (m)"."""
    body = _BODIES.get(_body(task))
    if body is None or len(body.observations) != task.observation_dim:
        return tuple(f"observation {j}" for j in range(task.observation_dim))
    return body.observations


def action_names(task: Task) -> tuple[str, ...]:
    """What each of the A entries of a task's actions moves, for example "ankle 1"."""
    body = _BODIES.get(_body(task))
    if body is None or len(body.actions) != task.action_dim:
        return tuple(f"action {j}" for j in range(task.action_dim))
    return body.actions


def _body(task: Task) -> str:
    return task.base_name.partition("-")[0]


def _angles(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} (rad)" for joint in joints)


def _rates(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} velocity (rad/s)" for joint in joints)


def _runner(joints: tuple[str, ...]) -> _Body:
    """A body in the plane; its position along x is left out."""
    moving = ("x velocity (m/s)", "z velocity (m/s)", "pitch velocity (rad/s)")
    return _Body(("z (m)", "pitch (rad)", *_angles(joints), *moving, *_rates(joints)), joints)


_LEG = ("thigh", "leg", "foot")
_ANT = tuple(f"{joint} {leg}" for leg in (1, 2, 3, 4) for joint in ("hip", "ankle"))
_KITCHEN = (
    *_angles(tuple(f"joint {j}" for j in range(1, 8))),
    "finger 1 (m)",
    "finger 2 (m)",
    *(
        f"{place} {part}"
        for place in ("bottom right", "bottom left", "top right", "top left")
        for part in ("knob (rad)", "burner (m)")
    ),
    "light switch (rad)",
    "light (m)",
    "slide cabinet (m)",
    "left hinge cabinet (rad)",
    "right hinge cabinet (rad)",
    "microwave (rad)",
    *(f"kettle {axis} (m)" for axis in "xyz"),
    *(f"kettle quaternion {axis}" for axis in "wxyz"),
)
_BODIES = {
    "halfcheetah": _runner(tuple(f"{end} {part}" for end in ("back", "front") for part in ("thigh", "shin", "foot"))),
    "hopper": _runner(_LEG),
    "walker2d": _runner((*_LEG, *(f"left {part}" for part in _LEG))),
    "antmaze": _Body(
        (
            *("x (m)", "y (m)", "z (m)"),
            *(f"quaternion {axis}" for axis in "wxyz"),
            *_angles(_ANT),
            *(f"{axis} velocity (m/s)" for axis in "xyz"),
            *(f"spin about the body's {axis} (rad/s)" for axis in "xyz"),
            *_rates(_ANT),
        ),
        (*_ANT[6:], *_ANT[:6]),  # the model's motors begin with the fourth leg
    ),
    "pointmaze": _Body(("x (m)", "y (m)", "x velocity (m/s)", "y velocity (m/s)"), ("force along x", "force along y")),
    "kitchen": _Body(
        (*_KITCHEN, *(f"goal of {name}" for name in _KITCHEN)),
        (*(f"joint {j}" for j in range(1, 8)), "finger 1", "finger 2"),
    ),
}
