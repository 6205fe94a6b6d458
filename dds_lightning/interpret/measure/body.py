"""Where a body's limbs and joints are, from the simulator's model: the basis of stick figures.

```
 qpos (T, nq) ──► mj_kinematics ──► limbs (T, L, 2, 3): both ends of every limb's capsule
                                    joints (T, J, 3):   every joint between limbs
```

No picture is rendered, so no graphics driver is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.envs.physics import mujoco
from dds_lightning.interpret.views import view_of
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of

ARM = 9
"""Number of joints of the kitchen's robot; the joints after them move its objects."""

THINGS = {
    "slidelink": "slide cabinet",
    "hingeleftdoor": "hinge cabinet",
    "hingerightdoor": "hinge cabinet",
    "microdoorroot": "microwave",
    "kettle": "kettle",
    "lightswitchroot": "light switch",
    "lightblock_hinge": "light",
}
"""Bodies of the kitchen's model -> their labels; knobs and burners keep their names."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BodyFrames:
    """A body at T moments.

    Attributes:
        limbs: (T, L, 2, 3) metres, both ends of every limb, which coincide for a ball.
        widths: (L,) metres, their thickness.
        joints: (T, J, 3) metres, the joints between limbs.
        root: (T, 3) metres: the torso, in the kitchen the hand.
        objects: (T, M, 3) metres: the movable objects in the kitchen; M = 0 elsewhere.
        names: M names of the objects; both doors of a cabinet have its name.
    """

    limbs: Floats
    widths: Floats
    joints: Floats
    root: Floats
    objects: Floats
    names: tuple[str, ...]

    def __len__(self) -> int:
        """T."""
        return len(self.root)


def body_frames(model: Any, qpos: NDArray[Any]) -> BodyFrames:
    """Compute where limbs and joints are.

    Args:
        model: The simulator's model, for example ``env.unwrapped.model``.
        qpos: (T, nq) positions; rows after the end of a replay (NaN) are left out.
    """
    qpos = np.asarray(qpos, dtype=np.float64)
    qpos = qpos[np.isfinite(qpos).all(axis=1)]
    data = mujoco.MjData(model)
    skeleton = _Skeleton(model)
    frames: list[tuple[Floats, Floats, Floats, Floats]] = []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        frames.append(skeleton.at(data))
    limbs, joints, root, objects = (np.stack(part) for part in zip(*frames, strict=True))
    return BodyFrames(limbs, skeleton.widths, joints, root, objects, skeleton.names)


class _Skeleton:
    """The parts of a model that are limbs, joints and movable objects."""

    def __init__(self, model: Any) -> None:
        moving = model.body_weldid[model.geom_bodyid] != 0
        round_ones = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE]
        self.geoms = np.flatnonzero(moving & np.isin(model.geom_type, round_ones))
        long = model.geom_type[self.geoms] == mujoco.mjtGeom.mjGEOM_CAPSULE
        self.half = np.where(long, model.geom_size[self.geoms, 1], 0.0)
        self.arm = np.zeros(0, np.int64)
        self.objects: list[NDArray[np.int64]] = []  # geoms of each movable thing
        self.names: tuple[str, ...] = ()
        body = model.jnt_bodyid
        self.body = torso = int(body[0])
        if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE and model.body_parentid[torso] == 0:
            # An arm on a fixed base is where its tip is.
            self.body = int(np.flatnonzero(model.body_rootid == torso)[-1])
        hinges = np.flatnonzero((model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (body != torso))
        self.widths = 2 * model.geom_size[self.geoms, 0]
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "panda0_link1") >= 0:
            # The kitchen's arm is made of meshes: its limbs are the lines from joint to joint.
            self.arm = body[:ARM]
            self.body = int(self.arm[6])
            hinges = np.arange(7)
            self.widths = np.full(ARM - 1, 0.07)
            self.widths[-2:] = 0.03
            things = [int(b) for b in dict.fromkeys(body[ARM:])]
            self.objects = [np.flatnonzero(model.body_weldid[model.geom_bodyid] == b) for b in things]
            bodies = [model.body(b).name for b in things]
            self.names = tuple(THINGS.get(name, name.lower()) for name in bodies)
        self.hinges = hinges

    def at(self, data: Any) -> tuple[Floats, Floats, Floats, Floats]:
        """Return limbs (L, 2, 3), joints (J, 3), root (3,), objects (M, 3)."""
        if len(self.arm):
            place = data.xpos[self.arm]  # (9, 3)
            parents = np.minimum(np.arange(ARM - 1), 6)  # both fingers belong to the hand
            limbs = np.stack([place[parents], place[1:]], axis=1)
            root = place[7:].mean(axis=0)
        else:
            centre = data.geom_xpos[self.geoms]  # (L, 3)
            along = data.geom_xmat[self.geoms].reshape(-1, 3, 3)[:, :, 2] * self.half[:, None]
            limbs = np.stack([centre - along, centre + along], axis=1)
            root = data.xpos[self.body].copy()
        objects = np.array([data.geom_xpos[geoms].mean(axis=0) for geoms in self.objects]).reshape(-1, 3)
        return limbs, data.xanchor[self.hinges].copy(), root, objects


def root_path(task: Task, model: Any, qpos: NDArray[Any]) -> Floats:
    """Return where a body is during replays.

    Args:
        task: The environment.
        model: The environment's model.
        qpos: (N, T + 1, nq); NaN after a replay's end.

    Returns:
        (N, T + 1, D) metres: x and y in a maze, x and z of a runner, x, y and z of the kitchen's hand; NaN wherever
        `qpos` is.
    """
    if not view_of(task).hand:
        return np.asarray(qpos[..., :2], dtype=np.float64)
    flat = qpos.reshape(-1, qpos.shape[-1])
    known = np.isfinite(flat).all(axis=1)
    places = np.full((len(flat), 3), np.nan)
    if known.any():
        places[known] = body_frames(model, flat[known]).root
    return places.reshape(*qpos.shape[:-1], 3)


def to_body(task: Task, away: NDArray[Any], quaternions: NDArray[Any]) -> Floats:
    """Convert displacements to the body's frame: for an ant, ahead and to its left; unchanged for any other body.

    Args:
        task: The task that defines the body.
        away: (..., 2) along x and y; any width for bodies that do not turn.
        quaternions: (..., 4) an ant's attitude, w first; ignored for other bodies.
    """
    away = np.asarray(away, dtype=np.float64)
    if body_of(task).heading is None:
        return away
    w, x, y, z = np.moveaxis(np.asarray(quaternions, dtype=np.float64), -1, 0)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    ahead = np.cos(yaw) * away[..., 0] + np.sin(yaw) * away[..., 1]
    return np.stack([ahead, np.cos(yaw) * away[..., 1] - np.sin(yaw) * away[..., 0]], axis=-1)
