"""The elements of every figure over a maze: walls, paths, the star of the start, the number of a skill.

A maze is seen from above with y up, as in the simulator: a left turn is a left turn. If y grows down the map (D4RL's
AntMaze), the map's first row is therefore the lowest.
"""

import textwrap
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.palette import GOAL, START, START_EDGE, WALL, ink, skill_colour
from dds_lightning.rollout.result import RolloutPath
from dds_lightning.tasks import Task

LABEL, TICKS, NUMBER = 12.0, 11.0, 9.0
"""Font sizes of a figure 7 inches wide: printed in a column of 3.5 inches they are halved."""

LETTER = 0.0075
"""Width of a letter of text, on average, in inches per point of its size."""
CROPPED = 0.6
"""How much of the outer wall, in cells, small panels leave out on each side."""


def draw_walls(ax: Axes, task: Task, goal: bool = True) -> None:
    """Draw the maze, one square per wall cell, with axes in metres and the area in which the goal counts as reached.

    That is a circle, or, if every episode draws its goal, the union of all possible circles.

    Raises:
        UserError: The task has no maze.
    """
    if task.maze_map is None:
        raise UserError(f"task '{task.name}' has no maze to draw; use the table of its report instead")
    half = task.cell_size / 2
    squares = [
        Rectangle(tuple(task.cell_to_xy((i, j)) - half), task.cell_size, task.cell_size)
        for i, row in enumerate(task.maze_map)
        for j, value in enumerate(row)
        if value == "1"
    ]
    ax.add_collection(PatchCollection(squares, facecolor=WALL, edgecolor="white", linewidth=0.3, zorder=0))
    (left, right), (bottom, top) = extent(task)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    ax.set_xlabel("x (m)", fontsize=LABEL)
    ax.set_ylabel("y (m)", fontsize=LABEL)
    ax.tick_params(labelsize=TICKS)
    if goal:
        outline = goal_outline(task)
        ax.add_patch(Polygon(outline, facecolor=GOAL, edgecolor="none", alpha=0.10, zorder=1))
        ax.add_patch(Polygon(outline, fill=False, edgecolor=GOAL, linewidth=1.2, zorder=5))


def goal_outline(task: Task, points: int = 120) -> NDArray[np.float64]:
    """Return the outline (P, 2) in metres of all places within the goal's radius of a goal.

    A circle around a fixed goal; a square with round corners if goals are drawn from a square.
    """
    angles = (np.arange(points) + 0.5) * 2 * np.pi / points
    outwards = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return task.goal_xy() + task.goal_noise * np.sign(outwards) + task.goal_radius * outwards


