"""Mutual information between a code and what it leads to."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 5
"""Number of bins, with equally many displacements each, into which every coordinate is divided."""
SHUFFLES = 20
"""Permutations whose mean information is subtracted: few samples show some by chance alone."""


def mutual_information(codes: NDArray[Any], values: NDArray[Any], bins: int = BINS, seed: int = 0) -> float:
    """Mutual information in bits between a code and where it leads.

    Every coordinate is divided into bins with equally many values; the average for shuffled codes is subtracted, and a
    negative result counts as 0.

    Args:
        codes: (N,).
        values: (N, D), for example displacements.
        bins: Bins per coordinate.
        seed: Seed of the shuffles.
    """
    values = np.atleast_2d(np.asarray(values, dtype=np.float64).T).T
    known = np.isfinite(values).all(axis=1)
    _, codes = np.unique(np.asarray(codes)[known], return_inverse=True)
    cell = np.zeros(int(known.sum()), np.int64)
    for column in values[known].T:
        edges = np.unique(np.quantile(column, np.linspace(0, 1, bins + 1)[1:-1]))
        cell = cell * bins + np.searchsorted(edges, column, side="right")
    _, cell = np.unique(cell, return_inverse=True)
    rng = np.random.default_rng(seed)
    by_chance = np.mean([_information(rng.permutation(codes), cell) for _ in range(SHUFFLES)])
    return max(0.0, float(_information(codes, cell) - by_chance))


def _information(first: NDArray[np.int64], second: NDArray[np.int64]) -> float:
    """Return the plug-in mutual information in bits of two columns of small integers."""
    joint = np.zeros((int(first.max(initial=0)) + 1, int(second.max(initial=0)) + 1))
    np.add.at(joint, (first, second), 1.0 / max(len(first), 1))
    apart = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    there = joint > 0
    return float((joint[there] * np.log2(joint[there] / apart[there])).sum())
