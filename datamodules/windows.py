"""Finds the segments of episodes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from datamodules.validation import DataError


@dataclass(frozen=True, eq=False)
class Windows:
    """Segments of up to H steps, each inside one episode.

    Attributes:
        starts: (M,) int64, first step.
        observation_starts: (M,) int64, row of the first observation.
        lengths: (M,) int64, steps h: H, or fewer where a termination cuts the segment short.
        episodes: (M,) int64.
    """

    starts: NDArray[np.int64]
    observation_starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    episodes: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of segments M."""
        return len(self.starts)


def sliding_windows(
    name: str,
    lengths: NDArray[np.int64],
    terminated: NDArray[np.bool_],
    horizon: int,
    stride: int = 1,
    tail: Literal["full", "terminated"] = "full",
) -> Windows:
    """Sliding windows that never cross an episode.

        H = 3, stride 1     s s s s s T      (T: the last step, a termination)
                            └───┘
                              └───┘
                                └───┘
                                  └───┘
                                    └─┘      h = 2 and
                                      └      h = 1: only with tail = "terminated"

    Args:
        name: Name of the data set, for messages.
        lengths: (E,) steps of each episode.
        terminated: (E,) whether each episode ends in a termination.
        horizon: H, steps of a window.
        stride: Steps between the starts of two windows of one episode; H makes them disjoint.
        tail: "full" takes windows of H steps only. "terminated" also takes the shorter ones that end in a
            termination, from which the learner sees where episodes end. Windows cut short by a time-out are never
            taken, because nothing is known about the missing steps.

    Raises:
        DataError: When no episode is long enough, or a setting is out of range. If only some episodes are too short,
            they are left out with one warning, which counts them.
    """
    if horizon < 1 or stride < 1:
        raise DataError(f"horizon and stride: got {horizon} and {stride}, expected at least 1")
    if tail not in ("full", "terminated"):
        raise DataError(f"tail: got '{tail}', expected 'full' or 'terminated'")
    # Windows may start at 0, stride, 2 * stride, ... up to (not including) this step of the episode.
    stop = np.maximum(lengths - horizon + 1, 0)
    if tail == "terminated":
        stop = np.where(terminated, lengths, stop)
    counts = -(-stop // stride)
    _report_short(name, lengths, horizon, counts == 0)
    episodes = np.repeat(np.arange(len(lengths)), counts)
    local = ranges(np.zeros_like(counts), counts) * stride
    starts = (np.cumsum(lengths) - lengths)[episodes] + local
    return Windows(
        starts=starts,
        observation_starts=starts + episodes,
        lengths=np.minimum(horizon, lengths[episodes] - local),
        episodes=episodes,
    )


def _report_short(name: str, lengths: NDArray[np.int64], horizon: int, dropped: NDArray[np.bool_]) -> None:
    if not dropped.any():
        return
    if dropped.all():
        raise DataError(
            f"data set '{name}': horizon {horizon} is longer than every one of the {len(lengths)} episodes "
            f"(the longest has {lengths.max()} steps); choose a smaller horizon"
        )
    warnings.warn(
        f"data set '{name}': {int(dropped.sum())} of {len(lengths)} episodes are shorter than horizon "
        f"{horizon} and are left out ({int(lengths[dropped].sum())} of {lengths.sum()} steps)",
        stacklevel=4,
    )


def ranges(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """`starts[0], ..., starts[0] + counts[0] - 1`, then the same for the other entries, concatenated."""
    ends = np.cumsum(counts)
    if not len(ends):
        return np.zeros(0, np.int64)
    return np.arange(ends[-1]) + np.repeat(starts - (ends - counts), counts)
