"""Figures over a maze: where skills lead, how the policy stitches them, where it fails, what it believes.

Every function takes a table of episodes and recorded paths, as `rollout(..., record=True)` gives and
`RolloutResult.load` reads back, and returns a matplotlib figure.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.palette import GOAL, NO_SKILL, START, WALL, skill_colour
from dds_lightning.results import RolloutPath, RolloutResult
from dds_lightning.tasks import Task

ValueFunction = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Observations (N, O) to values (N,)."""


def draw_walls(ax: Axes, task: Task, goal: bool = True) -> None:
    """Draw the maze, one square a wall cell, with axes in metres and the goal's circle.

    Raises:
        UserError: the task has no maze.
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
    last = (len(task.maze_map) - 1, len(task.maze_map[0]) - 1)
    (left, bottom), (right, top) = task.cell_to_xy((last[0], 0)) - half, task.cell_to_xy((0, last[1])) + half
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    ax.tick_params(labelsize=7)
    if goal:
        centre = tuple(task.goal_xy())
        ax.add_patch(Circle(centre, task.goal_radius, facecolor=GOAL, alpha=0.18, zorder=1))
        ax.add_patch(Circle(centre, task.goal_radius, fill=False, edgecolor=GOAL, linewidth=1.2, zorder=5))


def draw_path(ax: Axes, path: RolloutPath, numbers: bool = False, linewidth: float = 1.0) -> None:
    """Draw one path coloured by the skill in use; with ``numbers`` write each code where it takes over."""
    positions, codes = np.asarray(path.positions), np.asarray(path.codes)
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)  # (T, 2, 2)
    colours = [skill_colour(int(code)) for code in codes]
    ax.add_collection(LineCollection(list(pieces), colors=colours, linewidths=linewidth, zorder=2))
    if numbers:
        changes = np.flatnonzero(np.diff(codes, prepend=codes[0] - 1))
        written = np.full(2, np.inf)
        for t in changes:
            if np.linalg.norm(positions[t] - written) < 0.45:
                continue  # numbers on top of each other tell nothing
            written = positions[t]
            _number(ax, positions[t], int(codes[t]))


def _number(ax: Axes, xy: NDArray[Any], code: int, size: float = 5.5) -> None:
    box = {
        "boxstyle": "circle,pad=0.15",
        "facecolor": skill_colour(code),
        "edgecolor": "white",
        "linewidth": 0.4,
    }
    ax.annotate(
        str(code), tuple(xy), color="white", fontsize=size, ha="center", va="center", bbox=box, zorder=6
    )


def _start(ax: Axes, xy: NDArray[Any]) -> None:
    ax.plot(
        *xy, marker="*", markersize=9, color=START, markeredgecolor="#7a3b00", markeredgewidth=0.5, zorder=7
    )


def _paths_of(result: RolloutResult, actor: str) -> list[tuple[Any, RolloutPath]]:
    """Rows of the table with their paths.

    Raises:
        UserError: no such contestant, or nothing was recorded of it.
    """
    table = result.episodes[result.episodes["actor"] == actor]
    if table.empty:
        known = ", ".join(result.episodes["actor"].unique())
        raise UserError(f"there is no contestant '{actor}' in the table, only {known}")
    rows = [
        (row, result.paths[actor, int(row.episode)])
        for row in table.itertuples()
        if (actor, int(row.episode)) in result.paths
    ]
    if not rows:
        raise UserError(f"no paths of '{actor}' were recorded: evaluate again with record=True")
    return rows


def _usage_legend(ax: Axes, codes: NDArray[Any]) -> None:
    """A legend of the codes in use, most used first, with their share of the steps."""
    values, counts = np.unique(codes[codes >= 0], return_counts=True)
    order = np.argsort(-counts)
    handles = [
        Line2D(
            [],
            [],
            color=skill_colour(int(values[i])),
            linewidth=3,
            label=f"{values[i]}: {counts[i] / counts.sum():.0%}",
        )
        for i in order
    ]
    if handles:
        ax.legend(
            handles=handles,
            title="skill: share",
            loc="upper left",
            bbox_to_anchor=(1.01, 1.0),
            fontsize=6,
            title_fontsize=6.5,
            frameon=False,
            labelspacing=0.25,
        )


def plot_trajectories(
    task: Task, result: RolloutResult, actor: str, episodes: int = 12, numbered: int = 1
) -> Figure:
    """Episodes of one contestant over the maze, coloured by the skill in use (figure 4 d and h of the paper).

    Args:
        task: the maze.
        result: table and paths.
        actor: the contestant.
        episodes: how many paths to draw; successful ones first.
        numbered: on how many of them the codes are written.
    """
    rows = sorted(_paths_of(result, actor), key=lambda row: not row[0].success)[:episodes]
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    for index, (_, path) in enumerate(rows):
        draw_path(ax, path, numbers=index < numbered, linewidth=1.1)
        _start(ax, path.positions[0])
    table = result.episodes[result.episodes["actor"] == actor]
    ax.set_title(
        f"{actor}: {table['success'].mean():.0%} of {len(table)} episodes reach the goal ({len(rows)} drawn)",
        fontsize=9,
    )
    _usage_legend(ax, np.concatenate([path.codes for _, path in rows]))
    return figure


def plot_single_skills(
    task: Task, result: RolloutResult, actor: str = "single skill", steps: int = 150
) -> Figure:
    """Each skill replayed alone, one panel a skill (figure 4 a to c of the paper).

    Args:
        task: the maze.
        result: table and paths; the contestant's labels are "skill 0", "skill 1", ...
        actor: the contestant whose every part is one skill.
        steps: how much of each replay to draw; later ones only pile up against a wall.
    """
    groups: dict[int, list[tuple[Any, RolloutPath]]] = {}
    for row, path in _paths_of(result, actor):
        groups.setdefault(int(path.codes[0]), []).append((row, path))
    figure, axes = _grid(len(groups), task)
    for ax, (code, rows) in zip(axes, sorted(groups.items()), strict=False):
        draw_walls(ax, task)
        for _, path in rows:
            cut = RolloutPath(path.positions[: steps + 1], path.codes[:steps])
            draw_path(ax, cut, linewidth=0.9)
            _start(ax, path.positions[0])
        success = np.mean([bool(row.success) for row, _ in rows])
        ax.set_title(
            f"skill {code}, alone {success:.0%}", fontsize=7, color=skill_colour(code), fontweight="bold"
        )
        ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    figure.suptitle(f"Each skill alone, first {steps} steps from every start", fontsize=9)
    return figure


def plot_skills_by_start(
    task: Task,
    starts: NDArray[Any],
    positions: NDArray[Any],
    codes: NDArray[Any],
    alive: NDArray[Any] | None = None,
) -> Figure:
    """All skills from each of several starts, one panel a start (figure 4 a to c and e to g of the paper).

    Args:
        task: the maze.
        starts: (N, 2) where each replay began; equal rows share a panel.
        positions: (N, T + 1, 2) metres.
        codes: (N,) the skill of each replay.
        alive: (N, T) False after a replay's end; all True without it.
    """
    places, panel = np.unique(np.asarray(starts), axis=0, return_inverse=True)
    panel = np.ravel(panel)
    figure, axes = _grid(len(places), task, width=2.6)
    for index, ax in enumerate(axes[: len(places)]):
        draw_walls(ax, task, goal=False)
        for n in np.flatnonzero(panel == index):
            steps = positions.shape[1] - 1 if alive is None else int(alive[n].sum())
            ax.plot(*positions[n, : steps + 1].T, color=skill_colour(int(codes[n])), linewidth=1.0, zorder=2)
            _number(ax, positions[n, steps], int(codes[n]), size=5)
        _start(ax, places[index])
        ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    figure.suptitle("Every skill from the same start: one panel a start", fontsize=9)
    return figure


def _grid(count: int, task: Task, width: float = 1.8) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` equal maze panels."""
    columns = min(4, count)
    rows = -(-count // columns)
    assert task.maze_map is not None
    height = width * len(task.maze_map) / len(task.maze_map[0]) + 0.25
    figure = Figure(figsize=(columns * width, rows * height + 0.4), layout="constrained")
    axes = list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
    for ax in axes[count:]:
        ax.set_visible(False)
    return figure, axes


def plot_failures(task: Task, result: RolloutResult, actor: str) -> Figure:
    """Where the failed episodes of a contestant ended, with the skill in use there; all ends when none failed."""
    table = result.episodes[result.episodes["actor"] == actor]
    if table.empty:
        raise UserError(f"there is no contestant '{actor}' in the table")
    failed = table[~table["success"].astype(bool)]
    shown = failed if len(failed) else table
    figure = Figure(figsize=(6.2, 4.4), layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    for row in shown.itertuples():
        _number(
            ax, np.array([row.final_x, row.final_y]), int(row.final_code)
        ) if row.final_code >= 0 else ax.plot(row.final_x, row.final_y, "o", color=NO_SKILL, markersize=4)
    title = (
        f"{actor}: where {len(failed)} of {len(table)} episodes failed"
        if len(failed)
        else f"{actor}: no episode of {len(table)} failed; where they ended"
    )
    ax.set_title(title + " (number: skill in use)", fontsize=9)
    return figure


def plot_value_map(
    task: Task,
    value: ValueFunction,
    codes: Callable[[NDArray[np.float32]], NDArray[np.int64]] | None = None,
    directions: NDArray[Any] | None = None,
    resolution: int = 6,
) -> Figure:
    """V over the free cells, the body at rest, with the chosen code and where it leads.

    Args:
        task: the maze.
        value: observations (N, O) to V (N,); position first, every other entry 0.
        codes: observations (N, O) to codes (N,), asked at cell centres.
        directions: (K, 2) mean displacement of each code in metres, for the arrows.
        resolution: points a cell on each axis.
    """
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    half = task.cell_size / 2
    offsets = (np.arange(resolution) + 0.5) / resolution * task.cell_size - half
    cells = [task.cell_to_xy(cell) for cell in task.free_cells()]
    grids = [np.stack(np.meshgrid(offsets, offsets), axis=-1) + centre for centre in cells]  # (R, R, 2) each
    points = np.concatenate([grid.reshape(-1, 2) for grid in grids])
    values = np.asarray(value(_at_rest(task, points))).reshape(len(cells), resolution, resolution)
    low, high = float(values.min()), float(values.max())
    image = None
    for centre, patch in zip(cells, values, strict=True):
        extent = (centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half)
        image = ax.imshow(
            patch, extent=extent, origin="lower", cmap="viridis", vmin=low, vmax=high, zorder=0.5
        )
    draw_limits = ax.get_xlim(), ax.get_ylim()
    if image is not None:
        figure.colorbar(image, ax=ax, shrink=0.8, label="V(s), learning reward")
    if codes is not None:
        chosen = np.asarray(codes(_at_rest(task, np.stack(cells))))
        for centre, code in zip(cells, chosen, strict=True):
            if directions is not None:
                step = (
                    directions[code]
                    / max(float(np.linalg.norm(directions[code])), 1e-6)
                    * 0.42
                    * task.cell_size
                )
                ax.annotate(
                    "",
                    tuple(centre + step),
                    tuple(centre),
                    arrowprops={"arrowstyle": "->", "color": "white", "lw": 1.2},
                    zorder=3,
                )
            _number(ax, centre, int(code), size=5)
    ax.set_xlim(draw_limits[0])
    ax.set_ylim(draw_limits[1])
    ax.set_title(
        "Value at rest; the code chosen at each cell's centre and where that code leads on average",
        fontsize=8,
    )
    return figure


def _at_rest(task: Task, points: NDArray[Any]) -> NDArray[np.float32]:
    """Observations (N, O) of a body at rest at positions (N, 2)."""
    observations = np.zeros((len(points), task.observation_dim), np.float32)
    observations[:, :2] = points
    return observations


def choose_episodes(result: RolloutResult, actor: str) -> Sequence[int]:
    """Episodes of a contestant worth showing first: successful ones, the median length in front."""
    table = result.episodes[result.episodes["actor"] == actor]
    good = table[table["success"].astype(bool)]
    pool = good if len(good) else table
    order = (pool["length"] - pool["length"].median()).abs().sort_values().index
    return [int(number) for number in pool.loc[order, "episode"]]
