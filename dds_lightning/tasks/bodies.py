"""One row per robot: what its observations and actions hold, and how they relate to the simulator's state.

A new robot is a row of `BODIES` and, for pictures, one of `interpret.views.VIEWS`; a task's robot is the first part of
its name, unless `Task.body` says otherwise. A robot without a row trains and acts all the same, but its columns have no
names, and whatever needs the simulator's state raises an error.

Names of columns follow the joints and motors of the MuJoCo models, in the models' order; a test compares the two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError

if TYPE_CHECKING:
    from dds_lightning.tasks.task import Task

Floats = NDArray[np.float64]


class StateLayout(NamedTuple):
    """Which of W recorded numbers are the simulator's state.

    Attributes:
        names: W names with units.
        positions: Columns with qpos, in its order.
        velocities: Columns with qvel; empty if they are not recorded.
        degrees: Number of entries of qvel.
        hidden: Number of entries of qpos before the recorded ones.
        speed_limit: Recorded velocities are cut to +-this.
        lead: How many steps earlier a replay begins, so that estimated initial velocities no longer matter.
        noisy: Whether states were recorded with noise.
        judged: How many of the first columns decide whether a recording fits; None takes all. In the kitchen they are
            the robot's: pushing an object turns noise in the robot's position into arbitrary errors.
    """

    names: tuple[str, ...]
    positions: tuple[int, ...]
    velocities: tuple[int, ...]
    degrees: int
    hidden: int = 0
    speed_limit: float = np.inf
    lead: int = 0
    noisy: bool = False
    judged: int | None = None

    def observe(self, qpos: Floats, qvel: Floats) -> Floats:
        """Return the W numbers that a recording holds for a state, without noise."""
        seen = np.zeros(len(self.names))
        seen[list(self.positions)] = qpos[self.hidden :]
        seen[list(self.velocities)] = np.clip(qvel, -self.speed_limit, self.speed_limit)[: len(self.velocities)]
        return seen


class Part(NamedTuple):
    """One array of a dictionary observation.

    Attributes:
        widths: Widths that the array may have; empty for any.
        columns: How many of its first columns are read; None for all.
    """

    widths: tuple[int, ...]
    columns: int | None


@dataclass(frozen=True)
class Body:
    """A robot.

    Attributes:
        observations: O names with units; empty if unnamed.
        actions: A names.
        layouts: Width of a recorded row -> where the simulator's state is in it; key 0 for any other width.
        parts: The arrays of a dictionary observation, in order; empty if the observation is one array.
        moves: What counts as its movement: "course", its speed along x and its height; "plane", its first two
            observations; "joints", the columns `moving`; or everything it observes.
        moving: First column and the one after the last for "joints".
        heading: Column of its quaternion (w first) if it turns about a vertical axis; None if it does not.
        rest: Observations that are not 0 when it stands still, by column.
        falls: Whether an episode ends when it falls, and its rewards distinguish versions of the environment.
        walks_on: Whether D4RL's recordings continue through terminals, which were computed afterwards.
        heights: Range of the median of the first observation, to distinguish robots of the same widths.
        d4rl: Folder on D4RL's server and the version that its files' names end in.
    """

    observations: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    layouts: Mapping[int, StateLayout] = field(default_factory=dict)
    parts: Mapping[str, Part] = field(default_factory=dict)
    moves: Literal["course", "plane", "joints", "everything"] = "everything"
    moving: tuple[int, int] | None = None
    heading: int | None = None
    rest: Mapping[int, float] = field(default_factory=dict)
    falls: bool = False
    walks_on: bool = False
    heights: tuple[float, float] = (-np.inf, np.inf)
    d4rl: tuple[str, str] | None = None


def body_of(task: Task) -> Body:
    """Return the robot of a task; one without names if `BODIES` has no such row."""
    return BODIES.get(body_name(task), _UNKNOWN)


def body_name(task: Task) -> str:
    """Name of a task's robot."""
    return task.body or task.base_name.partition("-")[0]


def observation_names(task: Task) -> tuple[str, ...]:
    """Name and unit of each of the O columns of a task's observations, for example "x (m)"."""
    names = body_of(task).observations
    return (
        names if len(names) == task.observation_dim else tuple(f"observation {j}" for j in range(task.observation_dim))
    )


def action_names(task: Task) -> tuple[str, ...]:
    """What each of the A entries of a task's actions moves, for example "ankle 1"."""
    width, names = task.action_dim, body_of(task).actions
    return names if len(names) == width else tuple(f"action {j}" for j in range(width))


def has_state(task: Task) -> bool:
    """Whether the simulator's state can be read from an observation."""
    return bool(body_of(task).layouts)


