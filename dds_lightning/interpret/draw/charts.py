"""Figures of the tables: matrices between codes, where each code is used, discrete against continuous skills."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dds_lightning.interpret.draw.drawing import (
    LABEL,
    TICKS,
    draw_number,
    draw_walls,
    frame,
    grid,
    heading,
    panel_height,
    write_title,
)
from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS, WALL, ink, skill_colour
from dds_lightning.interpret.measure.statistics import telling_dimensions
from dds_lightning.interpret.views import view_of
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import observation_names

if TYPE_CHECKING:
    from dds_lightning.interpret.measure.recovery import Recovery, RoundTrip
    from dds_lightning.interpret.measure.statistics import CodedSegments

SHADES = LinearSegmentedColormap.from_list("shades", ["#eef3fa", "#9cc3e6", "#3b82c4", "#0b3d75", "#04142b"])
"""One hue from low to high: light where there is nothing, so that ink goes where there is something."""
NUMBERED = 24
"""Maximum number of codes for which a matrix shows its numbers."""
SQUARES = 3
"""Squares per cell of a maze on each axis, for where a code is used."""
BAR = 0.45
"""Height in inches of a colour bar below some panels, with its label."""
SEEN = 5
"""Minimum number of segments in a square for it to be shown."""
DOTS = 400
"""Maximum number of points per code, without a maze."""


def plot_matrix(
    matrix: NDArray[Any],
    codes: NDArray[Any],
    xlabel: str,
    ylabel: str,
    title: str,
    form: str = ".0f",
    factor: float = 100.0,
    hide: float = 0.5,
    unit: str = "%",
) -> Figure:
    """Draw a square matrix between codes as a heat map, with its numbers.

    Args:
        matrix: (C, C); NaN is left white.
        codes: (C,) codes of rows and columns.
        xlabel: Label of the columns.
        ylabel: Label of the rows.
        title: Title of the figure.
        form: Format of the numbers, which are multiplied by `factor`.
        factor: 100 for shares in per cent.
        hide: Numbers (times `factor`) below this are not written.
        unit: Unit of the colour bar.
    """
    size = len(matrix)
    side = float(np.clip(0.36 * size + 1.4, 3.4, 7.0))
    figure = Figure(figsize=(side + 0.9, side), layout="constrained")
    ax = figure.add_subplot()
    values = factor * np.asarray(matrix, dtype=float)
    image = ax.imshow(values, cmap=SHADES, vmin=0.0)
    if size <= NUMBERED:
        faces = image.to_rgba(values)  # (C, C, 4)
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value) and value >= hide:
                text = ink(to_hex(tuple(faces[i, j])))
                ax.text(j, i, format(value, form), color=text, ha="center", va="center", fontsize=8)
    ax.set_xticks(range(size), [str(code) for code in codes])
    ax.set_yticks(range(size), [str(code) for code in codes])
    ax.tick_params(labelsize=TICKS - 1.5, length=0)
    for labels in (ax.get_xticklabels(), ax.get_yticklabels()):
        for label, code in zip(labels, codes, strict=True):
            colour = skill_colour(int(code))
            label.set(color=ink(colour), bbox={"boxstyle": "round,pad=0.15", "facecolor": colour, "edgecolor": "none"})
    ax.set_xlabel(xlabel, fontsize=LABEL - 1)
    ax.set_ylabel(ylabel, fontsize=LABEL - 1)
    ax.set_title(title, fontsize=LABEL - 1)
    ax.spines[:].set_visible(False)
    bar = figure.colorbar(image, ax=ax, shrink=0.8)
    bar.set_label(unit, fontsize=LABEL - 1)
    bar.ax.tick_params(labelsize=TICKS - 2)
    return figure


def plot_recovery(found: Recovery) -> Figure:
    """Draw the confusion matrix of `recovery.code_recovery`, with accuracy and chance in its title."""
    title = f"From any state: recovered in {found.accuracy:.0%} (chance {found.chance:.0%})"
    return plot_matrix(found.confusion, found.codes, "code that the encoder finds", "code that was held", title)


def plot_round_trip(found: RoundTrip) -> Figure:
    """Draw the confusion matrix of `recovery.round_trip`, with accuracy, control and chance in its title."""
    control = "" if np.isnan(found.control) else f", another code held {found.control:.0%}"
    title = f"In its own states: found again in {found.accuracy:.0%}\n(chance {found.chance:.0%}{control})"
    return plot_matrix(found.confusion, found.codes, "code that the encoder finds", "code that was held", title)


def plot_transitions(matrix: NDArray[Any]) -> Figure:
    """Draw the matrix of `statistics.transition_matrix`."""
    codes = np.arange(len(matrix))
    return plot_matrix(
        matrix, codes, "code of the next segment", "code of a segment", "Which code follows which in the data"
    )


def plot_distances(distances: NDArray[Any]) -> Figure:
    """Draw the matrix of `statistics.code_distances`."""
    shown = np.asarray(distances, dtype=float).copy()
    np.fill_diagonal(shown, np.nan)
    title = "Distance between the codebook's vectors"
    return plot_matrix(shown, np.arange(len(shown)), "code", "code", title, ".2g", 1.0, 0.0, "distance")


def plot_effects(task: Task, found: Recovery) -> Figure:
    """Draw the effect of each code on the displacement, one dot per state and the code's number at their mean.

    Args:
        task: The task in which it was measured.
        found: Result of `recovery.code_recovery`.
    """
    names = view_of(task).path
    across, up = 0, len(names) - 1
    figure = Figure(figsize=(6.0, 5.4), layout="constrained")
    ax = figure.add_subplot()
    effects = 100 * found.effects[..., [across, up]]
    for code, dots in zip(found.codes, effects, strict=True):
        ax.plot(*dots.T, ".", color=skill_colour(int(code)), markersize=4, alpha=0.5)
    for code, dots in zip(found.codes, effects, strict=True):
        draw_number(ax, np.nanmean(dots, axis=0), int(code))
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"{names[across]}, minus the mean of all skills (cm)", fontsize=LABEL - 1)
    ax.set_ylabel(f"{names[up]} (cm)", fontsize=LABEL - 1)
    ax.tick_params(labelsize=TICKS - 1.5)
    ax.set_title(
        f"Where each skill leads in {found.steps} steps: {found.information_in_state:.1f} bits of {found.most:.2g}",
        fontsize=LABEL - 1,
    )
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def plot_diversity(table: pd.DataFrame) -> Figure:
    """Draw how much noise alone changes an action, and how much the code does, one bar and one mark per code.

    Args:
        table: Table from `statistics.decoder_diversity`, or any table with its columns.
    """
    figure = Figure(figsize=(7.0, 2.6), layout="constrained")
    ax = figure.add_subplot()
    codes = table["code"].to_numpy()
    colours = [skill_colour(int(code)) for code in codes]
    places = np.arange(len(codes))
    ax.bar(places, 100 * table["spread"], color=colours, width=0.7)
    mark: dict[str, Any] = {"marker": "D", "markersize": 5.5, "linestyle": "", "color": "white"}
    mark["markeredgecolor"] = "black"
    ax.plot(places, 100 * table["apart"], **mark)
    ax.set_xticks(places, [str(code) for code in codes])
    ax.set(xlim=(-0.6, len(codes) - 0.4), ylim=(0.0, None))
    ax.set_xlabel("skill", fontsize=LABEL - 1)
    ax.set_ylabel("% of half the\naction box", fontsize=LABEL - 1)
    ax.tick_params(labelsize=TICKS - 1.5)
    ax.spines[["top", "right"]].set_visible(False)
    handles = [
        Patch(facecolor=NO_SKILL, label="spread of its actions over noise"),
        Line2D([], [], **mark, label="distance of its mean action from that of all skills"),
    ]
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.0}
    ax.legend(handles=handles, fontsize=9, frameon=False, ncols=2, **place)
    return figure


def plot_where(task: Task | None, segments: CodedSegments) -> Figure:
    """Draw where in the state space each code is used in the data, one panel per code.

    In a maze: the share of the segments that begin in a square and have the code. Elsewhere: the code's segments over
    all others, along the two dimensions of the observations that distinguish codes best.

    Args:
        task: The task of the data.
        segments: Segments from `statistics.code_segments`.
    """
    if task is not None and task.maze_map is not None:
        return _where_in_maze(task, segments)
    names = observation_names(task) if task is not None else tuple(f"observation {j}" for j in range(10_000))
    across, up = (telling_dimensions(segments.observations, segments.codes, 2) * 2)[:2]
    shown = np.flatnonzero(segments.share > 0)
    figure, axes = grid(len(shown), 1.75, 1.75)
    seen, codes = segments.observations, segments.codes
    rng = np.random.default_rng(0)
    some = rng.permutation(len(seen))[: 4 * DOTS]
    limits = [np.quantile(seen[:, j], (0.002, 0.998)) for j in (across, up)]
    for ax, code in zip(axes, shown, strict=True):
        dots = rng.permutation(np.flatnonzero(codes == code))[:DOTS]
        ax.plot(*seen[some][:, [across, up]].T, ".", color=WALL, markersize=2, zorder=1, rasterized=True)
        ax.plot(*seen[dots][:, [across, up]].T, ".", color=skill_colour(int(code)), markersize=2.5, rasterized=True)
        ax.set(xlim=limits[0], ylim=limits[1])
        ax.tick_params(labelsize=TICKS - 3)
        ax.label_outer()
        heading(ax, int(code), f"{segments.share[code]:.0%} of the data")
    figure.supxlabel(names[across], fontsize=LABEL - 2)
    figure.supylabel(names[up], fontsize=LABEL - 2)
    write_title(figure, "States in which each code begins in the data (grey: all)", TICKS)
    return figure


def _where_in_maze(task: Task, segments: CodedSegments) -> Figure:
    assert task.maze_map is not None
    tall, wide = SQUARES * len(task.maze_map), SQUARES * len(task.maze_map[0])
    first = task.cell_to_xy((-0.5, -0.5))
    step = task.cell_to_xy((0.5, 0.5)) - first  # one cell down the map and to the right
    places = ((segments.observations[:, :2] - first) / step * SQUARES).astype(int)[:, ::-1]  # rows, columns
    rows, columns = np.clip(places, 0, [tall - 1, wide - 1]).T
    counts = np.zeros((segments.num_skills, tall, wide))
    np.add.at(counts, (segments.codes, rows, columns), 1.0)
    total = counts.sum(axis=0)
    shares = 100 * np.divide(counts, total, out=np.full_like(counts, np.nan), where=total >= SEEN)
    shown = np.flatnonzero(segments.share > 0)
    figure, axes = grid(len(shown), 1.75, panel_height(task, 1.75))
    figure.set_figheight(figure.get_figheight() + BAR)
    x = first[0] + step[0] * np.arange(wide + 1) / SQUARES
    y = first[1] + step[1] * np.arange(tall + 1) / SQUARES
    top = float(np.nanquantile(shares[shares > 0], 0.98)) if (shares > 0).any() else 1.0
    for ax, code in zip(axes, shown, strict=True):
        draw_walls(ax, task, goal=False)
        mesh = ax.pcolormesh(x, y, shares[code], cmap=SHADES, vmin=0, vmax=top, zorder=0.5, rasterized=True)
        heading(ax, int(code), f"{segments.share[code]:.0%} of the data")
    figure.get_layout_engine().set(hspace=0.06)  # type: ignore[union-attr, call-arg]
    bar = figure.colorbar(mesh, ax=axes, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_label("% of the segments that begin there", fontsize=TICKS - 1)
    bar.ax.tick_params(labelsize=TICKS - 2)
    frame(figure, axes, task, "Where each code is used in the data")
    return figure


def plot_comparison(table: pd.DataFrame) -> Figure:
    """Draw recovery, information and decoding error of several models, one dot per seed and a bar for the mean.

    Args:
        table: Table from `recovery.compare_recovery`.
    """
    names = list(dict.fromkeys(table["model"]))
    figure = Figure(figsize=(7.0, 2 * (0.5 * len(names) + 1.25)), layout="constrained")
    columns = (
        ("own_accuracy", 100.0, "found again in\nits own states (%)", "own_control", "another code held"),
        ("accuracy", 100.0, "recovered from\nany state (%)", "chance", "chance"),
        ("information_in_state", 1.0, "information about\nwhere it leads (bits)", "most", "most possible"),
        ("decoded", 1.0, "error of decoded actions\n(root mean square)", "decoded_own", "each segment's vector"),
    )
    axes = figure.subplots(2, 2, sharey=True).ravel()
    for ax, (column, factor, label, line, line_label) in zip(axes, columns, strict=True):
        for place, name in enumerate(names):
            rows = table[table["model"] == name]
            colour = SKILL_COLOURS[0 if rows["kind"].iloc[0] == "discrete" else 9]
            ax.barh(place, factor * rows[column].mean(), height=0.6, color=colour, alpha=0.35)
            spread = np.linspace(-0.12, 0.12, len(rows)) if len(rows) > 1 else np.zeros(1)
            ax.plot(factor * rows[column], place + spread, "o", color=colour, markersize=5)
            mark = factor * rows[line].mean()
            ax.plot([mark, mark], [place - 0.38, place + 0.38], color=NO_SKILL, linestyle="--", linewidth=1.3)
        ax.plot([], [], color=NO_SKILL, linestyle="--", linewidth=1.3, label=line_label)
        ax.set_xlabel(label, fontsize=LABEL - 2)
        ax.tick_params(labelsize=TICKS - 1.5)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlim(left=0.0)
        ax.legend(fontsize=8.5, frameon=False, loc="lower left", bbox_to_anchor=(-0.05, 0.99), borderaxespad=0.0)
    names = [name.replace(", ", ",\n") for name in names]
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    for ax in axes[::2]:
        ax.tick_params(axis="y", labelsize=TICKS - 1)
    return figure
