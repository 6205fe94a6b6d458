"""Scores as bars, for tasks without a maze to draw."""

import textwrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from dds_lightning.interpret.draw.drawing import LABEL, TICKS
from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS

WRAP = 40
"""Maximum number of letters of a contestant's name on one line."""


def plot_scores(summary: pd.DataFrame, error: str = "standard error") -> Figure:
    """Draw the normalised score of every contestant and of every single skill, with its error.

    Args:
        summary: Columns `contestant`, `kind` ("skill" for a single skill's row), `score`, `score_error`; with `scores`,
            a list in each row, every one of them is a point.
        error: What `score_error` is.
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
    ends = rows["score"] + errors
    if "scores" in rows:
        for place, scores in zip(places, rows["scores"], strict=True):
            ax.plot(scores, np.full(len(scores), place), "o", markersize=3, color="black", alpha=0.6)
        ends = np.maximum(ends, [max(scores) for scores in rows["scores"]])
    for place, score, end in zip(places, rows["score"], ends, strict=True):
        ax.annotate(
            f"{score:.1f}",
            (max(end, 0.0), place),
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
    ax.set_xlabel(f"normalised score, ± {error}", fontsize=LABEL)
    ax.spines[["top", "right"]].set_visible(False)
    return figure
