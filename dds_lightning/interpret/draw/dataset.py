"""One figure of a data set: lengths and returns of its episodes, its actions, and the visited places of a maze.

The figure is 7 inches wide, like the others.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from datamodules.inspection import BLOCK, visits
from datamodules.trajectories import Trajectories
from dds_lightning.envs.kitchen import subtasks_done
from dds_lightning.interpret.draw.drawing import draw_starts, draw_walls, goal_outline
from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import action_names

LABEL, TICKS = 10.0, 9.0
WIDTH, TITLE = 7.0, 0.3
"""Inches."""
BARS = 30
"""Maximum number of bars in a histogram."""
ACTION_BARS = 41
SQUARES = 8
"""Squares per cell of a maze on each axis, for the visits."""
TRUNCATED, TERMINATED = SKILL_COLOURS[0], SKILL_COLOURS[6]


def plot_dataset(trajectories: Trajectories, task: Task | None = None) -> Figure:
    """Draw what is in a data set.

    Args:
        trajectories: The data; they are drawn as they are, so load them with the task to see its rewards.
        task: Adds the score to the returns, names to the actions and, for mazes, a map of the visited places;
            in the kitchen the subtasks that were done replace the returns.
    """
    if task is not None and task.maze_map is not None:
        rows, columns = len(task.maze_map), len(task.maze_map[0])
        tall = min(4.0 * rows / columns, 3.3)
        wide = tall * columns / rows + 0.65
        mosaic = [["maze", "lengths"], ["maze", "returns"]]
        figure, panels = _panels(trajectories.action_dim, mosaic, tall + 1.1, (wide, WIDTH - wide))
        _draw_visits(panels["maze"], trajectories, task)
        _draw_reached(panels["returns"], trajectories)
    elif task is not None and task.subtasks:
        mosaic = [["lengths", "returns", "subtasks"]]
        figure, panels = _panels(trajectories.action_dim, mosaic, 2.3, (1.0, 1.0, 1.2))
        _draw_subtasks(panels["returns"], panels["subtasks"], trajectories, task)
    else:
        figure, panels = _panels(trajectories.action_dim, [["lengths", "returns"]], 2.5, (1.0, 1.0))
        _draw_returns(panels["returns"], trajectories, task)
    _draw_lengths(panels["lengths"], trajectories, task)
    _draw_actions(panels["actions"], trajectories, task)
    for name, ax in panels.items():
        ax.tick_params(labelsize=TICKS)
        ax.xaxis.label.set_fontsize(LABEL)
        ax.yaxis.label.set_fontsize(LABEL)
        if name != "maze":
            ax.spines[["top", "right"]].set_visible(False)
    title = f"{trajectories.name}: {trajectories.num_steps:,} steps in {trajectories.num_episodes:,} episodes"
    figure.suptitle(title, fontsize=LABEL + 1, x=0.01, ha="left")
    return figure


def _panels(
    actions: int, mosaic: list[list[str]], height: float, widths: tuple[float, ...]
) -> tuple[Figure, dict[str, Axes]]:
    """Create a figure with some panels in `height` inches and, below them, room for the actions."""
    below = 0.24 * actions + 0.6
    figure = Figure(figsize=(WIDTH, height + below + TITLE), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[height, below]).ravel()
    panels = upper.subplot_mosaic(mosaic, width_ratios=widths)
    return figure, {**panels, "actions": lower.subplots()}


def _draw_visits(ax: Axes, trajectories: Trajectories, task: Task) -> None:
    draw_walls(ax, task)
    ax.add_patch(Polygon(goal_outline(task), fill=False, edgecolor="white", linewidth=3.0, zorder=4.5))
    counts = visits(trajectories, task, SQUARES)
    x = task.cell_to_xy([(0, j / SQUARES - 0.5) for j in range(counts.shape[1] + 1)])[:, 0]
    y = task.cell_to_xy([(i / SQUARES - 0.5, 0) for i in range(counts.shape[0] + 1)])[:, 1]
    seen = np.ma.masked_equal(counts, 0)
    norm = LogNorm(1, max(int(counts.max()), 10))
    mesh = ax.pcolormesh(x, y, seen, cmap="viridis_r", norm=norm, zorder=0.5, rasterized=True)
    draw_starts(ax, [task.start_xy()], task.cell_size, size=14)
    bar = ax.figure.colorbar(mesh, ax=ax, location="bottom", shrink=0.9, aspect=40, pad=0.02, format="%d")
    bar.set_label(f"visits per square of {task.cell_size / SQUARES:g} m (white: none)", fontsize=LABEL)
    bar.ax.tick_params(labelsize=TICKS)


def _draw_lengths(ax: Axes, trajectories: Trajectories, task: Task | None) -> None:
    """Draw episodes by length, with those that the task ended on top of those that the recording cut off."""
    lengths = trajectories.lengths
    terminated = trajectories.terminations[trajectories.step_offsets[1:] - 1]
    width = int(np.ceil((lengths.max() + 1) / BARS))
    edges = np.arange(0, lengths.max() + width + 1, width) - 0.5
    groups = ((lengths[~terminated], TRUNCATED, "truncated"), (lengths[terminated], TERMINATED, "terminated"))
    shown = [group for group in groups if len(group[0])]
    values, colours, labels = zip(*shown, strict=True)
    ax.hist(list(values), bins=list(edges), stacked=True, color=list(colours), label=list(labels))
    if task is not None and task.max_episode_steps < 1.5 * lengths.max():
        ax.axvline(task.max_episode_steps, color=NO_SKILL, linestyle=":", linewidth=1.2, label="cap of evaluation")
    ax.set(xlabel="steps of an episode", ylabel="episodes", xlim=(0, None))
    _head_room(ax)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))
    ax.legend(fontsize=TICKS - 1, frameon=False, loc="upper left", handlelength=1.2, labelspacing=0.2)


def _draw_returns(ax: Axes, trajectories: Trajectories, task: Task | None) -> None:
    returns = trajectories.returns
    low, high = float(returns.min()), float(returns.max())
    if low == high:
        low, high = low - 0.5, high + 0.5
    ax.hist(returns, bins=BARS, range=(low, high), color=TRUNCATED)
    ax.set(xlabel="return of an episode", ylabel="episodes")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))
    if task is not None:
        span = task.score_max - task.score_min
        above = ax.secondary_xaxis(
            "top", functions=(task.normalised_score, lambda score: np.asarray(score) * span / 100 + task.score_min)
        )
        above.set_xlabel("normalised score", fontsize=LABEL)
        above.tick_params(labelsize=TICKS)


def _draw_reached(ax: Axes, trajectories: Trajectories) -> None:
    """Draw how many episodes of a maze reach the goal: their returns are 1 or 0."""
    reached = int((trajectories.returns > 0).sum())
    counts = [trajectories.num_episodes - reached, reached]
    _bars(ax, ["no", "yes"], counts, [TRUNCATED, TERMINATED])
    ax.set(xlabel="episodes that reach the goal")


def _draw_subtasks(number: Axes, share: Axes, trajectories: Trajectories, task: Task) -> None:
    """Draw how many subtasks an episode completes, at any time, and which, as its environment rewards them."""
    done = np.concatenate([subtasks_done(block, task.subtasks) for block in _blocks(trajectories.observations)])
    done[trajectories.observation_offsets[:-1]] = False  # no step leads to an episode's first state
    ever = np.logical_or.reduceat(done, trajectories.observation_offsets[:-1], axis=0)  # (E, M)
    total = len(task.subtasks)
    number.bar(range(total + 1), np.bincount(ever.sum(axis=1), minlength=total + 1), color=TRUNCATED)
    number.set(xlabel="subtasks completed in an episode", ylabel="episodes", xticks=range(total + 1))
    number.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))
    _bars(share, list(task.subtasks)[::-1], [int(count) for count in ever.sum(axis=0)[::-1]], [TRUNCATED] * total)
    share.set(xlabel="episodes that complete it")


def _bars(ax: Axes, labels: list[str], counts: list[int], colours: list[str]) -> None:
    """Draw horizontal bars with their counts."""
    bars = ax.barh(labels, counts, color=colours, height=0.65)
    ax.bar_label(bars, labels=[f"{count:,}" for count in counts], padding=3, fontsize=TICKS)
    ax.set(xlim=(0, max(max(counts), 1) * 1.3))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=3))


def _draw_actions(ax: Axes, trajectories: Trajectories, task: Task | None) -> None:
    """Draw a row with a histogram for every entry of the actions, and the share of steps at its bounds.

    A controller that saturates has spikes at the bounds that would dwarf everything else: a row is scaled to the bars
    in between, and higher bars are cut off.
    """
    low, high = trajectories.action_low, trajectories.action_high
    counts, at_bounds = _action_counts(trajectories)
    heights = counts / np.maximum(counts[:, 1:-1].max(axis=1, keepdims=True), 1)
    names = action_names(task) if task is not None else ()
    if len(names) != len(counts):
        names = tuple(f"action {j}" for j in range(len(counts)))
    edges = np.linspace(-1.0, 1.0, ACTION_BARS + 1)
    places = len(counts) - 1 - np.arange(len(counts))  # the first on top
    for place, row, share in zip(places, np.minimum(heights, 1.0), at_bounds, strict=True):
        ax.stairs(place + 0.85 * row, edges, baseline=place, fill=True, color=TRUNCATED)
        ax.text(1.03, place + 0.3, f"{share:.0%}", fontsize=TICKS, va="center")
    ax.text(1.03, len(counts) + 0.15, "at a bound", fontsize=TICKS, va="center")
    ax.set(xlim=(-1.0, 1.0), ylim=(-0.1, len(counts)), yticks=places + 0.3, yticklabels=names)
    ax.tick_params(axis="y", length=0)
    same = bool(np.all(low == low[0]) and np.all(high == high[0]))
    if same:
        ticks = np.linspace(-1, 1, 5)
        ax.set(xticks=ticks, xticklabels=[f"{low[0] + (tick + 1) / 2 * (high[0] - low[0]):g}" for tick in ticks])
    else:
        ax.set(xticks=(-1, 1), xticklabels=("lower bound", "upper bound"))
    ax.set(xlabel="action (each row has its own scale)")


def _action_counts(trajectories: Trajectories) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return a histogram (A, ACTION_BARS) of each action entry over its box, and the share (A,) of steps at a bound."""
    low, span = trajectories.action_low, trajectories.action_high - trajectories.action_low
    width = trajectories.action_dim
    counts = np.zeros(width * ACTION_BARS, np.int64)
    at_bounds = np.zeros(width, np.int64)
    for block in _blocks(trajectories.actions):
        share = (block - low) / np.where(span > 0, span, 1.0)
        at_bounds += ((share <= 1e-3) | (share >= 1 - 1e-3)).sum(axis=0)
        bars = np.clip((share * ACTION_BARS).astype(np.int64), 0, ACTION_BARS - 1) + np.arange(width) * ACTION_BARS
        counts += np.bincount(bars.ravel(), minlength=len(counts))
    return counts.reshape(width, ACTION_BARS), at_bounds / len(trajectories.actions)


def _head_room(ax: Axes) -> None:
    """Leave room for a legend above the bars."""
    bottom, top = ax.get_ylim()
    ax.set_ylim(bottom, bottom + 1.35 * (top - bottom))


def _blocks(values: NDArray[Any]) -> Iterator[NDArray[Any]]:
    for first in range(0, len(values), BLOCK):
        yield values[first : first + BLOCK]
