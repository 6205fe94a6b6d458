"""How a policy combines skills: the paths of a few episodes, and below them the timeline of the codes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import (
    LABEL,
    TICKS,
    crop,
    draw_path,
    draw_starts,
    draw_walls,
    panel_height,
    write_title,
)
from dds_lightning.interpret.draw.palette import ink, skill_colour
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of

WIDTH = 7.0
"""Width of a figure in inches."""
MAZES = 2
"""Number of episodes whose path is drawn."""
SPAN = 400
"""Number of steps shown without a maze: a runner repeats its movements."""
ROOM = 6.1
"""Width of a timeline in inches."""
SIZES = 4.5, 7.0
"""Font sizes of the numbers in a timeline; a number is left out if not even the smallest fits."""


def runs_of(codes: NDArray[Any]) -> list[tuple[int, int, int]]:
    """Split a sequence into segments of one code each: (first step, number of steps, code)."""
    codes = np.asarray(codes)
    cuts = np.flatnonzero(np.diff(codes)) + 1
    starts = np.concatenate([[0], cuts]).astype(int)
    lengths = np.diff(np.concatenate([starts, [len(codes)]])).astype(int)
    return [(int(start), int(length), int(codes[start])) for start, length in zip(starts, lengths, strict=True)]


def best_episodes(result: RolloutResult, actor: str, count: int) -> list[int]:
    """Return the recorded episodes to show: successful ones, shortest first; otherwise by score.

    Raises:
        UserError: No paths of that contestant were recorded.
    """
    table = result.episodes[result.episodes["actor"] == actor]
    recorded = [int(number) for number in table["episode"] if (actor, int(number)) in result.paths]
    if not recorded:
        raise UserError(f"no paths of '{actor}' were recorded: evaluate again with record=True")
    table = table[table["episode"].isin(recorded)]
    good = table[table["success"].fillna(False).astype(bool)]
    if len(good):
        order = good.sort_values("length", kind="stable")
    else:
        order = table.sort_values("score", ascending=False, kind="stable")
    return [int(number) for number in order["episode"][:count]]


def plot_stitching(task: Task, result: RolloutResult, actor: str, episodes: int = 6) -> Figure:
    """Draw successful episodes with the skill in use, as paths and as a timeline (the paper's figure 4, d and h).

    In a maze the first two are drawn over it, with a skill's number where it takes over; for a runner the height of the
    first, if its observations were recorded. Each episode is a row of the timeline: all of it in a maze, otherwise its
    first 400 steps. If none succeeded, or the task does not measure success, the best by score are shown.

    Args:
        task: The task that was played.
        result: Table and paths, see `rollout` with ``record=True`` or ``record_observations=True``.
        actor: The contestant.
        episodes: Number of rows in the timeline.

    Raises:
        UserError: No paths of that contestant were recorded.
    """
    chosen = best_episodes(result, actor, episodes)
    table = result.episodes[result.episodes["actor"] == actor].set_index("episode")
    rows = 0.3 * len(chosen) + 0.75
    mazes = min(MAZES, len(chosen)) if task.maze_map is not None else 0
    course = body_of(task).moves == "course" and result.paths[actor, chosen[0]].observations is not None
    tall = panel_height(task, WIDTH / MAZES - 0.55) + 0.55 if mazes else 1.7 if course else 0.0
    figure = Figure(figsize=(WIDTH, rows + tall + 0.35), layout="constrained")
    title = "the skill in use"
    if mazes:
        upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[tall, rows]).ravel()
        for number, ax in zip(chosen, np.ravel(upper.subplots(1, MAZES, squeeze=False)), strict=False):
            _draw_way(ax, task, result, actor, number)
            ax.set_title(f"episode {number}: {table.loc[number, 'length']} steps", fontsize=TICKS - 1)
            ax.label_outer()
        for ax in upper.axes[mazes:]:
            ax.remove()
        timeline = lower.subplots()
    elif course:
        upper, timeline = figure.subplots(2, 1, height_ratios=[tall, rows], sharex=True)
        _draw_height(upper, result.paths[actor, chosen[0]])
        upper.set_title(f"episode {chosen[0]}", fontsize=TICKS - 1)
    else:
        timeline = figure.subplots()
    sequences = [result.paths[actor, number].codes for number in chosen]
    if not mazes and max(map(len, sequences)) > SPAN:
        sequences = [codes[:SPAN] for codes in sequences]
        title += f" in the first {SPAN} steps"
    draw_timeline(timeline, sequences, _names(task, table, chosen))
    write_title(figure, f"{actor}: {title}")
    return figure


def draw_timeline(ax: Axes, sequences: Sequence[NDArray[Any]], names: Sequence[str]) -> None:
    """Draw codes over time, one row per episode, with the number of a skill if there is room.

    Args:
        ax: Axes to draw on.
        sequences: (T,) codes in use of each row.
        names: Names of the rows.
    """
    longest = max(len(codes) for codes in sequences)
    for place, codes in enumerate(sequences):
        for start, length, code in runs_of(codes):
            colour = skill_colour(code)
            ax.barh(place, length, left=start, height=0.78, color=colour, edgecolor="white", linewidth=0.4)
            size = min(55 * ROOM * length / longest, SIZES[1])  # two digits of this size are as wide as the segment
            if size >= SIZES[0] and code >= 0:
                middle = start + length / 2
                ax.text(middle, place, str(code), color=ink(colour), fontsize=size, ha="center", va="center")
    ax.set_yticks(range(len(sequences)), names, fontsize=TICKS - 2)
    ax.set(xlim=(0, longest), ylim=(len(sequences) - 0.5, -0.5))
    ax.set_xlabel("step of the episode", fontsize=LABEL - 1)
    ax.tick_params(axis="x", labelsize=TICKS - 1)
    ax.tick_params(axis="y", length=0)
    ax.spines[["top", "right", "left"]].set_visible(False)


def _draw_way(ax: Axes, task: Task, result: RolloutResult, actor: str, number: int) -> None:
    path = result.paths[actor, number]
    draw_walls(ax, task)
    draw_path(ax, path, linewidth=2.0, numbers=0.75 * task.cell_size)
    draw_starts(ax, [path.positions[0]], task.cell_size, size=13)
    crop(ax, task)
    ax.tick_params(labelsize=TICKS - 2)
    ax.xaxis.get_label().set_fontsize(LABEL - 2)
    ax.yaxis.get_label().set_fontsize(LABEL - 2)


def _draw_height(ax: Axes, path: RolloutPath) -> None:
    """Draw the height of a runner's torso, coloured by the skill in use."""
    assert path.observations is not None
    height = np.asarray(path.observations)[: SPAN + 1, 0]
    for start, length, code in runs_of(path.codes[:SPAN]):
        span = np.arange(start, start + length + 1)
        ax.plot(span, height[span], color=skill_colour(code), linewidth=2.0, solid_capstyle="round")
    ax.set_ylabel("height of the\ntorso (m)", fontsize=LABEL - 2)
    ax.tick_params(labelsize=TICKS - 2, labelbottom=False)
    ax.spines[["top", "right"]].set_visible(False)


def _names(task: Task, table: Any, chosen: list[int]) -> list[str]:
    if not task.measures_success:
        return [f"episode {number}\nscore {table.loc[number, 'score']:.0f}" for number in chosen]
    outcome = {True: "succeeds", False: "fails"}
    return [f"episode {number}\n{outcome[bool(table.loc[number, 'success'])]}" for number in chosen]
