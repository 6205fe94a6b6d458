"""Online trainings side by side: success over environment steps, and where each went in the maze."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.interpret.draw.drawing import draw_walls, extent
from dds_lightning.tasks import Task

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")
Key = tuple[str, int]
"""Variant and seed."""


def plot_comparison(task: Task, curves: Mapping[Key, pd.DataFrame], visits: Mapping[Key, NDArray[Any]]) -> Figure:
    """Draw the mean over seeds with its standard deviation, and below it, in a maze, how often each cell was visited.

    Args:
        task: The task.
        curves: For each variant and seed `env_steps` and `success` (per cent) or `return` of the latest episodes.
        visits: For each variant and seed the steps in every cell of the maze (rows, columns), of all seeds together.
    """
    names = list(dict.fromkeys(name for name, _ in curves))
    maze = task.maze_map is not None
    figure = Figure(figsize=(max(6.5, 2.4 * len(names)), 5.2 if maze else 3.2), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.5, 1)) if maze else (figure, None)
    top, bottom = parts
    ax = top.subplots()
    measure = "success" if task.measures_success else "return"
    for name, colour in zip(names, COLOURS, strict=False):
        steps, values = on_one_grid([curve for (owner, _), curve in curves.items() if owner == name], measure)
        mean, std = values.mean(axis=0), values.std(axis=0, ddof=min(1, len(values) - 1))
        ax.plot(steps, mean, color=colour, label=name)
        ax.fill_between(steps, mean - std, mean + std, color=colour, alpha=0.2, linewidth=0)
    ax.set_xlabel("environment steps")
    ax.set_ylabel("success of the latest episodes (%)" if task.measures_success else "return of the latest episodes")
    ax.legend(frameon=False, fontsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    if bottom is not None:
        panels = bottom.subplots(1, len(names), squeeze=False)[0]
        for panel, name in zip(panels, names, strict=True):
            _map(panel, task, sum(seen for (owner, _), seen in visits.items() if owner == name), name)
    return figure


def on_one_grid(curves: list[pd.DataFrame], measure: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """Steps (P,) at which every seed has a value, and the values (S, P) there, linear between what was logged."""
    points = [curve[["env_steps", measure]].dropna() if measure in curve else curve[:0] for curve in curves]
    points = [one for one in points if len(one)]
    if not points:
        return np.zeros(0), np.zeros((1, 0))
    low = max(one["env_steps"].min() for one in points)
    steps = np.linspace(low, min(one["env_steps"].max() for one in points), 200)
    return steps, np.stack([np.interp(steps, one["env_steps"], one[measure]) for one in points])


def _map(ax: Any, task: Task, seen: Any, name: str) -> None:
    """The maze with the number of steps in every cell, on a logarithmic scale."""
    draw_walls(ax, task)
    (left, right), (bottom, top) = extent(task)
    rows = np.asarray(seen, dtype=float)
    lowest_last = task.cell_to_xy((1, 0))[1] < task.cell_to_xy((0, 0))[1]
    shown = np.where(rows > 0, rows, np.nan)
    box = (left, right, bottom, top) if lowest_last else (left, right, top, bottom)
    norm = LogNorm(1, max(float(rows.max()), 2.0))
    ax.imshow(shown, extent=box, origin="upper", norm=norm, cmap="viridis", zorder=0, aspect="equal")
    free = len(task.free_cells())
    ax.set_title(f"{name}\n{int((rows > 0).sum())} of {free} cells", fontsize=8)
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    ax.set_xticks([])
    ax.set_yticks([])