def extent(task: Task) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return left and right, bottom and top of a maze in metres."""
    assert task.maze_map is not None
    corners = task.cell_to_xy([(0, 0), (len(task.maze_map) - 1, len(task.maze_map[0]) - 1)])
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)
    half = task.cell_size / 2
    return (float(left - half), float(right + half)), (float(bottom - half), float(top + half))


def zoom(ax: Axes, task: Task, centre: NDArray[Any], reach: float) -> None:
    """Show a window of ``reach`` metres to each side, moved to stay inside the maze; all of a smaller maze."""
    windows = []
    for middle, (low, high) in zip(centre, extent(task), strict=True):
        size = min(2 * reach, high - low)
        first = float(np.clip(middle - size / 2, low, high - size))
        windows.append((first, first + size))
    ax.set(xlim=windows[0], ylim=windows[1])


def draw_path(ax: Axes, path: RolloutPath, linewidth: float = 1.0, numbers: float = 0.0) -> None:
    """Draw one path coloured by the skill in use.

    Args:
        ax: Axes that show a maze.
        path: Positions and codes.
        linewidth: Line width in points.
        numbers: Minimum distance in metres between the numbers written where a code takes over; 0 writes none.
    """
    positions, codes = np.asarray(path.positions), np.asarray(path.codes)
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)  # (T, 2, 2)
    colours = [skill_colour(int(code)) for code in codes]
    lines = LineCollection(list(pieces), colors=colours, linewidths=linewidth, zorder=2, capstyle="round")
    ax.add_collection(lines)
    if numbers:
        written = positions[:1]  # the star is there; overlapping numbers would be unreadable
        for t in np.flatnonzero(np.diff(codes, prepend=codes[0] - 1)):
            if np.linalg.norm(positions[t] - written, axis=1).min() >= numbers:
                written = np.concatenate([written, positions[t : t + 1]])
                draw_number(ax, positions[t], int(codes[t]))


def draw_trail(ax: Axes, positions: NDArray[Any], code: int, linewidth: float) -> None:
    """Draw positions (T + 1, 2) as one line in the colour of a skill."""
    ax.plot(*positions.T, color=skill_colour(code), linewidth=linewidth, zorder=2, solid_capstyle="round")


def draw_number(ax: Axes, xy: NDArray[Any], code: int, size: float = NUMBER) -> None:
    """Write a code in a disc of its colour."""
    colour = skill_colour(code)
    box = {"boxstyle": "circle,pad=0.15", "facecolor": colour, "edgecolor": "white", "linewidth": 0.5}
    place = (float(xy[0]), float(xy[1]))
    text = str(code) if code >= 0 else "-"
    ax.annotate(text, place, color=ink(colour), fontsize=size, ha="center", va="center", bbox=box, zorder=6)


def draw_starts(ax: Axes, starts: Iterable[NDArray[Any]], cell: float, size: float = 12.0) -> None:
    """Draw orange stars, one for all starts within half a cell of each other."""
    drawn: list[NDArray[Any]] = []
    for start in starts:
        if all(np.linalg.norm(start - other) >= cell / 2 for other in drawn):
            drawn.append(start)
    if drawn:
        x, y = np.stack(drawn).T
        ax.plot(x, y, "*", markersize=size, color=START, markeredgecolor=START_EDGE, markeredgewidth=0.6, zorder=4)


def grid(count: int, width: float, height: float, columns: int = 4) -> tuple[Figure, list[Axes]]:
    """Create a figure of ``count`` equal panels, at most ``columns`` in a row; the list has only these."""
    columns = max(min(columns, count), 1)
    rows = max(-(-count // columns), 1)
    figure = Figure(figsize=(columns * width, rows * height + 0.45), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.03)  # type: ignore[union-attr, call-arg]
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for ax in axes[count:]:
        ax.remove()
    return figure, axes[:count]


def panel_height(task: Task, width: float) -> float:
    """Return the height in inches of a panel that shows a cropped maze under a heading."""
    return width * _proportion(task, CROPPED) + 0.25


def crop(ax: Axes, task: Task) -> None:
    """Crop most of the outer wall, because a small panel needs the room."""
    (left, right), (bottom, top) = extent(task)
    less = CROPPED * task.cell_size
    ax.set(xlim=(left + less, right - less), ylim=(bottom + less, top - less))


def maze_figure(task: Task) -> tuple[Figure, Axes]:
    """Create a figure 7 inches wide with one maze and room for a legend or a colour bar beside it."""
    figure = Figure(figsize=(7.0, 5.1 * _proportion(task) + 0.9), layout="constrained")
    return figure, figure.add_subplot()


def _proportion(task: Task, cropped: float = 0.0) -> float:
    """Return the height of a maze divided by its width, without some cells on each side."""
    (left, right), (bottom, top) = extent(task)
    less = 2 * cropped * task.cell_size
    return (top - bottom - less) / (right - left - less)


def heading(ax: Axes, code: int, text: str = "") -> None:
    """Write a panel's heading: the skill's number on its colour, as on paths in other figures, then some text."""
    colour = skill_colour(code)
    box = {"boxstyle": "round,pad=0.2", "facecolor": colour, "edgecolor": "none"}
    put = partial(
        ax.annotate, xy=(0.0, 1.0), xycoords="axes fraction", textcoords="offset points", va="bottom", fontsize=9
    )
    put(str(code), xytext=(3, 4), color=ink(colour), bbox=box, fontweight="bold")
    if text:
        put(text, xytext=(22, 4))


def write_title(figure: Figure, text: str, size: float = LABEL) -> None:
    """Write a title above all panels, on as many lines as the figure's width asks for."""
    lines = textwrap.wrap(text, int(figure.get_figwidth() / (LETTER * size)))
    figure.set_figheight(figure.get_figheight() + (len(lines) - 1) * size * 1.3 / 72)
    figure.suptitle("\n".join(lines), fontsize=size)


def frame(figure: Figure, axes: Iterable[Axes], task: Task, title: str) -> None:
    """Finish panels that are too small for axes: no ticks, the scale in the title."""
    for ax in axes:
        crop(ax, task)
        ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    write_title(figure, f"{title} (a wall square: {task.cell_size:g} m)", TICKS)
