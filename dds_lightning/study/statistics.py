"""Is a difference real? Statistics over seeds and tasks, and what a score is worth when evaluations are counted.

After Agarwal et al. 2021, "Deep RL at the edge of the statistical precipice", and Jackson et al. 2025, "A clean slate
for offline RL".

Scores are arrays of shape (S, M): S seeds of M tasks. What draws random numbers takes a seed and gives the same every
time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Interval(NamedTuple):
    """An estimate and the interval around it."""

    value: float
    low: float
    high: float


def mean_std(scores: ArrayLike, digits: int = 1) -> str:
    """Format as the paper's tables print it: mean ± standard deviation over the seeds; the mean alone of one seed."""
    values = np.ravel(np.asarray(scores, np.float64))
    spread = f" ± {values.std(ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{values.mean():.{digits}f}{spread}" if len(values) else "-"


def iqm(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interquartile mean of the last two axes taken together: the mean of the middle half."""
    return stats.trim_mean(scores.reshape(*scores.shape[:-2], -1), 0.25, axis=-1)


def resampled(scores: ArrayLike, count: int, seed: int = 0) -> NDArray[np.float64]:
    """Draw stratified bootstrap samples: each task draws its seeds anew, with replacement.

    Args:
        scores: (S, M).
        count: N.
        seed: Of the draws.

    Returns:
        (N, S, M).
    """
    table = np.asarray(scores, np.float64)
    rows = np.random.default_rng(seed).integers(len(table), size=(count, *table.shape))  # (N, S, M)
    return np.take_along_axis(table[None], rows, axis=1)


def interval(
    scores: ArrayLike, statistic: Statistic = iqm, confidence: float = 0.95, count: int = 2000, seed: int = 0
) -> Interval:
    """Estimate a statistic of (S, M) scores, with its percentile interval from a stratified bootstrap."""
    table = np.asarray(scores, np.float64)
    low, high = np.quantile(statistic(resampled(table, count, seed)), (0.5 - confidence / 2, 0.5 + confidence / 2))
    return Interval(float(statistic(table)), float(low), float(high))


def probability_of_improvement(better: ArrayLike, worse: ArrayLike, count: int = 2000, seed: int = 0) -> Interval:
    """Estimate how probably a run of one beats a run of the other on the same task, averaged over tasks; a tie is half.

    Args:
        better: (S, M).
        worse: (R, M).
        count: Bootstrap samples of the 95 % interval.
        seed: Of the bootstrap.
    """

    def wins(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., S, M) and (..., R, M) to (...,)."""
        difference = x[..., :, None, :] - y[..., None, :, :]
        return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-3, -2, -1))

    x, y = np.asarray(better, np.float64), np.asarray(worse, np.float64)
    drawn = wins(resampled(x, count, seed), resampled(y, count, seed + 1))
    return Interval(float(wins(x, y)), *map(float, np.quantile(drawn, (0.025, 0.975))))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> NDArray[np.float64]:
    """Share of all runs that score more than each threshold: (S, M) and (T,) to (T,)."""
    return (np.ravel(np.asarray(scores, np.float64))[:, None] > np.asarray(thresholds, np.float64)).mean(axis=0)


def evaluation_curve(
    returns: ArrayLike, pulls: int, policies: int | None = 8, repeats: int = 200, alpha: float = 2.0, seed: int = 0
) -> NDArray[np.float64]:
    """Score of the policy that one would deploy after so many evaluation episodes, spent by an upper-confidence bandit.

    An offline method leaves one policy for each of its settings; finding the best costs episodes in the environment. In
    each repeat some of the policies are arms, and a pull draws one of the arm's recorded episodes. Every arm is pulled
    once, then the one with the greatest mean + alpha sqrt(log n / n_arm) in units of the spread of all episodes; the
    one with the greatest mean would be deployed. The question is that of Jackson et al. (2025); the weight of the bonus
    and its unit are our own, so curves are to be compared with each other and not with theirs.

    Args:
        returns: (P, E) scores of E episodes of each of P policies.
        pulls: N.
        policies: Arms of a repeat, drawn without replacement; None takes all.
        repeats: How many times.
        alpha: Weight of what is not known.
        seed: Of arms and episodes.

    Returns:
        (N,) mean over the repeats of the deployed policy's mean score.
    """
    table = np.asarray(returns, np.float64)
    random, arms = np.random.default_rng(seed), min(policies or len(table), len(table))
    truth, unit = table.mean(axis=1), max(float(table.std()), 1e-12)
    deployed = np.zeros((repeats, pulls))
    for row in deployed:
        chosen = random.permutation(len(table))[:arms]
        total, times = np.zeros(arms), np.zeros(arms)
        for n in range(pulls):
            seen = np.maximum(times, 1)
            bound = total / seen + alpha * unit * np.sqrt(np.log(max(n, 1)) / seen)
            arm = n if n < arms else int(bound.argmax())
            total[arm] += random.choice(table[chosen[arm]])
            times[arm] += 1
            means = np.where(times > 0, total / np.maximum(times, 1), -np.inf)
            row[n] = truth[chosen[means.argmax()]]
    return deployed.mean(axis=0)
