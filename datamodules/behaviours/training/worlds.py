"""Many bodies in one process: physics one after the other, everything else for all of them at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from dds_lightning.envs.build import build_env

Array = NDArray[np.float64]


class World(VecEnv):
    """What all worlds share: one model, `count` states, and the answers that stable-baselines3 asks for.

    Args:
        model: The simulator's model.
        count: Number of bodies.
        features: Width of an observation.
        seed: Of everything that is drawn.
    """

    def __init__(self, model: mujoco.MjModel, count: int, features: int, seed: int) -> None:
        self.render_mode = None
        observations = spaces.Box(-np.inf, np.inf, (features,), np.float32)
        super().__init__(count, observations, spaces.Box(-1.0, 1.0, (model.nu,), np.float32))
        self.model = model
        self.data = [mujoco.MjData(model) for _ in range(count)]
        self.rng = np.random.default_rng(seed)
        self.qpos, self.qvel = np.zeros((count, model.nq)), np.zeros((count, model.nv))
        self.steps = np.zeros(count, dtype=np.int64)
        self.actions = np.zeros((count, model.nu))

    def record(self, i: int) -> None:
        """Copy a body's state out of the simulator."""
        self.qpos[i], self.qvel[i] = self.data[i].qpos, self.data[i].qvel

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep the actions (count, A), clipped, for `step_wait`."""
        self.actions = np.clip(actions, -1.0, 1.0).astype(np.float64)

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """One and the same for all."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not supported."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No wrappers inside."""
        return [False] * len(list(self._get_indices(indices)))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed everything that is drawn."""
        self.rng = np.random.default_rng(seed)
        return [seed] * self.num_envs


@dataclass(frozen=True)
class RunnerRules:
    """Gymnasium's rules of a runner; the environment itself says the rest.

    Attributes:
        env_id: Gymnasium's name.
        cut: Velocities are cut to +- this in observations.
        alive: Reward of a step for not falling.
        z: Range of heights outside which an episode ends.
        angle: Largest pitch in radians before it ends.
        state: Largest absolute value of any other coordinate or velocity before it ends.
    """

    env_id: str
    cut: float = np.inf
    alive: float = 0.0
    z: tuple[float, float] = (-np.inf, np.inf)
    angle: float = np.inf
    state: float = np.inf


RUNNERS = {
    "Hopper-v4": RunnerRules("Hopper-v4", cut=10.0, alive=1.0, z=(0.7, np.inf), angle=0.2, state=100.0),
    "Walker2d-v4": RunnerRules("Walker2d-v4", cut=10.0, alive=1.0, z=(0.8, 2.0), angle=1.0),
    "HalfCheetah-v4": RunnerRules("HalfCheetah-v4"),
}
EPISODE_STEPS = 1000


class RunnerWorld(World):
    """Gymnasium's Hopper, Walker2d or HalfCheetah, `count` of them; the same numbers for half of the time.

    Args:
        env_id: One of `RUNNERS`.
        count: Number of bodies.
        seed: Of their starts.
    """

    def __init__(self, env_id: str, count: int, seed: int = 0) -> None:
        self.rules = RUNNERS[env_id]
        origin: Any = build_env(env_id).unwrapped
        origin.reset(seed=seed)
        super().__init__(origin.model, count, origin.model.nq + origin.model.nv - 1, seed)
        self.origin, self.effort = origin, origin._ctrl_cost_weight

    def reset(self) -> NDArray[np.float32]:
        """Start all episodes."""
        for i in range(self.num_envs):
            self._start(i)
        return self._observations()

    def _start(self, i: int) -> None:
        self.origin.reset()
        data = self.data[i]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:], data.qvel[:] = self.origin.data.qpos, self.origin.data.qvel
        mujoco.mj_forward(self.model, data)
        self.steps[i] = 0
        self.record(i)

    def _observations(self) -> NDArray[np.float32]:
        velocities = np.clip(self.qvel, -self.rules.cut, self.rules.cut)
        return np.concatenate([self.qpos[:, 1:], velocities], axis=1, dtype=np.float32, casting="same_kind")

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Move everybody by one step; whoever is done starts again."""
        rules, model, skip = self.rules, self.model, self.origin.frame_skip
        before = self.qpos[:, 0].copy()
        for i, data in enumerate(self.data):
            data.ctrl[:] = self.actions[i]
            mujoco.mj_step(model, data, nstep=skip)
            self.record(i)
        self.steps += 1
        speed = (self.qpos[:, 0] - before) / self.origin.dt
        rewards = speed + rules.alive - self.effort * np.square(self.actions).sum(axis=1)
        z, angle = self.qpos[:, 1], self.qpos[:, 2]
        state = np.maximum(np.abs(self.qpos[:, 2:]).max(axis=1), np.abs(self.qvel).max(axis=1))
        healthy = (rules.z[0] < z) & (z < rules.z[1]) & (np.abs(angle) < rules.angle) & (state < rules.state)
        late = self.steps >= EPISODE_STEPS
        done = ~healthy | late
        observations = self._observations()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            for i in np.flatnonzero(done).tolist():
                infos[i] = {
                    "terminal_observation": observations[i].copy(),
                    "TimeLimit.truncated": bool(late[i] and healthy[i]),
                }
                self._start(i)
            observations = self._observations()
        return observations, rewards.astype(np.float32), done, infos
