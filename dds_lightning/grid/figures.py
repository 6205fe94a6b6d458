"""The figures of a study's report, drawn from its tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.study.statistics import performance_profile

MOST = 12
"""Curves that one can still tell apart."""
COLOURS = 10
"""Curves before matplotlib's colours begin again."""


def _axes(x: str, y: str, size: tuple[float, float] = (6.4, 3.6)) -> tuple[Figure, Any]:
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _style(index: int) -> str:
    """Of a line: another one each time the colours begin again."""
    return ("-", "--", ":", "-.")[index // COLOURS % 4]


def plot_horizon(cells: pd.DataFrame) -> Figure:
    """Figure 6: score over the horizon H, and where fewer steps were executed than learnt.

    Args:
        cells: Columns `horizon`, `hold`, `score`; a row for each seed.
    """
    figure, axes = _axes("horizon H (steps)", "normalised score")
    for whole, marker, name in ((True, "o-", "all H steps executed"), (False, "s", "fewer steps executed (number)")):
        part = cells[(cells["hold"] == cells["horizon"]) == whole]
        if part.empty:
            continue
        table = part.groupby(["horizon", "hold"])["score"].agg(["mean", "std"]).fillna(0.0).reset_index()
        axes.errorbar(table["horizon"], table["mean"], table["std"], fmt=marker, capsize=3, label=name)
        for row in table.itertuples() if not whole else ():
            axes.annotate(
                f"{row.hold:g}", (row.horizon, row.mean), xytext=(6, 0), textcoords="offset points", fontsize=8
            )
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_online(curves: Mapping[str, list[pd.DataFrame]]) -> Figure:
    """Figure 5: what is reached while learning online, mean and standard deviation over seeds.

    Args:
        curves: Setting -> a table for each seed, with `env_steps` and `value`.
    """
    figure, axes = _axes("environment steps", "success (%) or return of the latest episodes")
    for name, tables in curves.items():
        end = min(table["env_steps"].max() for table in tables)
        grid = np.linspace(0.0, end, 100)
        values = np.stack([np.interp(grid, table["env_steps"], table["value"]) for table in tables])
        mean, spread = values.mean(axis=0), values.std(axis=0, ddof=1) if len(values) > 1 else 0.0
        (line,) = axes.plot(grid, mean, label=name)
        # Success is in per cent: a band beyond 0 and 100 would promise what cannot be.
        limits = (0.0, 100.0) if values.min() >= 0 and values.max() <= 100 else (-np.inf, np.inf)
        band = np.clip([mean - spread, mean + spread], *limits)
        axes.fill_between(grid, *band, color=line.get_color(), alpha=0.2, linewidth=0)
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_intervals(comparison: pd.DataFrame) -> Figure:
    """Interquartile means with their 95 % intervals, one line a setting."""
    rows = comparison.iloc[::-1]
    figure, axes = _axes("interquartile mean, 95 % interval", "", (6.4, 1.0 + 0.25 * len(rows)))
    places = np.arange(len(rows))
    axes.hlines(places, rows["low"], rows["high"], linewidth=5, alpha=0.4)
    axes.plot(rows["IQM"], places, "k|", markersize=9)
    axes.set_yticks(places, rows["setting"], fontsize=8)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    return figure


def plot_profiles(groups: Mapping[str, pd.DataFrame]) -> Figure:
    """Performance profiles, of the first `MOST` settings: the share of runs that score more than each threshold."""
    figure, axes = _axes("normalised score", "share of runs above", (8.0, 3.6))
    top = max(100.0, *(float(scores.to_numpy().max()) for scores in groups.values()))
    thresholds = np.linspace(0.0, top, 201)
    for index, (name, scores) in enumerate(list(groups.items())[:MOST]):
        values = performance_profile(scores, thresholds)
        axes.plot(thresholds, values, _style(index), label=name, drawstyle="steps-post")
    figure.legend(loc="outside right upper", frameon=False, fontsize=7)
    return figure


def plot_budgets(curves: Mapping[str, NDArray[np.float64]]) -> Figure:
    """Score of the setting that a bandit finds with so many evaluation episodes."""
    figure, axes = _axes("evaluation episodes spent", "score of the setting chosen", (8.0, 3.6))
    for index, (name, curve) in enumerate(curves.items()):
        axes.plot(np.arange(1, len(curve) + 1), curve, _style(index), label=name)
    figure.legend(loc="outside right upper", frameon=False, fontsize=7)
    return figure