def state_layout(task: Task, width: int) -> StateLayout:
    """Return where the simulator's state is in a recorded row.

    Args:
        task: Any task.
        width: Width of the row, which distinguishes the kitchen's two layouts.

    Raises:
        UserError: The robot has no layout.
    """
    layouts = body_of(task).layouts
    if not layouts:
        raise UserError(
            f"task '{task.name}': nothing says which observations are the simulator's positions and velocities, so no "
            "recorded state can be simulated; give `positions` and `velocities` in its task file, or a row of "
            "dds_lightning/tasks/bodies.py"
        )
    return layouts.get(width, layouts[0])


# ---------------------------------------------------------------------- the rows


def _angles(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} (rad)" for joint in joints)


def _rates(joints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{joint} velocity (rad/s)" for joint in joints)


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


def _columns(names: tuple[str, ...], positions: int, hidden: int = 0, speed_limit: float = np.inf) -> StateLayout:
    """All positions, then all velocities."""
    width = len(names)
    return StateLayout(
        names, tuple(range(positions)), tuple(range(positions, width)), width - positions, hidden, speed_limit
    )


def _runner(
    joints: tuple[str, ...], speed_limit: float = np.inf, heights: tuple[float, float] = (-np.inf, np.inf)
) -> Body:
    """A body in the plane; its position along x is left out."""
    moving = ("x velocity (m/s)", "z velocity (m/s)", "pitch velocity (rad/s)")
    names = ("z (m)", "pitch (rad)", *_angles(joints), *moving, *_rates(joints))
    return Body(
        observations=names,
        actions=joints,
        layouts={0: _columns(names, len(names) // 2, 1, speed_limit)},
        moves="course",
        falls=True,
        heights=heights,
        d4rl=("gym_mujoco_v2", "v2"),
    )


def _kitchen() -> Body:
    """D4RL's recordings hold 30 positions and the goal; Minari's 59 numbers the velocities too."""
    rates = tuple(f"{name.partition(' (')[0]} velocity" for name in _KITCHEN[:26])
    rates += tuple(f"kettle spin about {axis}" for axis in "xyz")
    columns = (*range(9), *range(18, 39)), (*range(9, 18), *range(39, 59))
    names = (*_KITCHEN[:9], *rates[:9], *_KITCHEN[9:], *rates[9:])
    return Body(
        observations=(*_KITCHEN, *(f"goal of {name}" for name in _KITCHEN)),
        actions=(*(f"joint {j}" for j in range(1, 8)), "finger 1", "finger 2"),
        layouts={
            0: StateLayout(_KITCHEN, tuple(range(30)), (), 29, lead=3, noisy=True, judged=9),
            59: StateLayout(names, *columns, 29, noisy=True, judged=18),
        },
        parts={"observation": Part((59,), 59)},
        moves="joints",
        moving=(0, 9),
        d4rl=("kitchen", "v0"),
    )


_UNKNOWN = Body()
_ANT_NAMES = (
    *("x (m)", "y (m)", "z (m)"),
    *(f"quaternion {axis}" for axis in "wxyz"),
    *_angles(_ANT),
    *(f"{axis} velocity (m/s)" for axis in "xyz"),
    *(f"spin about the body's {axis} (rad/s)" for axis in "xyz"),
    *_rates(_ANT),
)
_POINT_NAMES = ("x (m)", "y (m)", "x velocity (m/s)", "y velocity (m/s)")

BODIES: dict[str, Body] = {
    "halfcheetah": _runner(
        tuple(f"{end} {part}" for end in ("back", "front") for part in ("thigh", "shin", "foot")), heights=(-1.0, 0.8)
    ),
    "hopper": _runner(_LEG, speed_limit=10.0),
    # A walker below 0.8 m has fallen; its widths are the cheetah's.
    "walker2d": _runner((*_LEG, *(f"left {part}" for part in _LEG)), speed_limit=10.0, heights=(0.8, 2.0)),
    "antmaze": Body(
        observations=_ANT_NAMES,
        actions=(*_ANT[6:], *_ANT[:6]),  # the model's motors begin with the fourth leg
        layouts={0: _columns(_ANT_NAMES, 15)},
        parts={"achieved_goal": Part((2,), 2), "observation": Part((27, 105), 27)},
        moves="plane",
        heading=3,
        rest={2: 0.75, 3: 1.0},
        walks_on=True,
        d4rl=("ant_maze_v2", "v2"),
    ),
    "pointmaze": Body(
        observations=_POINT_NAMES,
        actions=("force along x", "force along y"),
        layouts={0: _columns(_POINT_NAMES, 2)},
        parts={"observation": Part((4,), 4)},
        moves="plane",
    ),
    "kitchen": _kitchen(),
}
"""Name of a robot -> its row."""
