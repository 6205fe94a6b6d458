"""How each of the kitchen's subtasks is done: a few moves of the hand, and the controller that performs them in turn.

```
    Reach ► Reach ► Grasp ► Drive ► Grasp ► Reach        microwave, knobs, hinge cabinet: grasp it, take it along
    Reach ► Reach ► Carry ► Carry ► Carry ► Reach ...    kettle: fingers under the handle, lift, carry, put down
    Reach ► Reach ► Drive ► Reach                        light switch, slide cabinet: push from the side
```

The numbers were tuned by hand in the simulator: a grasp, or a side to push from, that the arm reaches without touching
anything else, then speeds and leads at which the object moves along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.collect.franka import CLOSED, OPEN, Aim, FrankaArm, Vector
from dds_lightning.envs.kitchen import subtasks_done
from dds_lightning.envs.physics import mujoco

Triple = tuple[float, float, float]
HALF_OPEN = 0.018
"""Finger opening (m) that still fits between the posts of the kettle's handle."""

PATIENCE = 12
"""Steps in which an object must come 2 % closer to its target, or else the hand has slipped off."""

TURNED = 0.2
"""A place is reached only when the hand's direction is within this many rad of the wanted one."""

LOST = 0.06
"""The kettle has slipped off when the hand has moved this far (m) away from it."""


@dataclass(frozen=True)
class Reach:
    """Bring the hand to a position relative to the handle, wherever that is now.

    Attributes:
        offset: From the handle, metres in the world.
        turn: Yaw, pitch and roll of the hand.
        opening: Of each finger, metres.
        speed: At most, m/s.
        near: Done within this many metres.
        steps: Given up after this many.
        stray: Factor on the noise of waypoints.
    """

    offset: Triple
    turn: Triple
    opening: float
    speed: float
    near: float
    steps: int
    stray: float = 1.0


@dataclass(frozen=True)
class Grasp:
    """Hold still for some steps while the fingers open or close."""

    opening: float
    steps: int


@dataclass(frozen=True)
class Drive:
    """Move a hinge or slide.

    Attributes:
        to: Value of the joint.
        enough: Share of `to` at which the move is done.
        offset: From the handle, in the world where the joint is at zero; it turns with the object.
        lead: The hand aims at most this far (rad, m) ahead of the joint.
        turn: Of the hand at the start.
        turn_end: Of the hand when the joint is at `to`.
        opening: Of each finger, metres.
        speed: At most, m/s.
        gain: Speed per distance, 1/s.
        steps: Given up after this many.
    """

    to: float
    enough: float
    offset: Triple
    lead: float
    turn: Triple
    turn_end: Triple
    opening: float = CLOSED
    speed: float = 0.4
    gain: float = 4.0
    steps: int = 40


@dataclass(frozen=True)
class Carry:
    """Move the hand by the distance of the kettle from its target `to` (metres in the world)."""

    to: Triple
    turn: Triple
    speed: float
    near: float
    steps: int
    opening: float = HALF_OPEN


Move = Reach | Grasp | Drive | Carry


class Script(NamedTuple):
    """How one subtask is done.

    Attributes:
        handle: Name of the site.
        joint: Name of the joint that moves.
        moves: The moves, in order.
        posture: (7,) joint angles that the arm drifts to.
    """

    handle: str
    joint: str
    moves: tuple[Move, ...]
    posture: tuple[float, ...]


def _knob(number: int, to: float) -> Script:
    ahead, grasp = (0.0, 0.1, 0.0), (0.0, -0.015, 0.0)
    return Script(
        f"knob{number}_site",
        f"knob_Joint_{number}",
        (
            Reach((0.0, -0.12, 0.0), ahead, OPEN, 0.6, 0.03, 45, stray=2.0),
            Reach(grasp, ahead, OPEN, 0.4, 0.015, 20, stray=0.5),
            Grasp(CLOSED, 5),
            # The hand turns further than the knob, which has play between the fingers.
            Drive(to, 0.9, grasp, 1.0, ahead, (0.0, 0.1, -1.5 * to), gain=6.0, steps=35),
            Grasp(OPEN, 4),
            Reach((0.0, -0.13, 0.0), ahead, OPEN, 0.5, 0.05, 15),
        ),
        (-1.3, -1.0, 1.5, -2.3, -0.2, 2.0, 1.2),
    )


