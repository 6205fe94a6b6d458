"""D4RL's AntMaze, rebuilt from Gymnasium's Ant: D4RL's files fit this physics, not that of gymnasium-robotics.

The bodies have the same mass to the gram; everything else that determines the effect of an action differs:

| | here, as D4RL | gymnasium-robotics (`@robotics`) |
|---|---|---|
| a step | 5 x 0.02 s | 5 x 0.01 s |
| torque of action 1 | 30 N m | 150 N m |
| contacts (solimp) | 0.8 0.8 0.01 | 0.9 0.95 0.001 |
| (0, 0), direction of y | start cell, down the map | middle of the maze, up the map |
| start | every coordinate and velocity of the body is noisy | at rest |
| goal | drawn for every episode, to one side of the cell's centre | the cell's centre |
| success within | 0.5 m | 0.45 m |
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from dds_lightning.envs.physics import mujoco
from dds_lightning.errors import UserError

TIMESTEP = 0.02
FRAME_SKIP = 5
TORQUE = 30.0
WALL_HEIGHT = 0.5
"""In cells; the boxes of wall cells fill their squares."""
SOLREF, SOLIMP = "0.02 1", "0.8 0.8 0.01"
POSE_NOISE = 0.1
"""Half the width of the uniform noise on every qpos at a reset, and the standard deviation of the noise on qvel."""
GOAL_NOISE = (1.0, 0.5)
"""A goal is moved from its cell's centre, on both axes, by a sum of uniform draws from 0 to each of these."""

State = NDArray[np.float64]


