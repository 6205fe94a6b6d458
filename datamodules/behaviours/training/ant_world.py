"""Where the Ant learns to walk: many bodies on one endless floor, each told a heading that changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from datamodules.behaviours.ant import FEATURES, PHYSICS, motor_actions, rotation_matrices, see
from datamodules.behaviours.training.worlds import World
from dds_lightning.errors import UserError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WalkRules:
    """What is rewarded and what disturbs; steps are the environment's.

    The reward of a step is `speed along the heading - sideways * |speed across it| + alive - effort * |action|^2
    - level * (1 - cosine of the tilt)`, speeds in metres a second. Disturbances are there because mazes have walls
    and collectors add noise.

    Attributes:
        sideways: See above.
        alive: See above.
        effort: See above.
        level: See above.
        heading_steps: Fewest and most steps for which a heading holds.
        drift: Deviation in radians of a heading's random walk in between, as towards a waypoint passed nearby.
        action_noise: Each episode's deviation of Gaussian noise on actions is drawn from 0 to this.
        kick_probability: Chance that a step ends with a push.
        kick: Deviation of a push, m/s and rad/s.
        tilted_share: Share of episodes that start tilted, joints anywhere, in motion.
        tilt: Largest tilt of these in radians.
        fallen: An episode ends when the cosine of the tilt is below this.
        episode_steps: Longest episode.
    """

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
    "robotics": WalkRules(heading_steps=(20, 160), drift=0.02, kick_probability=0.005),
}
"""By physics; a step of robotics' is half as long."""


def calm(physics: str) -> WalkRules:
    """The rules without any disturbance, for evaluation; a fall does not end an episode."""
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
        The model, and what an action of 1 is in the simulator's controls. A step is 5 of the model's.
    """
    if physics not in PHYSICS:
        raise UserError(f"physics: found '{physics}', expected one of {', '.join(PHYSICS)}")
    if physics == "d4rl":
        from dds_lightning.envs.antmaze import TORQUE, D4RLAntMazeEnv

        return D4RLAntMazeEnv(("0",), (0, 0), (0, 0)).model, TORQUE
    from dds_lightning.envs.build import build_env

    return build_env("Ant-v4").unwrapped.model, 1.0  # type: ignore[attr-defined]


class AntWorld(World):
    """`count` Ants, one after the other in one process, with observations and rewards computed for all at once.

    Observations are those of `ant.see`, actions are in the policy's numbering of legs. At an episode's end the
    info holds its length, mean speed along the heading and whether it fell.

    Args:
        physics: "d4rl" or "robotics".
        count: Number of Ants.
        rules: Rewards and disturbances; by default the physics' own of `RULES`.
        seed: Of everything that is drawn.
    """

    frame_skip = 5

    def __init__(self, physics: str, count: int, rules: WalkRules | None = None, seed: int = 0) -> None:
        model, self.force = ant_simulator(physics)
        super().__init__(model, count, FEATURES, seed)
        self.rules = rules or RULES[physics]
        self.seconds = model.opt.timestep * self.frame_skip
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
        return self._see()

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
        self._tell(i)
        self.record(i)

    def _tell(self, i: int) -> None:
        """Command a new heading."""
        self.headings[i] = self.rng.uniform(-np.pi, np.pi)
        self.until[i] = self.steps[i] + self.rng.integers(*self.rules.heading_steps, endpoint=True)

    def _see(self) -> NDArray[np.float32]:
        seen, self.turns = see(np.concatenate([self.qpos, self.qvel], axis=1), self.headings)
        return seen.astype(np.float32)

    # ------------------------------------------------------------------ steps

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Move everybody by one step; whoever is done starts again."""
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
            self.record(i)
        self.steps += 1
        velocity = (self.qpos[:, :2] - before) / self.seconds
        cosine, sine = np.cos(self.headings), np.sin(self.headings)
        self.speed = velocity[:, 0] * cosine + velocity[:, 1] * sine
        across = np.abs(velocity[:, 1] * cosine - velocity[:, 0] * sine)
        effort = np.square(self.actions).sum(axis=1)
        self.upright = rotation_matrices(self.qpos[:, 3:7])[:, 2, 2]
        costs = rules.sideways * across + rules.effort * effort + rules.level * (1.0 - self.upright)
        rewards = self.speed + rules.alive - costs
        self.speed_sum += self.speed
        fell = self.upright < rules.fallen
        late = self.steps >= rules.episode_steps
        self.headings += rules.drift * rng.standard_normal(self.num_envs)
        for i in np.flatnonzero(self.steps >= self.until).tolist():
            self._tell(i)
        seen = self._see()
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
            seen = self._see()
        return seen, rewards.astype(np.float32), done, infos


def _orientation(yaw: float, tilt: float, axis: float) -> Array:
    """Quaternion of a body tilted about a horizontal axis at angle `axis`, then turned by `yaw`."""
    turn, lean = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), yaw)
    mujoco.mju_axisAngle2Quat(lean, np.array([np.cos(axis), np.sin(axis), 0.0]), tilt)
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, turn, lean)
    return out
