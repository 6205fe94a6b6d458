"""The behaviour behind PointMaze data: planned waypoints, a velocity controller, and noise on purpose.

Coverage decides what can be learnt. A controller that always drives well never shows the learner a wall, a
dead end or a body at rest, and a value network that has not seen them judges goals by their straight-line
distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from datamodules.collect.waypoints import Waypoints
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task


@dataclass(frozen=True)
class PointMazeRecipe:
    """How PointMaze data are made.

    Attributes:
        episode_steps: Steps after which an episode is truncated (the last one may be shorter).
        speed: Cruising speed in metres a second; the environment stops at 5 on each axis.
        waypoint_offset: Waypoints lie up to this far from a cell's centre, in cells, on both axes.
        action_noise: Standard deviation of the Gaussian noise on every action entry.
        burst_probability: Chance that a step outside a burst starts one.
        burst_steps: Shortest and longest burst.
        rest_share: Share of the bursts in which the body brakes and stays at rest. An agent starts at rest
            and comes to rest wherever it pushes against a wall; a policy that has seen few such states
            repeats a useless push.
        start_offset: Episodes start up to this far from a cell's centre, in cells, at rest.
    """

    episode_steps: int = 500
    speed: float = 4.5
    waypoint_offset: float = 0.35
    action_noise: float = 0.2
    burst_probability: float = 0.008
    burst_steps: tuple[int, int] = (10, 50)
    rest_share: float = 0.4
    start_offset: float = 0.38

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if self.episode_steps < 1:
            raise UserError(f"episode_steps: got {self.episode_steps}, expected at least 1")
        if not 0 < self.speed <= 5:
            raise UserError(f"speed: got {self.speed}, expected more than 0 and at most 5 metres a second")
        for name in ("waypoint_offset", "start_offset"):
            value = getattr(self, name)
            if not 0.0 <= value <= 0.4:
                raise UserError(f"{name}: got {value}, expected 0 to 0.4 cells, beyond which there may be a wall")
        if not 0.0 <= self.action_noise < math.inf:
            raise UserError(f"action_noise: got {self.action_noise}, expected a number of at least 0")
        if not 0.0 <= self.burst_probability <= 1.0:
            raise UserError(f"burst_probability: got {self.burst_probability}, expected 0 to 1")
        if not 0.0 <= self.rest_share <= 1.0:
            raise UserError(f"rest_share: got {self.rest_share}, expected 0 to 1")
        low, high = self.burst_steps
        if not 1 <= low <= high:
            raise UserError(f"burst_steps: got {self.burst_steps}, expected 1 <= shortest <= longest")


BehaviourNoise = PointMazeRecipe
"""Name in earlier versions."""

QUIET = PointMazeRecipe(waypoint_offset=0.0, action_noise=0.0, burst_probability=0.0, start_offset=0.0)
"""No noise at all: the controller at its best."""

REST = (0.0, 0.0)
"""Marks braking in a plan of bursts; its force depends on the velocity."""


class Driver:
    """Drives one point mass towards one goal at a time.

    Everything random is drawn once an episode, before the first step. A step then computes with a few Python floats,
    which is faster than NumPy on two numbers, and an episode depends on its seed alone.
    """

    def __init__(self, task: Task, *, speed: float = 4.5, gain: float = 0.5) -> None:
        """Prepare for `task`.

        Args:
            task: A maze task whose actions are forces on x and y.
            speed: Cruising speed in metres a second; the environment stops at 5 on each axis.
            gain: Action per metre a second of velocity error.
        """
        self.waypoints = Waypoints(task)
        self.speed, self.gain = speed, gain
        self.start_episode(np.random.default_rng(0), 1, QUIET)

    def start_episode(self, rng: np.random.Generator, steps: int, recipe: PointMazeRecipe) -> None:
        """Draw an episode's noise: action noise, bursts, waypoint offsets; after `steps` it repeats."""
        self._noise = (recipe.action_noise * rng.standard_normal((steps, 2))).tolist()
        self._burst = _bursts(rng, steps, recipe)
        offsets = rng.uniform(-recipe.waypoint_offset, recipe.waypoint_offset, (steps, 2)) * self.waypoints.size
        self._offsets = list(map(tuple, offsets.tolist()))
        self._step = 0
        self.waypoints.forget()

    def act(self, x: float, y: float, vx: float, vy: float, goal: tuple[float, float]) -> tuple[float, float]:
        """The force for this step, in the box."""
        step = self._step if self._step < len(self._noise) else 0
        self._step = step + 1
        burst = self._burst[step]
        if burst is REST:
            return min(max(-self.gain * vx, -1.0), 1.0), min(max(-self.gain * vy, -1.0), 1.0)
        if burst is not None:
            return burst
        target_x, target_y = self.waypoints.target(x, y, goal, self._offsets[step])
        dx, dy = target_x - x, target_y - y
        scale = self.speed / (math.hypot(dx, dy) + 1e-6)
        noise = self._noise[step]
        force_x = self.gain * (dx * scale - vx) + noise[0]
        force_y = self.gain * (dy * scale - vy) + noise[1]
        return min(max(force_x, -1.0), 1.0), min(max(force_y, -1.0), 1.0)


def _bursts(rng: np.random.Generator, steps: int, recipe: PointMazeRecipe) -> list[tuple[float, float] | None]:
    """Steps of an episode at which a random action replaces the controller's, and that action.

    A share of `rest_share` brings the body to rest; of the others half hold one force (they press the body
    against walls) and half draw a new one at every step.
    """
    plan: list[tuple[float, float] | None] = [None] * steps
    if recipe.burst_probability <= 0:
        return plan
    low, high = recipe.burst_steps
    step = int(rng.geometric(recipe.burst_probability)) - 1
    while step < steps:
        length = int(rng.integers(low, high + 1))
        forces = rng.uniform(-1.0, 1.0, (length, 2))
        if rng.random() < 0.5:
            forces[:] = forces[0]
        rest = rng.random() < recipe.rest_share
        for k, (fx, fy) in enumerate(forces.tolist()[: steps - step]):
            plan[step + k] = REST if rest else (fx, fy)
        step += length + int(rng.geometric(recipe.burst_probability)) - 1
    return plan
