"""The settings of relabelling, in one record that travels; a new setting is one more field."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dds_lightning.envs.semi_mdp import Discount as Discount
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from datamodules.trajectories import Trajectories

Auto = Literal["auto"]

RETURN_SPREAD = 10.0
"""Standard deviation of discounted returns to go under `reward_scale: auto`; what hand-made scales gave is 4 to 18."""


@dataclass(frozen=True)
class Relabelling:
    """How segments become transitions, beside the data and the skills.

    Every field is a flag of `dds relabel` and of `--data` of `dds policy`, and part of the key of the cache.

    Attributes:
        gamma: Discount a step inside a skill, in (0, 1].
        discount: Factor on the bootstrap: gamma (per_skill, the paper's formula) or gamma^steps (per_step).
        stride: Steps between the starts of two segments.
        reward_scale: The learning reward is reward_scale * (reward + reward_shift). Null takes the task's scale;
            ``auto`` makes the standard deviation of the data's discounted returns to go `RETURN_SPREAD`, whatever the
            unit of the rewards.
        reward_shift: See reward_scale. Null takes the task's shift. ``auto`` takes the mean reward away where no
            episode of the data ends in a termination, for there a constant changes no choice; elsewhere nothing, for
            there it says what it is worth to go on.
    """

    gamma: float = 0.99
    discount: Discount = "per_skill"
    stride: int = 1
    reward_scale: float | Auto | None = None
    reward_shift: float | Auto | None = None

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if not 0.0 < self.gamma <= 1.0:
            raise UserError(f"gamma is {self.gamma}, expected a discount in (0, 1]")
        if self.stride < 1:
            raise UserError(f"stride is {self.stride}, expected at least 1")
        if self.discount not in ("per_skill", "per_step"):
            raise UserError(f"discount is '{self.discount}', expected per_skill or per_step")
        for name in ("reward_scale", "reward_shift"):
            value = getattr(self, name)
            if isinstance(value, str) and value != "auto":
                raise UserError(f"{name} is '{value}', expected a number, auto or null")

    def for_task(self, task: Task | None) -> Relabelling:
        """The same with a task's scale and shift in place of None; 1 and 0 without a task."""
        scale, shift = (task.reward_scale, task.reward_shift) if task else (1.0, 0.0)
        return replace(
            self,
            reward_scale=scale if self.reward_scale is None else self.reward_scale,
            reward_shift=shift if self.reward_shift is None else self.reward_shift,
        )

    def step_discount(self, horizon: int) -> float:
        """Discount of one step outside a skill: gamma, or gamma^(1/H) where a skill of H steps counts gamma."""
        return self.gamma if self.discount == "per_step" else self.gamma ** (1.0 / horizon)

    def affine(self, trajectories: Trajectories, horizon: int) -> tuple[float, float]:
        """Scale and shift of the learning rewards, ``scale * (reward + shift)``, with numbers in place of ``auto``.

        Args:
            trajectories: The data.
            horizon: H; with ``per_skill`` a step counts gamma^(1/H) towards the returns that ``auto`` looks at.
        """
        rewards = trajectories.rewards.astype(np.float64)
        shift: float = 0.0
        if self.reward_shift != "auto":
            shift = self.reward_shift or 0.0
        elif not trajectories.terminations.any():
            shift = -float(rewards.mean())
        if self.reward_scale != "auto":
            return 1.0 if self.reward_scale is None else self.reward_scale, shift
        rewards += shift
        spread = float(returns_to_go(rewards, trajectories.lengths, self.step_discount(horizon)).std())
        return RETURN_SPREAD / spread if spread > 1e-12 else 1.0, shift

    def learning_rewards(self, trajectories: Trajectories, horizon: int) -> NDArray[np.float64]:
        """What the critic learns from at each step of the data, (N,); arguments as of `affine`."""
        scale, shift = self.affine(trajectories, horizon)
        return scale * (trajectories.rewards.astype(np.float64) + shift)

    def settings(self) -> dict[str, Any]:
        """Every field by name."""
        return asdict(self)


def returns_to_go(rewards: NDArray[np.float64], lengths: NDArray[np.int64], gamma: float) -> NDArray[np.float64]:
    """Discounted sum of the rewards (N,) from each step to the end of its episode, (N,)."""
    from scipy.signal import lfilter

    returns = np.empty_like(rewards)
    ends = np.cumsum(lengths)
    for first, last in zip(ends - lengths, ends, strict=True):
        returns[first:last] = lfilter([1.0], [1.0, -gamma], rewards[first:last][::-1])[::-1]
    return returns