class D4RLAntMazeEnv(MujocoEnv, EzPickle):
    """An eight-jointed ant walks through a maze to a goal that it does not see.

    Observations (29,) are `qpos` (x, y, z, quaternion w x y z, 8 joint angles) and `qvel` (14) as the simulator
    has them; no goal and no contact forces. Actions (8,) from -1 to 1 are torques of +-30 N m; larger ones are
    cut. The reward is 1 within `goal_radius` of the goal, where the episode ends, else 0; an ant on its back
    goes on. `info` holds `position` (2,) and `goal` (2,) in metres and `success`. Facts: D4RL's source
    (commit 89141a6).

    The installed MuJoCo differs from the version that D4RL recorded with: since 2.1.2 capsules have their exact
    volume, so the same body weighs 0.911 kg instead of 0.879 kg, and the inertias of its limbs differ. Recorded
    steps are therefore reproduced approximately, not exactly.

    Args:
        maze_map: Rows of the maze, "1" wall and "0" free.
        start_cell: (row, column) whose centre is (0, 0); y grows with the row.
        goal_cell: (row, column) around which goals are drawn.
        cell_size: Side of a cell in metres.
        goal_radius: Distance in metres that counts as reaching the goal.
        reset_cell: (row, column) where episodes start; None takes `start_cell`.
        render_mode: Gymnasium's render mode; if None, textures are left out and the model builds in a few milliseconds.
        **kwargs: Passed to `MujocoEnv`: `width`, `height`, `camera_id`, `camera_name` and the like.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"],
        "render_fps": round(1 / (TIMESTEP * FRAME_SKIP)),
    }

    def __init__(
        self,
        maze_map: tuple[str, ...],
        start_cell: tuple[int, int],
        goal_cell: tuple[int, int],
        cell_size: float = 4.0,
        goal_radius: float = 0.5,
        reset_cell: tuple[int, int] | None = None,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        arguments = (maze_map, start_cell, goal_cell, cell_size, goal_radius, reset_cell, render_mode)
        EzPickle.__init__(self, *arguments, **kwargs)
        self.reset_cell = reset_cell
        self.maze_map, self.start_cell, self.goal_cell = tuple(maze_map), tuple(start_cell), tuple(goal_cell)
        self.cell_size, self.goal_radius = float(cell_size), float(goal_radius)
        self.goal: State = self._centre(self.goal_cell)
        self._seen = render_mode is not None
        height, width = len(self.maze_map), len(self.maze_map[0])
        view = {
            "lookat": np.append((self._centre((0, 0)) + self._centre((height - 1, width - 1))) / 2, 0.0),
            "distance": 1.3 * self.cell_size * max(height, width),
            "azimuth": 90.0,
            "elevation": -90.0,
        }
        super().__init__(
            "ant.xml",
            FRAME_SKIP,
            spaces.Box(-np.inf, np.inf, (29,), np.float64),
            render_mode=render_mode,
            **{"default_camera_config": view, **kwargs},
        )

    # ------------------------------------------------------------------ the model

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = mujoco.MjModel.from_xml_string(self._model_xml())
        screen = model.vis.global_
        screen.offwidth, screen.offheight = max(screen.offwidth, self.width), max(screen.offheight, self.height)
        return model, mujoco.MjData(model)

    def _model_xml(self) -> str:
        """Gymnasium's ant with D4RL's constants, the maze's walls and a mark for the goal."""
        root = ElementTree.parse(self.fullpath).getroot()  # noqa: S314 - a file of the installed gymnasium
        self._find(root, "option").set("timestep", str(TIMESTEP))
        contacts = self._find(root, "default/geom")
        contacts.set("solref", SOLREF)
        contacts.set("solimp", SOLIMP)
        for motor in root.iterfind("actuator/motor"):
            motor.set("gear", "1")
            motor.set("ctrlrange", f"{-TORQUE} {TORQUE}")
        if not self._seen:  # creating textures takes many times as long as everything else
            for texture in root.iterfind("asset/texture"):
                texture.set("width", "1")
                texture.set("height", "1")
        world = self._find(root, "worldbody")
        half, up = self.cell_size / 2, WALL_HEIGHT / 2 * self.cell_size
        for i, row in enumerate(self.maze_map):
            for j, value in enumerate(row):
                if value == "1":
                    x, y = self._centre((i, j))
                    wall = {"name": f"block_{i}_{j}", "type": "box", "contype": "1", "conaffinity": "1"}
                    wall |= {"pos": f"{x} {y} {up}", "size": f"{half} {half} {up}", "rgba": "0.7 0.5 0.3 1"}
                    ElementTree.SubElement(world, "geom", wall)
        mark = {"name": "target", "type": "sphere", "size": str(self.goal_radius), "rgba": "1 0 0 0.7"}
        ElementTree.SubElement(world, "site", mark)
        return ElementTree.tostring(root, encoding="unicode")

    @staticmethod
    def _find(root: ElementTree.Element, path: str) -> ElementTree.Element:
        found = root.find(path)
        if found is None:
            raise RuntimeError(f"Gymnasium's ant.xml has no <{path}>: this version of it is not supported")
        return found

    def _set_action_space(self) -> spaces.Box:
        self.action_space = spaces.Box(-1.0, 1.0, (self.model.nu,), np.float32)
        return self.action_space

    def _centre(self, cell: Any) -> State:
        """Centre of a cell, (2,) metres."""
        i, j = cell
        start_i, start_j = self.start_cell
        return np.array([j - start_j, i - start_i]) * self.cell_size

    # ------------------------------------------------------------------ episodes

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[State, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of goal and pose.
            options: Any of `reset_cell` (row, column) instead of the start cell, `goal` (2,) metres instead of a drawn
                one, and `noise`; False puts the ant in the model's pose, at rest.

        Raises:
            UserError: An option is unknown, or the cell is not free.
        """
        options = {name: value for name, value in (options or {}).items() if value is not None}
        if self.reset_cell is not None:
            options.setdefault("reset_cell", self.reset_cell)
        if unknown := set(options) - {"reset_cell", "goal", "noise"}:
            raise UserError(f"reset has no option '{min(unknown)}', expected reset_cell, goal or noise")
        super().reset(seed=seed)
        qpos, qvel = self.data.qpos.copy(), self.data.qvel.copy()
        if not options.get("noise", True):
            qpos, qvel = self.init_qpos.copy(), self.init_qvel.copy()
        if "reset_cell" in options:
            qpos[:2] += self._centre(self._free(options["reset_cell"]))
        self.set_state(qpos, qvel)
        if "goal" in options:
            self.goal = np.array(options["goal"], dtype=np.float64)
        return self._observation(), self._info()

    def reset_model(self) -> State:
        """Draw the goal and the pose."""
        draw = self.np_random
        self.goal = self._centre(self.goal_cell) + sum(draw.uniform(0, most, 2) for most in GOAL_NOISE)
        qpos = self.init_qpos + draw.uniform(-POSE_NOISE, POSE_NOISE, self.model.nq)
        qpos[3:7] /= np.linalg.norm(qpos[3:7])  # MuJoCo 2 did this itself, so D4RL's observations have it
        qvel = self.init_qvel + POSE_NOISE * draw.standard_normal(self.model.nv)
        self.set_state(qpos, qvel)
        return self._observation()

    def _free(self, cell: Any) -> tuple[int, int]:
        i, j = (int(value) for value in cell)
        inside = 0 <= i < len(self.maze_map) and 0 <= j < len(self.maze_map[0])
        if not inside or self.maze_map[i][j] == "1":
            raise UserError(f"reset_cell is {(i, j)}, a wall or outside the maze: give a free (row, column)")
        return i, j

    def step(self, action: NDArray[Any]) -> tuple[State, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Simulate a tenth of a second."""
        self.do_simulation(TORQUE * np.clip(action, -1.0, 1.0), self.frame_skip)
        info = self._info()
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(info["success"]), info["success"], False, info

    def render(self) -> Any:
        """Return the picture that `render_mode` asks for, of the maze from above unless a camera was named."""
        self.model.site("target").pos[:] = [*self.goal, self.goal_radius]
        return super().render()

    def _observation(self) -> State:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def _info(self) -> dict[str, Any]:
        position = self.data.qpos[:2].copy()
        success = bool(np.linalg.norm(position - self.goal) <= self.goal_radius)
        return {"position": position, "goal": self.goal.copy(), "success": success}