SCRIPTS: dict[str, Script] = {
    "microwave": Script(
        "microhandle_site",
        "microwave",
        (
            Reach((0.0, -0.14, 0.0), (0.3, 0.0, 0.0), OPEN, 0.6, 0.02, 45, stray=1.5),
            Reach((0.0, 0.02, 0.0), (0.3, 0.0, 0.0), OPEN, 0.4, 0.02, 20, stray=0.5),
            Grasp(CLOSED, 6),
            Drive(-0.78, 0.97, (0.0, 0.02, 0.0), 0.3, (0.3, 0.0, 0.0), (0.75, 0.0, 0.0)),
            Grasp(OPEN, 4),
            Reach((0.08, -0.13, 0.0), (0.5, 0.0, 0.0), OPEN, 0.5, 0.05, 15),
        ),
        (-1.08, -1.7, 2.0, -1.5, -0.95, 1.1, 2.7),
    ),
    "kettle": Script(
        "kettle_site",
        "kettle",
        (
            Reach((0.0, -0.12, -0.08), (-0.2, -0.2, 0.0), HALF_OPEN, 0.6, 0.04, 45, stray=2.0),
            Reach((0.0, 0.02, -0.07), (-0.2, -0.2, 0.0), HALF_OPEN, 0.4, 0.025, 20, stray=0.5),
            Carry((-0.25, 0.36, 1.72), (-0.2, -0.2, 0.0), 0.4, 0.06, 15),
            # Level fingers: further out, pointing up would hold two joints at their limits.
            Carry((-0.23, 0.72, 1.74), (-0.3, 0.0, 0.0), 0.5, 0.07, 30),
            Carry((-0.23, 0.74, 1.61), (-0.3, 0.0, 0.0), 0.4, 0.025, 12),
            Reach((0.0, 0.0, -0.08), (-0.3, 0.0, 0.0), HALF_OPEN, 0.4, 0.02, 6, stray=0.0),
            Reach((0.0, -0.2, -0.06), (-0.3, 0.0, 0.0), HALF_OPEN, 0.6, 0.05, 15),
        ),
        (-1.1, -1.6, 2.0, -2.0, -0.4, 1.2, 2.0),
    ),
    "bottom burner": _knob(2, -0.88),
    "top burner": _knob(4, -0.92),
    "light switch": Script(
        "light_site",
        "light_switch",
        (
            Reach((0.06, -0.12, 0.0), (0.0, 0.2, 0.0), CLOSED, 0.6, 0.03, 45, stray=2.0),
            Reach((0.06, 0.0, 0.0), (0.0, 0.2, 0.0), CLOSED, 0.4, 0.02, 20),
            Drive(-0.69, 0.92, (0.0, 0.0, 0.0), 0.5, (0.0, 0.2, 0.0), (0.0, 0.2, 0.0), gain=8.0, steps=35),
            Reach((0.05, -0.15, 0.0), (0.0, 0.2, 0.0), CLOSED, 0.6, 0.05, 15),
        ),
        (-1.2, -0.9, 1.45, -2.15, -0.15, 1.75, 1.05),
    ),
    "slide cabinet": Script(
        "slide_site",
        "slide_cabinet",
        (
            Reach((-0.06, -0.14, 0.0), (-0.2, -0.3, 0.0), CLOSED, 0.7, 0.04, 50, stray=2.0),
            Reach((-0.06, -0.01, 0.0), (-0.2, -0.3, 0.0), CLOSED, 0.4, 0.02, 20),
            Drive(0.36, 1.0, (-0.04, -0.01, 0.0), 0.15, (-0.2, -0.3, 0.0), (-0.5, -0.3, 0.0), speed=0.5),
            Reach((-0.07, -0.15, 0.0), (-0.4, -0.2, 0.0), CLOSED, 0.6, 0.05, 15),
        ),
        (-0.9, -0.7, 0.95, -1.9, -0.3, 1.9, 0.8),
    ),
    "hinge cabinet": Script(
        "hinge_site2",
        "right_hinge_cabinet",
        (
            Reach((0.0, -0.14, 0.0), (-0.1, -0.3, 0.0), OPEN, 0.7, 0.04, 50, stray=2.0),
            Reach((0.0, 0.02, 0.0), (-0.1, -0.3, 0.0), OPEN, 0.4, 0.02, 20, stray=0.5),
            Grasp(CLOSED, 6),
            Drive(1.45, 0.82, (0.0, 0.02, 0.0), 0.45, (-0.1, -0.3, 0.0), (-0.5, -0.3, 0.0), steps=50),
            Grasp(OPEN, 4),
            Reach((0.0, -0.12, 0.0), (-0.4, -0.3, 0.0), OPEN, 0.5, 0.05, 15),
        ),
        (-1.1, -0.5, 1.0, -1.9, -0.3, 1.7, 0.9),
    ),
}
"""Subtask -> how it is done."""


