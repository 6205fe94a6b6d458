"""Figures over a maze: where skills lead, how the policy combines them, and where it fails.

Every function takes a table of episodes and recorded paths, as returned by `rollout(..., record=True)` and
`RolloutResult.load`, and returns a matplotlib figure. Figures are 7 inches wide and still readable when printed in a
column of 3.5 inches.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import (
    LABEL,
    draw_number,
    draw_path,
    draw_starts,
    draw_trail,
    draw_walls,
    frame,
    grid,
    heading,
    maze_figure,
    panel_height,
    write_title,
    zoom,
)
from dds_lightning.interpret.draw.palette import GOAL, START, START_EDGE, skill_colour
from dds_lightning.interpret.draw.values import plot_value_map as plot_value_map
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.tasks import Task

REACH = 2.5
"""Half the side of the window around a start, in cells."""


def _rows_of(result: RolloutResult, actor: str) -> Any:
    """Return the rows of one contestant.

    Raises:
        UserError: The result has no such contestant.
    """
    table = result.episodes[result.episodes["actor"] == actor]
    if table.empty:
        known = ", ".join(result.episodes["actor"].unique())
        raise UserError(f"actor is '{actor}', expected one of the contestants in the table: {known}")
    return table


def _paths_of(result: RolloutResult, actor: str) -> list[tuple[Any, RolloutPath]]:
    """Return the rows of the table with their paths.

    Raises:
        UserError: The result has no such contestant, or nothing was recorded for it.
    """
    rows = [
        (row, result.paths[actor, int(row.episode)])
        for row in _rows_of(result, actor).itertuples()
        if (actor, int(row.episode)) in result.paths
    ]
    if not rows:
        raise UserError(f"no paths of '{actor}' were recorded: evaluate again with record=True")
    return rows


def _legend(ax: Axes, title: str, codes: NDArray[Any], label: Callable[[int, float], str], start: bool) -> None:
    """Draw the legend beside the maze: its marks, then the codes with their frequencies, the commonest first."""
    mark = partial(Line2D, [], [], linestyle="")
    handles = [mark(marker="*", markersize=11, color=START, markeredgecolor=START_EDGE, label="start")] if start else []
    handles.append(mark(marker="o", markersize=9, markerfacecolor="none", markeredgecolor=GOAL, label="goal"))
    values, counts = np.unique(codes, return_counts=True)
    for i in np.argsort(-counts, kind="stable"):
        text = label(int(counts[i]), counts[i] / counts.sum())
        name = f"{values[i]}: {text}" if values[i] >= 0 else f"no skill: {text}"
        handles.append(Line2D([], [], color=skill_colour(int(values[i])), linewidth=4, label=name))
    ax.legend(
        handles=handles,
        title=title,
        loc="upper left",
        bbox_to_anchor=(1.01, 1.015),
        borderaxespad=0.0,
        fontsize=9.5,
        title_fontsize=9.5,
        frameon=False,
        labelspacing=0.25,
        handlelength=1.2,
    )


def plot_trajectories(task: Task, result: RolloutResult, actor: str, episodes: int = 12, numbered: int = 1) -> Figure:
    """Draw episodes of one contestant over the maze, coloured by skill (the paper's AntMaze figure, d and h).

    Args:
        task: The maze.
        result: Table and paths.
        actor: The contestant.
        episodes: How many paths to draw; successful ones first.
        numbered: On how many of them the codes are written.

    Raises:
        UserError: The result has no such contestant, or no paths of it were recorded.
    """
    rows = sorted(_paths_of(result, actor), key=lambda row: not row[0].success)[:episodes]
    figure, ax = maze_figure(task)
    draw_walls(ax, task)
    for index, (_, path) in reversed(list(enumerate(rows))):  # those with numbers come last, on top
        draw_path(ax, path, linewidth=1.6, numbers=0.5 * task.cell_size if index < numbered else 0.0)
    draw_starts(ax, [path.positions[0] for _, path in rows], task.cell_size, size=16)
    table = _rows_of(result, actor)
    share = f"{table['success'].mean():.0%} of {len(table)} episodes reach the goal ({len(rows)} drawn)"
    ax.set_title(f"{actor}: {share}", fontsize=LABEL)
    codes = np.concatenate([path.codes for _, path in rows])
    _legend(ax, "skill: share", codes, lambda _, share: f"{share:.0%}", start=True)
    return figure


def plot_single_skills(task: Task, result: RolloutResult, actor: str = "single skill", steps: int = 150) -> Figure:
    """Draw each skill played alone in the task, one panel per skill.

    Args:
        task: The maze.
        result: Table and paths; every episode of the contestant keeps to one skill.
        actor: The contestant whose parts are single skills.
        steps: How many steps of each replay to draw; later ones only pile up against a wall.

    Raises:
        UserError: The result has no such contestant, or no paths of it were recorded.
    """
    groups: dict[int, list[tuple[Any, RolloutPath]]] = {}
    for row, path in _paths_of(result, actor):
        groups.setdefault(int(path.codes[0]), []).append((row, path))
    figure, axes = grid(len(groups), 1.75, panel_height(task, 1.75))
    for ax, (code, rows) in zip(axes, sorted(groups.items()), strict=True):
        draw_walls(ax, task)
        for _, path in rows:
            draw_path(ax, RolloutPath(path.positions[: steps + 1], path.codes[:steps]), linewidth=1.0)
        draw_starts(ax, [path.positions[0] for _, path in rows], task.cell_size, size=8)
        success = np.mean([bool(row.success) for row, _ in rows])
        heading(ax, code, f"{success:.0%} reach the goal")
    frame(figure, axes, task, f"Each skill alone from the task's start, first {steps} steps")
    return figure


def plot_starts_by_skill(
    task: Task,
    starts: NDArray[Any],
    positions: NDArray[Any],
    codes: NDArray[Any],
    alive: NDArray[Any] | None = None,
) -> Figure:
    """Draw each skill from several starts, one panel per skill (the paper's AntMaze figure, a to c).

    Args:
        task: The maze.
        starts: (N, 2) start of each replay in metres.
        positions: (N, T + 1, 2) metres.
        codes: (N,) the skill of each replay.
        alive: (N, T) False after a replay's end; None means all True.
    """
    shown = np.unique(codes)
    figure, axes = grid(len(shown), 1.75, panel_height(task, 1.75))
    lengths = _lengths(positions, alive)
    for ax, code in zip(axes, shown, strict=True):
        draw_walls(ax, task, goal=False)
        members = np.flatnonzero(np.asarray(codes) == code)
        for n in members:
            draw_trail(ax, positions[n, : lengths[n] + 1], int(code), 1.3)
        draw_starts(ax, [positions[n, 0] for n in members], task.cell_size, size=7)
        heading(ax, int(code))
    places = len(np.unique(np.asarray(starts), axis=0))
    starting = f"{places} start{'' if places == 1 else 's'}"
    frame(figure, axes, task, f"Each skill alone from {starting}, {positions.shape[1] - 1} steps")
    return figure


def plot_skills_by_start(
    task: Task,
    starts: NDArray[Any],
    positions: NDArray[Any],
    codes: NDArray[Any],
    alive: NDArray[Any] | None = None,
    reach: float | None = None,
) -> Figure:
    """Draw all skills from each of several starts, one close-up panel per start.

    A skill's number marks where its replay ends or leaves the panel.

    Args:
        task: The maze.
        starts: (N, 2) start of each replay in metres; equal rows share a panel.
        positions: (N, T + 1, 2) metres.
        codes: (N,) the skill of each replay.
        alive: (N, T) False after a replay's end; None means all True.
        reach: Half the side of the window in metres; None takes two and a half cells.
    """
    places, panel = np.unique(np.asarray(starts), axis=0, return_inverse=True)
    figure, axes = grid(len(places), 7.0 / 3, 2.4, columns=3)
    lengths = _lengths(positions, alive)
    for index, ax in enumerate(axes):
        draw_walls(ax, task)
        members = np.flatnonzero(np.ravel(panel) == index)
        for n in members:
            draw_trail(ax, positions[n, : lengths[n] + 1], int(codes[n]), 1.6)
        draw_starts(ax, [positions[n, 0] for n in members], task.cell_size, size=19)
        zoom(ax, task, places[index], REACH * task.cell_size if reach is None else reach)
        for n in members:  # above every path
            draw_number(ax, _last_seen(ax, positions[n, : lengths[n] + 1]), int(codes[n]), size=6.5)
        ax.tick_params(labelsize=8)
        ax.xaxis.get_label().set_fontsize(9)
        ax.yaxis.get_label().set_fontsize(9)
        ax.label_outer()
        ax.tick_params(labelbottom=True, labelleft=True)
    steps = positions.shape[1] - 1
    write_title(figure, f"Every skill alone from the same start, {steps} steps; one panel per start")
    return figure


def _last_seen(ax: Axes, path: NDArray[Any]) -> NDArray[Any]:
    """Return the last position of a path (T + 1, 2) before it leaves the panel."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    out = np.flatnonzero(((path < (left, bottom)) | (path > (right, top))).any(axis=1))
    return np.asarray(path[max(out[0] - 1, 0) if len(out) else -1])


def _lengths(positions: NDArray[Any], alive: NDArray[Any] | None) -> NDArray[np.int64]:
    """Return the number of steps (N,) of each replay."""
    if alive is None:
        return np.full(len(positions), positions.shape[1] - 1)
    return np.asarray(alive).sum(axis=1)


def plot_failures(task: Task, result: RolloutResult, actor: str) -> Figure:
    """Draw where the failed episodes of a contestant ended, with the skill in use there; all ends if none failed.

    A dot is one end; the bold number in a cell is their count.

    Raises:
        UserError: The result has no such contestant.
    """
    table = _rows_of(result, actor)
    failed = table[~table["success"].astype(bool)]
    shown = failed if len(failed) else table
    figure, ax = maze_figure(task)
    draw_walls(ax, task)
    ends, codes = shown[["final_x", "final_y"]].to_numpy(), shown["final_code"].to_numpy()
    colours = [skill_colour(int(code)) for code in codes]
    ax.scatter(ends[:, 0], ends[:, 1], s=30, c=colours, edgecolors="white", linewidths=0.4, zorder=3)
    written, room = np.empty((0, 2)), 0.3 * task.cell_size  # the space that a number needs
    for end, code in zip(ends, codes, strict=True):
        if code >= 0 and np.all(np.linalg.norm(end - written, axis=1) >= room):
            written = np.concatenate([written, end[None]])
            draw_number(ax, end, int(code), size=8)
    cells, counts = np.unique(task.xy_to_cell(ends), axis=0, return_counts=True)
    for cell, count in zip(cells, counts, strict=True):
        x, y = task.cell_to_xy(cell)
        style: dict[str, Any] = {"fontsize": LABEL, "fontweight": "bold", "ha": "center", "va": "center"}
        text = ax.text(x, y, f"{count}×", zorder=8, **style)  # above the ends: half hidden, 16 would read as 6
        text.set_path_effects([withStroke(linewidth=3.0, foreground="white")])
    if len(failed):
        title = f"{actor}: where {len(failed)} of {len(table)} episodes failed"
    else:
        title = f"{actor}: no episode of {len(table)} failed; where they ended"
    ax.set_title(title, fontsize=LABEL)
    _legend(ax, "skill in use", codes, lambda count, _: f"{count}×", start=False)
    return figure


def choose_episodes(result: RolloutResult, actor: str) -> Sequence[int]:
    """Return a contestant's episodes in the order to show them: successful ones first, beginning with median length."""
    table = result.episodes[result.episodes["actor"] == actor]
    good = table[table["success"].astype(bool)]
    pool = good if len(good) else table
    order = (pool["length"] - pool["length"].median()).abs().sort_values().index
    return [int(number) for number in pool.loc[order, "episode"]]
