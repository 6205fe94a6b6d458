"""Steps an environment from recorded states, and measures the effect of noise on those states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.physics.states import RecordedSteps
from dds_lightning.envs.physics import mujoco

KITCHEN_NOISE = ((0.01, 0.0005), (0.1, 0.1))
"""Noise on (robot, objects) as shares of the kitchen's amplitudes: FrankaKitchen-v1's, and D4RL's."""

Floats = NDArray[np.float64]


def simulate(inner: Any, recorded: RecordedSteps, noise: _Noise | None = None) -> tuple[Floats, Floats]:
    """Step from every recorded state.

    Args:
        inner: The environment without wrappers, after a reset.
        recorded: N steps.
        noise: Noise to add to the states; None leaves them unchanged.

    Returns:
        (n, W) the states reached, as a recording without noise would hold them; (n,) rewards.
    """
    robot = getattr(inner, "robot_env", None)
    reached, rewards = [], []
    for qpos, qvel, seen, actions in zip(
        recorded.qpos, recorded.qvel, recorded.observations, recorded.actions, strict=True
    ):
        mujoco.mj_resetData(inner.model, inner.data)  # clears what the solver remembers of the previous state
        inner.data.qpos[:], inner.data.qvel[:] = (qpos, qvel) if noise is None else noise.move(qpos, qvel)
        mujoco.mj_forward(inner.model, inner.data)
        for state, action in zip(seen, actions, strict=True):
            if robot is not None:  # it moves from where it last observed its joints
                robot._last_robot_qpos = state[:9].copy()
            _, reward, *_ = inner.step(action)
        reached.append(recorded.layout.observe(inner.data.qpos, inner.data.qvel))
        rewards.append(float(reward))
    return np.array(reached), np.array(rewards)


class _Noise:
    """The kitchen's noise on recorded states.

    Args:
        robot: The FrankaRobot, whose configuration has the amplitudes.
        recorded: The recorded steps, whose objects at rest reveal how much noise there is.
    """

    def __init__(self, robot: Any, recorded: RecordedSteps) -> None:
        # The environment reads the amplitudes of the objects' positions one entry too early; so does this code.
        positions, velocities = robot.robot_pos_noise_amp, robot.robot_vel_noise_amp
        objects = list(recorded.layout.positions[9:])
        changes = np.nanmean((recorded.following - recorded.observations[:, -1])[:, objects] ** 2, axis=0)
        # The difference of two uniform draws from -a to a has the mean square 2 a^2 / 3.
        ratio = np.sqrt(1.5 * (changes / positions[8:] ** 2).min())
        of_robot, of_objects = min(KITCHEN_NOISE, key=lambda known: abs(np.log((ratio + 1e-9) / known[1])))
        self.positions = np.append(of_robot * positions[:9], of_objects * positions[8:])
        self.velocities = np.append(of_robot * velocities[:9], of_objects * velocities[9:])
        self._rng = np.random.default_rng(0)

    def move(self, qpos: Floats, qvel: Floats) -> tuple[Floats, Floats]:
        """Return a state with noise, as it would be observed."""
        a, b = (self._rng.uniform(-1.0, 1.0, len(part)) for part in (qpos, qvel))
        return qpos + a * self.positions, qvel + b * self.velocities


def blur(inner: Any, recorded: RecordedSteps, simulated: Floats) -> tuple[Floats, Floats]:
    """Return the noise of every dimension, (W,): amplitude, and 95 % quantile of its effect on the state reached."""
    if not recorded.layout.noisy:
        none = np.zeros(len(recorded.layout.names))
        return none, none
    noise = _Noise(inner.robot_env, recorded)
    again, _ = simulate(inner, recorded, noise)
    amplitude = recorded.layout.observe(noise.positions, noise.velocities)
    return amplitude, amplitude + np.quantile(np.abs(again - simulated), 0.95, axis=0)