class KitchenController:
    """Does subtasks one after the other; it observes the positions of robot and objects, as an agent does.

    A subtask that has failed is tried again from its start, up to `tries` times. `missed` lists those given up.
    """

    def __init__(self, model: mujoco.MjModel, step_seconds: float, *, tries: int = 3) -> None:
        """Prepare for a model of `FrankaKitchen-v1`, whose steps last `step_seconds`."""
        self.arm = FrankaArm(model, step_seconds)
        self.tries = tries

    def start(
        self,
        subtasks: tuple[str, ...],
        rng: np.random.Generator | None = None,
        *,
        waypoint_noise: float = 0.0,
        speed_noise: float = 0.0,
    ) -> None:
        """Begin an episode.

        Args:
            subtasks: In the order in which they are done.
            rng: Generator of the noise; not needed without noise.
            waypoint_noise: Standard deviation (m, each axis) of where the hand goes, times each move's `stray`.
            speed_noise: Each subtask is done up to this share slower or faster.
        """
        self._subtasks, self._number = subtasks, -1
        self._rng = rng or np.random.default_rng(0)
        self._waypoint_noise, self._speed_noise = waypoint_noise, speed_noise
        self.missed: list[str] = []
        self._next_subtask()

    def act(self, positions: ArrayLike) -> NDArray[np.float64] | None:
        """The next action.

        Args:
            positions: (30,) of robot and objects.

        Returns:
            (9,) in [-1, 1], or None when there is nothing left to do.
        """
        self.arm.see(positions)
        while self._number < len(self._subtasks):
            if self._index == len(self._script.moves):
                self._after_last_move(np.asarray(positions))
                continue
            move = self._script.moves[self._index]
            aim, done = self._aim(move)
            if done or self._count == move.steps:
                self._held = aim
                self._enter(self._index + 1)
                continue
            self._count += 1
            aim = replace(aim, speed=aim.speed * self._speed)
            return self.arm.action(self.arm.velocity(aim, self._script.posture), move.opening)
        return None

    @property
    def subtask(self) -> str | None:
        """The current subtask; None after the last."""
        return self._subtasks[self._number] if self._number < len(self._subtasks) else None

    def rest(self) -> NDArray[np.float64]:
        """An action that keeps the arm where `act` last saw it, (9,)."""
        return self.arm.action(np.zeros(7), OPEN)

    def _next_subtask(self) -> None:
        self._number += 1
        self._tried = 0
        if self._number < len(self._subtasks):
            self._script = SCRIPTS[self._subtasks[self._number]]
            self._speed = 1.0 + self._speed_noise * self._rng.uniform(-1.0, 1.0)
            self._enter(0)

    def _after_last_move(self, positions: NDArray[Any]) -> None:
        subtask = self._subtasks[self._number]
        self._tried += 1
        if subtasks_done(positions, [subtask])[0]:
            self._next_subtask()
        elif self._tried < self.tries:
            self._enter(0)
        else:
            self.missed.append(subtask)
            self._next_subtask()

    def _enter(self, index: int) -> None:
        """Begin a move of the subtask, or the end of its moves."""
        self._index, self._count = index, 0
        self._gap: Vector | None = None
        self._best, self._best_count = 0.0, 0
        move = self._script.moves[index] if index < len(self._script.moves) else None
        if isinstance(move, Reach):  # what follows keeps the error with which the handle was reached
            self._error = self._waypoint_noise * move.stray * self._rng.standard_normal(3)

    def _aim(self, move: Move) -> tuple[Aim, bool]:
        """Where the hand should move now, and whether it has arrived there."""
        arm = self.arm
        point, _ = arm.hand()
        if isinstance(move, Grasp):
            return replace(self._held, speed=0.3), False
        if isinstance(move, Reach):
            aim = Aim(arm.site(self._script.handle) + move.offset + self._error, move.turn, move.speed)
            distance, angle = arm.error(aim)
            return aim, bool(np.linalg.norm(distance) < move.near and np.linalg.norm(angle) < TURNED)
        if isinstance(move, Carry):
            return self._carrying(move, point)
        return self._driving(move)

    def _carrying(self, move: Carry, point: Vector) -> tuple[Aim, bool]:
        gap = point - self.arm.site(self._script.handle)
        if self._gap is None:
            self._gap = gap
        lack = np.asarray(move.to) - self.arm.data.joint(self._script.joint).qpos[:3]
        lost = bool(np.linalg.norm(gap - self._gap) > LOST)
        if lost:
            self._index = len(self._script.moves) - 2  # the hand retreats next
        return Aim(point + lack, move.turn, move.speed), lost or bool(np.linalg.norm(lack) < move.near)

    def _driving(self, move: Drive) -> tuple[Aim, bool]:
        arm, joint = self.arm, self._script.joint
        value = float(arm.data.joint(joint).qpos[0])
        # A tenth further than the target: the hand must still pull when it has nearly arrived.
        ahead = float(np.clip(1.1 * move.to - value, -move.lead, move.lead))
        handle = arm.site(self._script.handle)
        at_zero = arm.moved(joint, handle, -value)
        target = arm.moved(joint, at_zero + move.offset + self._error, value + ahead)
        share = float(np.clip((value + ahead) / move.to, 0.0, 1.1))
        yaw, pitch, roll = (a + share * (b - a) for a, b in zip(move.turn, move.turn_end, strict=True))
        if value / move.to > self._best + 0.02:
            self._best, self._best_count = value / move.to, self._count
        done = value / move.to >= move.enough or self._count - self._best_count >= PATIENCE
        return Aim(target, (yaw, pitch, roll), move.speed, move.gain), done
