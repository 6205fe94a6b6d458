"""A skill of several steps as one transition (section 4.2): what relabelling and acting share."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Discount = Literal["per_skill", "per_step"]
"""Factor on the bootstrap after a skill: gamma whatever its length (the paper's formula), or gamma^steps."""


def fold(
    rewards: NDArray[Any],
    starts: NDArray[np.int64],
    lengths: NDArray[np.int64],
    gamma: float,
    discount: Discount,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fold the rewards of M segments into one transition each.

    Args:
        rewards: (N,) reward of every step, in the learner's convention.
        starts: (M,) first step of each segment.
        lengths: (M,) steps h of each segment; fewer than H where its episode ended inside the skill.
        gamma: Discount of a step.
        discount: How the bootstrap is discounted, see `Discount`.

    Returns:
        (M,) ``sum of gamma^i r_i`` over the h steps, and (M,) the factor on the bootstrap.
    """
    folded = np.zeros(len(starts))
    for i in range(int(lengths.max(initial=0))):
        taken = i < lengths
        folded[taken] += gamma**i * rewards[starts[taken] + i]
    factor: NDArray[Any] = np.full(len(starts), gamma) if discount == "per_skill" else gamma**lengths
    return folded, factor
