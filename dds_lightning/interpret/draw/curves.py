"""Training curves from the metrics.csv that every fit writes."""

import textwrap
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dds_lightning.saving.untrusted import read_csv

PANELS = {
    "skill": (
        ("train/denoising", "denoising loss"),
        ("val/reconstruction_rmse", "reconstruction RMSE (action units)"),
        ("val/codes_used", "codes in use"),
        ("train/commitment", "||E - z||$^2$"),
    ),
    "policy": (
        ("train/v_mean", "mean V(s)"),
        ("train/q_loss", "TD error"),
        ("train/advantage_std", "spread of advantages"),
        ("val/code_accuracy", "agreement with the data's code"),
    ),
}
COUNTS = ("val/codes_used",)
"""Columns of whole numbers, whose axes begin at zero."""
WRAP = 22
"""Maximum number of letters of a title on one line: a panel is narrow."""


def read_metrics(path: str | Path) -> pd.DataFrame:
    """Read a metrics.csv, one row per logged step."""
    return read_csv(path, {"step": "iuf"}).sort_values("step")


def plot_training_curves(stages: dict[str, Path]) -> Figure:
    """Draw the curves of each stage that has a metrics file, one row of panels per stage.

    Args:
        stages: "skill" or "policy" -> its metrics.csv; missing files are left out.
    """
    present = {stage: read_metrics(path) for stage, path in stages.items() if path.is_file()}
    figure = Figure(figsize=(8.0, 2.1 * max(len(present), 1)), layout="constrained")
    if not present:
        figure.text(0.5, 0.5, "no metrics were recorded", ha="center")
        return figure
    axes = figure.subplots(len(present), 4, squeeze=False)
    for row, (stage, table) in zip(axes, present.items(), strict=True):
        for ax, (column, label) in zip(row, PANELS[stage], strict=True):
            _curve(ax, table, column, label)
        row[0].annotate(
            stage,
            (-0.42, 0.5),
            xycoords="axes fraction",
            rotation=90,
            va="center",
            fontsize=9,
            fontweight="bold",
        )
    return figure


def _curve(ax: Axes, table: pd.DataFrame, column: str, label: str) -> None:
    ax.set_title(textwrap.fill(label, WRAP), fontsize=7.5)
    ax.tick_params(labelsize=6.5)
    ax.set_xlabel("optimiser step", fontsize=6.5)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))
    ax.spines[["top", "right"]].set_visible(False)
    if column in table:
        points = table[["step", column]].dropna()
        ax.plot(
            points["step"],
            points[column],
            color="#0072b2",
            linewidth=1.2,
            marker="." if len(points) < 12 else "",
        )
    if column in COUNTS:
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        ax.set_ylim(0.0, ax.get_ylim()[1] + 0.5)  # room for a mark at the top
