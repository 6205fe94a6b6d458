"""The kitchen's Franka arm: where its fingers are, and the actions that move them to where they should be.

```
    aim ──► hand's velocity ──► joint velocities ──────────────────► actions
            proportional, with  damped least squares; spare motion   the torque that the velocity and gravity
            a speed limit       pulls towards a posture              need, as an offset of the position servo
```
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dds_lightning.envs.physics import mujoco

Vector = NDArray[np.float64]

GRASP_DEPTH = 0.03
"""Distance (m) of the steered point, between the finger pads, in front of the site `end_effector`."""

OPEN, CLOSED = 0.04, 0.0
"""Finger openings (m, each finger): fully open, and closed with full force."""

FULL_ACTION = 2.0
"""rad/s (m/s for fingers) that an action of 1 asks for."""

LOWEST = np.array([-2.85, -1.75, -2.85, -3.03, -2.85, 0.02, -2.85])
"""Joint angles (rad) within both the model's limits and the environment's; the sixth joint's lower end is the
environment's, which is narrower."""

HIGHEST = np.array([2.85, 1.74, 2.85, -0.45, 2.85, 2.07, 2.85])

ROTATION_WEIGHT = 0.2
"""Metres of position error that one radian of orientation error counts as."""


@dataclass(frozen=True)
class Aim:
    """Where the hand should be, and how it gets there.

    Attributes:
        point: (3,) metres, of the point between the finger pads, in the world.
        turn: Yaw (left), pitch (down) and roll of the hand in rad; at zero it points along the world's y axis,
            into the kitchen, and its fingers open along x.
        speed: At most this many m/s.
        gain: Speed per distance, 1/s.
    """

    point: Vector
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed: float = 0.5
    gain: float = 4.0


class FrankaArm:
    """Kinematics and inverse dynamics of the arm, computed from positions only, in a separate scene."""

    def __init__(self, model: mujoco.MjModel, step_seconds: float) -> None:
        """Prepare for a model of the kitchen.

        Args:
            model: Model of `FrankaKitchen-v1`; it is not changed.
            step_seconds: Duration of an environment step.
        """
        self.model, self.step_seconds = model, step_seconds
        self.data = mujoco.MjData(model)
        self._site = model.site("end_effector").id
        self._body = int(model.site_bodyid[self._site])
        self._stiffness = model.actuator_gainprm[:7, 0].copy()
        self._gravity = np.zeros(model.nv)
        self._linear, self._angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        # Offset of the servo's target per joint velocity: damping needs a torque, and the target stays in place for a
        # whole step while the joint moves.
        self._offset = model.dof_damping[:7] / self._stiffness + step_seconds / 2

    def see(self, positions: ArrayLike) -> None:
        """Set the state of the scene.

        Args:
            positions: (30,) positions of robot and objects.
        """
        self.data.qpos[:] = positions
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_rne(self.model, self.data, 0, self._gravity)

    def hand(self) -> tuple[Vector, NDArray[np.float64]]:
        """The point between the finger pads (3,), and the hand's axes as columns (3, 3)."""
        axes = self.data.site_xmat[self._site].reshape(3, 3)
        return self.data.site_xpos[self._site] + GRASP_DEPTH * axes[:, 2], axes

    def site(self, name: str) -> Vector:
        """Where a site is, (3,)."""
        return np.array(self.data.site(name).xpos)

    def moved(self, joint: str, point: Vector, by: float) -> Vector:
        """Where a point of an object moves to when the object's hinge or slide moves.

        Args:
            joint: Name of the hinge or slide.
            point: (3,) in the world.
            by: Radians or metres.
        """
        number = self.model.joint(joint).id
        axis, anchor = self.data.xaxis[number], self.data.xanchor[number]
        if self.model.jnt_type[number] == mujoco.mjtJoint.mjJNT_SLIDE:
            return point + by * axis
        return anchor + _rotated(point - anchor, axis, by)

    def error(self, aim: Aim) -> tuple[Vector, Vector]:
        """The distance of the hand from its aim: (3,) metres, and a rotation vector (3,) in rad, both in the world."""
        point, axes = self.hand()
        return aim.point - point, _rotation_vector(pointing(*aim.turn) @ axes.T)

    def velocity(self, aim: Aim, posture: ArrayLike) -> Vector:
        """Joint velocities that bring the hand to its aim.

        Args:
            aim: Of the hand.
            posture: (7,) joint angles that the arm drifts to as far as that does not move the hand.

        Returns:
            (7,) rad/s; joints at their limits do not move further.
        """
        point, _ = self.hand()
        distance, angle = self.error(aim)
        mujoco.mj_jac(self.model, self.data, self._linear, self._angular, point, self._body)
        jacobian = np.concatenate([self._linear[:, :7], ROTATION_WEIGHT * self._angular[:, :7]])
        linear = _at_most(aim.gain * distance, aim.speed)
        angular = _at_most(aim.gain * angle, 1.5)
        wanted = np.concatenate([linear, ROTATION_WEIGHT * angular])
        angles = self.data.qpos[:7]
        drift = np.clip(np.asarray(posture) - angles, -0.5, 0.5)
        free = np.ones(7, bool)
        while True:
            movable = jacobian * free
            inverse = movable.T @ np.linalg.inv(movable @ movable.T + 3e-4 * np.eye(6))
            velocity = inverse @ wanted + free * drift - inverse @ (movable @ drift)
            stuck = ((angles <= LOWEST + 0.02) & (velocity < 0)) | ((angles >= HIGHEST - 0.02) & (velocity > 0))
            if not (free & stuck).any():
                return velocity * free
            free &= ~stuck

    def action(self, velocity: Vector, opening: float) -> Vector:
        """The action that gives the joints a velocity for one step.

        The environment moves the targets of position servos and starts each step from where the joints are, so that an
        action of zero lets the arm sink. The action compensates for that; where it would leave the box, the arm moves
        more slowly.

        Args:
            velocity: (7,) rad/s.
            opening: Of each finger in metres.

        Returns:
            (9,) in [-1, 1].
        """
        reach = FULL_ACTION * self.step_seconds
        lift = self._gravity[:7] / self._stiffness
        move = self._offset * velocity
        move /= max(1.0, float((np.abs(move) / (reach - np.abs(lift))).max()))
        if opening in (OPEN, CLOSED):
            fingers = np.full(2, 1.0 if opening == OPEN else -1.0)
        else:
            fingers = (opening - self.data.qpos[7:9]) / reach
        return np.clip(np.concatenate([(move + lift) / reach, fingers]), -1.0, 1.0)


def pointing(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """The hand's axes as columns (3, 3): the last points where the fingers do, the second is the one they open along.

    Args:
        yaw: To the left, rad.
        pitch: Downwards, rad.
        roll: About the fingers' direction, rad.
    """
    forward = np.array([-math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch), -math.sin(pitch)])
    across = _rotated(np.array([math.cos(yaw), math.sin(yaw), 0.0]), forward, roll)
    return np.stack([np.cross(across, forward), across, forward], axis=1)


def _rotated(vector: Vector, axis: Vector, angle: float) -> Vector:
    """Rodrigues' formula."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(vector * cos + np.cross(axis, vector) * sin + axis * (axis @ vector) * (1.0 - cos))


def _rotation_vector(rotation: NDArray[Any]) -> Vector:
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector


def _at_most(vector: Vector, length: float) -> Vector:
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-9))
