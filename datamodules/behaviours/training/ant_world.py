"""Where the Ant learns to walk: many bodies on an endless floor, each commanded a heading that changes.

Runners train in Gymnasium's environments, stepped by stable-baselines3's `DummyVecEnv`. The Ant has a vectorised
environment of its own because what its policy observes (`ant.see`: rotation, symmetry, heading) is a few dozen small
array operations. For one body at a time they cost as much as the physics; for all bodies at once they are cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from datamodules.behaviours.ant import FEATURES, check_physics, motor_actions, rotation_matrices, see

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WalkRules:
    """What is rewarded and what disturbs; steps are the environment's.

    The reward of a step is `min(speed along the heading, cruise) - sideways * |speed across it| + alive
    - effort * |action|^2 - level * (1 - cosine of the tilt)`, with speeds in metres per second. The disturbances are
    there because mazes have walls and collectors add noise.

    Attributes:
        cruise: Speed beyond which nothing more is earned: who may only be faster by falling more often is not.
        sideways: Weight of the speed across the heading.
        alive: Reward of every step.
        effort: Weight of the squared action.
        level: Weight of the torso's tilt.
        heading_steps: Fewest and most steps for which a heading holds.
        drift: Standard deviation in radians of the heading's random walk in between, as when a waypoint passes nearby.
        action_noise: Upper end of the range from which each episode draws its standard deviation of action noise.
        kick_probability: Probability that a step ends with a push.
        kick: Standard deviation of a push, in m/s and rad/s.
        tilted_share: Share of episodes that start tilted and in motion, with joints anywhere in their range.
        tilt: Largest tilt of these in radians.
        fallen: An episode ends when the cosine of the tilt is below this.
        episode_steps: Length of the longest episode.
    """

    cruise: float = np.inf
    sideways: float = 0.3
    alive: float = 0.3
    effort: float = 0.02
    level: float = 0.5
    heading_steps: tuple[int, int] = (10, 80)
    drift: float = 0.03
    action_noise: float = 0.25
    kick_probability: float = 0.01
    kick: float = 0.7
    tilted_share: float = 0.3
    tilt: float = 1.2
    fallen: float = 0.1
    episode_steps: int = 1000


RULES = {
    "d4rl": WalkRules(),
    "robotics": WalkRules(
        cruise=2.0, alive=1.5, level=1.0, heading_steps=(20, 160), drift=0.02, kick_probability=0.005
    ),
}
"""Rules by physics; a step of "robotics" is half as long."""


def calm(physics: str) -> WalkRules:
    """The rules of a physics without any disturbance, for evaluation; a fall does not end an episode."""
    return replace(
        RULES[physics],
        drift=0.0,
        action_noise=0.0,
        kick_probability=0.0,
        tilted_share=0.0,
        fallen=-2.0,
        episode_steps=1_000_000_000,
    )


def ant_simulator(physics: str) -> tuple[mujoco.MjModel, float]:
    """The Ant on an endless floor without walls.

    Args:
        physics: "d4rl" or "robotics".

    Returns:
        The model, and the simulator's control for an action of 1. An environment step is 5 of the model's.

    Raises:
        UserError: There is no such physics.
    """
    check_physics(physics)
    if physics == "d4rl":
        from dds_lightning.envs.antmaze import TORQUE, D4RLAntMazeEnv

        return D4RLAntMazeEnv(("0",), (0, 0), (0, 0)).model, TORQUE
    from dds_lightning.envs.build import build_env

    return build_env("Ant-v4").unwrapped.model, 1.0  # type: ignore[attr-defined]


class AntWorld(VecEnv):
    """`count` Ants in one process: simulated one after the other, observed and rewarded all at once.

    Observations are those of `ant.see`; actions follow the policy's numbering of legs. At the end of an episode
    `info["walk"]` holds its length, its mean speed along the heading and whether the Ant fell.

    Args:
        physics: "d4rl" or "robotics".
        count: Number of Ants.
        rules: Rewards and disturbances; by default the entry of `RULES` for the physics.
        seed: Seed of all random numbers.
    """

    frame_skip = 5

    def __init__(self, physics: str, count: int, rules: WalkRules | None = None, seed: int = 0) -> None:
        self.render_mode = None
        self.model, self.force = ant_simulator(physics)
        box = spaces.Box(-1.0, 1.0, (self.model.nu,), np.float32)
        super().__init__(count, spaces.Box(-np.inf, np.inf, (FEATURES,), np.float32), box)
        self.data = [mujoco.MjData(self.model) for _ in range(count)]
        self.rng = np.random.default_rng(seed)
        self.qpos, self.qvel = np.zeros((count, self.model.nq)), np.zeros((count, self.model.nv))
        self.steps = np.zeros(count, dtype=np.int64)
        self.actions = np.zeros((count, self.model.nu))
        self.rules = rules or RULES[physics]
        self.seconds = self.model.opt.timestep * self.frame_skip
        self.headings = np.zeros(count)
        self.until = np.zeros(count, dtype=np.int64)
        self.noise = np.zeros(count)
        self.speed_sum = np.zeros(count)
        self.turns = np.zeros(count, dtype=np.int64)
        self.speed = np.zeros(count)
        self.upright = np.ones(count)

    # ------------------------------------------------------------------ episodes

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes."""
        for i in range(self.num_envs):
            self._start(i)
        return self._observe()

    def _start(self, i: int) -> None:
        rules, rng, data = self.rules, self.rng, self.data[i]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] += rng.uniform(-0.1, 0.1, data.qpos.size)
        data.qvel[:] = 0.1 * rng.standard_normal(data.qvel.size)
        tilt = 0.0
        if rng.random() < rules.tilted_share:
            tilt = rng.uniform(0.0, rules.tilt)
            low, high = self.model.jnt_range[1:].T
            data.qpos[7:] = rng.uniform(low, high)
            data.qpos[2] = rng.uniform(0.4, 1.0)
            data.qvel[:] = rng.standard_normal(data.qvel.size)
        data.qpos[3:7] = _orientation(rng.uniform(-np.pi, np.pi), tilt, rng.uniform(-np.pi, np.pi))
        mujoco.mj_forward(self.model, data)
        self.steps[i], self.speed_sum[i] = 0, 0.0
        self.noise[i] = rng.uniform(0.0, rules.action_noise)
        self._command_heading(i)
        self._read_state(i)

    def _read_state(self, i: int) -> None:
        self.qpos[i], self.qvel[i] = self.data[i].qpos, self.data[i].qvel

    def _command_heading(self, i: int) -> None:
        """Draw a new heading and the step at which it ends."""
        self.headings[i] = self.rng.uniform(-np.pi, np.pi)
        self.until[i] = self.steps[i] + self.rng.integers(*self.rules.heading_steps, endpoint=True)

    def _observe(self) -> NDArray[np.float32]:
        seen, self.turns = see(np.concatenate([self.qpos, self.qvel], axis=1), self.headings)
        return seen.astype(np.float32)

    # ------------------------------------------------------------------ steps

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions (count, 8), clipped to [-1, 1], for `step_wait`."""
        self.actions = np.clip(actions, -1.0, 1.0).astype(np.float64)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Move every Ant by one step and restart those whose episode is over."""
        rules, rng = self.rules, self.rng
        noise = self.noise[:, None] * rng.standard_normal((self.num_envs, 8))
        controls = motor_actions(np.clip(self.actions + noise, -1.0, 1.0), self.turns) * self.force
        before = self.qpos[:, :2].copy()
        kicked = np.asarray(rng.random(self.num_envs) < rules.kick_probability)
        for i, data in enumerate(self.data):
            data.ctrl[:] = controls[i]
            mujoco.mj_step(self.model, data, nstep=self.frame_skip)
            if kicked[i]:
                data.qvel[:6] += rules.kick * rng.standard_normal(6)
            self._read_state(i)
        self.steps += 1
        velocity = (self.qpos[:, :2] - before) / self.seconds
        cosine, sine = np.cos(self.headings), np.sin(self.headings)
        self.speed = velocity[:, 0] * cosine + velocity[:, 1] * sine
        across = np.abs(velocity[:, 1] * cosine - velocity[:, 0] * sine)
        effort = np.square(self.actions).sum(axis=1)
        self.upright = rotation_matrices(self.qpos[:, 3:7])[:, 2, 2]
        costs = rules.sideways * across + rules.effort * effort + rules.level * (1.0 - self.upright)
        rewards = np.minimum(self.speed, rules.cruise) + rules.alive - costs
        self.speed_sum += self.speed
        fell = self.upright < rules.fallen
        late = self.steps >= rules.episode_steps
        self.headings += rules.drift * rng.standard_normal(self.num_envs)
        for i in np.flatnonzero(self.steps >= self.until).tolist():
            self._command_heading(i)
        seen = self._observe()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = fell | late
        for i in np.flatnonzero(done).tolist():
            steps = int(self.steps[i])
            infos[i] = {
                "terminal_observation": seen[i].copy(),
                "TimeLimit.truncated": bool(late[i] and not fell[i]),
                "walk": {"steps": steps, "speed": self.speed_sum[i] / steps, "fell": bool(fell[i])},
            }
            self._start(i)
        if done.any():
            seen = self._observe()
        return seen, rewards.astype(np.float32), done, infos

    # ------------------------------------------------------------------ the rest of stable-baselines3's interface

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of this object, which all Ants share, once per Ant."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def _unsupported(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError("the Ants of an AntWorld have no attributes or methods of their own")

    set_attr = env_method = _unsupported

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False: no Ant has a wrapper of its own."""
        return [False] * len(list(self._get_indices(indices)))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed all random numbers."""
        self.rng = np.random.default_rng(seed)
        return [seed] * self.num_envs


def _orientation(yaw: float, tilt: float, axis: float) -> Array:
    """Quaternion of a body tilted about a horizontal axis at angle `axis`, then turned by `yaw`."""
    turn, lean = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), yaw)
    mujoco.mju_axisAngle2Quat(lean, np.array([np.cos(axis), np.sin(axis), 0.0]), tilt)
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, turn, lean)
    return out
