"""An Ant that follows a commanded heading: what its policy observes, and the controller.

Frames. The world frame is the simulator's: x, y on the floor, z up; headings are angles from +x towards +y in
radians. (D4RL's mazes and gymnasium-robotics' are drawn with opposite y, which does not matter here: a heading is
`atan2(dy, dx)` of the direction to walk in, in the coordinates of the observation.) The body frame is the torso's. The
yaw frame is the world frame turned about z until its x lies above the body's x.

Symmetry. The Ant looks the same after a quarter turn about its own z. So the policy only ever sees a body whose x
points within 45 degrees of the heading: of the four ways to number its legs the best one is taken, and the actions
are mapped back to the real legs. One gait then serves every direction, and the Ant never has to turn round.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.behaviours.policy import MLPPolicy
from datamodules.behaviours.shipped import SHIPPED
from dds_lightning.errors import UserError

OBSERVATION_DIM = 29
"""qpos (x, y, z, quaternion w x y z, hip and ankle of four legs) and qvel (3 linear in the world frame, 3 angular in
the body frame, hip and ankle of four legs)."""
FEATURES = 28
PHYSICS = ("d4rl", "robotics")
ANKLE_SIGN = np.array([1.0, -1.0, -1.0, 1.0])
"""The ankles' axes do not turn with the legs: legs 2 and 3 bend with negative angles."""
MOTOR_LEGS = np.array([3, 0, 1, 2])
"""The motors' order: hip and ankle of the fourth leg, then of the first, second and third."""

Array = NDArray[np.float64]


def rotation_matrices(quaternions: Array) -> Array:
    """Rotation matrices (B, 3, 3) of quaternions (B, 4) w, x, y, z; columns are the body's axes in the world frame."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def see(observations: Array, headings: Array) -> tuple[Array, NDArray[np.int64]]:
    """What the policy observes, in the numbering of legs whose x is nearest to the heading.

    Args:
        observations: Array (B, 29), see `OBSERVATION_DIM`.
        headings: Array (B,), radians in the world frame.

    Returns:
        Array (B, 28): z; direction of gravity in the body frame (3); hips and ankles (4 + 4); linear velocity in the
        yaw frame (3); angular velocity in the body frame (3); velocities of hips and ankles (4 + 4); cosine and
        sine of the heading in the yaw frame (2). And the number of quarter turns (B,), for `motor_actions`.
    """
    rotation = rotation_matrices(observations[:, 3:7])
    towards = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    flat = rotation[:, :2, :2] / (np.linalg.norm(rotation[:, :2, :2], axis=1, keepdims=True) + 1e-9)
    along = np.einsum("bi,bij->bj", towards, flat)
    turns = np.argmax(np.concatenate([along, -along], axis=1), axis=1)  # body axes +x, +y, -x, -y

    row = np.arange(len(turns))
    forward = np.where((turns < 2)[:, None], 1.0, -1.0) * flat[row, :, turns % 2]  # (B, 2) cosine and sine of the yaw
    legs = (np.arange(4) + turns[:, None]) % 4
    signs = ANKLE_SIGN[legs] * ANKLE_SIGN
    hips = slice(0, None, 2), slice(1, None, 2)
    angles, speeds = observations[:, 7:15], observations[:, 21:29]
    features = [
        observations[:, 2:3],
        _turned(-rotation[:, 2, :], turns),
        np.take_along_axis(angles[:, hips[0]], legs, 1),
        np.take_along_axis(angles[:, hips[1]], legs, 1) * signs,
        _in_frame(observations[:, 15:17], forward),
        observations[:, 17:18],
        _turned(observations[:, 18:21], turns),
        np.take_along_axis(speeds[:, hips[0]], legs, 1),
        np.take_along_axis(speeds[:, hips[1]], legs, 1) * signs,
        _in_frame(towards, forward),
    ]
    return np.concatenate(features, axis=1), turns


def motor_actions(actions: ArrayLike, turns: NDArray[np.int64]) -> Array:
    """Map actions (B, 8), hips then ankles in the policy's numbering, to the simulator's motors (B, 8)."""
    actions = np.asarray(actions, dtype=np.float64)
    legs = (MOTOR_LEGS - turns[:, None]) % 4
    signs = ANKLE_SIGN[MOTOR_LEGS] * ANKLE_SIGN[legs]
    out = np.empty_like(actions)
    out[:, 0::2] = np.take_along_axis(actions[:, :4], legs, 1)
    out[:, 1::2] = np.take_along_axis(actions[:, 4:], legs, 1) * signs
    return out


def _turned(vectors: Array, turns: NDArray[np.int64]) -> Array:
    """Vectors (B, 3) of the body frame after the body's axes advanced by quarter turns."""
    x, y = vectors[:, 0], vectors[:, 1]
    around = np.stack([x, y, -x, -y], axis=1)
    row = np.arange(len(turns))
    return np.stack([around[row, turns], around[row, (turns + 1) % 4], vectors[:, 2]], axis=1)


def _in_frame(vectors: Array, forward: Array) -> Array:
    """Vectors (B, 2) of the world in the frame whose x is `forward` (B, 2)."""
    x, y = vectors.T
    cosine, sine = forward.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=1)


def check_physics(physics: str) -> None:
    """Refuse a physics that is not one of `PHYSICS`.

    Raises:
        UserError: There is no such physics.
    """
    if physics not in PHYSICS:
        raise UserError(f"physics: got '{physics}', expected one of {', '.join(PHYSICS)}")


class AntController:
    """A controller that walks in commanded directions.

    Args:
        physics: "d4rl" (`dds/AntMazeD4RL_*`) or "robotics" (`AntMaze_*-v4`), the physics it was trained in.
        directory: The folder of `<physics>.safetensors`; by default the shipped one.

    Raises:
        UserError: There is no such physics.
        DataError: The policy's file is missing or damaged.
    """

    def __init__(self, physics: str, directory: str | Path | None = None) -> None:
        check_physics(physics)
        self.policy = MLPPolicy.load(Path(directory or SHIPPED / "ant") / f"{physics}.safetensors")

    def act(self, observations: ArrayLike, headings: ArrayLike) -> Array:
        """Compute actions that walk along the headings.

        Args:
            observations: Array (B, 29): qpos[:15] and qvel[:14], as in AntMaze tasks.
            headings: Array (B,), radians in the world frame, from +x towards +y.

        Returns:
            Array (B, 8) in [-1, 1], in the simulator's order.
        """
        seen, turns = see(np.asarray(observations, dtype=np.float64), np.asarray(headings, dtype=np.float64))
        return motor_actions(self.policy.act(seen), turns)
