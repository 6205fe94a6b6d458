"""Scores as bars, for tasks without a maze to draw."""

import textwrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dds_lightning.interpret.draw.drawing import LABEL, TICKS
from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS

WRAP = 40
"""Maximum number of letters of a contestant's name on one line."""


def plot_scores(summary: pd.DataFrame) -> Figure:
    """Draw the normalised score of every contestant and of every single skill, with its standard error.

    Args:
        summary: Columns `contestant`, `kind` ("skill" for a single skill's row), `score`, `score_error`.
    """
    rows = summary.iloc[::-1]  # bars are drawn from the bottom
    names = [textwrap.fill(str(name), WRAP) for name in rows["contestant"]]
    colours = [NO_SKILL if kind == "skill" else SKILL_COLOURS[0] for kind in rows["kind"]]
    lines = np.array([name.count("\n") + 1 for name in names])
    places = np.cumsum(lines) - lines / 2  # a long name takes more room
    figure = Figure(figsize=(7.0, 0.7 + 0.19 * lines.sum()), layout="constrained")
    ax = figure.add_subplot()
    errors = rows["score_error"].fillna(0.0)
    ax.barh(places, rows["score"], xerr=errors, color=colours, height=0.7, ecolor="black", capsize=2)
    for place, score, error in zip(places, rows["score"], errors, strict=True):
        ax.annotate(
            f"{score:.1f}",
            (max(score + error, 0.0), place),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    ax.set_yticks(places, names, fontsize=8)
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set_ylim(0.0, lines.sum())
    ax.margins(x=0.1)
    ax.tick_params(axis="x", labelsize=TICKS)
    ax.set_xlabel("normalised score, ± standard error", fontsize=LABEL)
    ax.spines[["top", "right"]].set_visible(False)
    return figure
