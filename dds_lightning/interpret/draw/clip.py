"""A short clip of an episode in a maze, drawn without any graphics driver.

The walls are drawn once; every frame starts from that picture, adds what moved, and shares one colour table with the
others. That is fast and keeps the file small, unlike the animation writers of plotting libraries (see `gif`).
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.interpret.draw.drawing import draw_starts, draw_walls, extent
from dds_lightning.interpret.draw.gif import CachedBackground, gif_bytes
from dds_lightning.interpret.draw.palette import ink, skill_colour
from dds_lightning.rollout.result import RolloutPath
from dds_lightning.saving.files import written_whole
from dds_lightning.tasks import Task


def write_clip(
    path: str | Path, task: Task, episode: RolloutPath, title: str = "", frames: int = 90, fps: int = 15
) -> Path:
    """Write an episode as an animated GIF: the walls, the body, its trail coloured by the skill in use.

    Args:
        path: The file to write.
        task: The maze.
        episode: The path to show.
        title: Line of text above the maze.
        frames: Maximum number of frames; the episode is subsampled to fit.
        fps: Frames per second.
    """
    count = len(episode.codes)
    shown = np.unique(np.linspace(1, count, min(frames, count)).round().astype(int))
    path = Path(path)
    with written_whole(path) as part:
        part.write_bytes(gif_bytes(maze_pictures(task, episode, shown, title), fps))
    return path


def maze_pictures(
    task: Task, episode: RolloutPath, shown: NDArray[np.int64], title: str = ""
) -> list[NDArray[np.uint8]]:
    """Draw an episode after some of its steps, counted from 1; the rest as in `write_clip`."""
    positions, codes = np.asarray(episode.positions), np.asarray(episode.codes)
    figure = Figure(figsize=(4.2, 3.5), dpi=80, layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_xlabel(" ", fontsize=10)  # room for the caption
    caption = figure.text(0.015, 0.015, "", fontsize=10, family="monospace")
    draw_starts(ax, [positions[0]], task.cell_size, size=12)
    trail = LineCollection([], linewidths=2.4, zorder=2, capstyle="round")
    ax.add_collection(trail)
    (body,) = ax.plot([], [], "o", markersize=13, markeredgecolor="black", markeredgewidth=0.8, zorder=6)
    number = ax.text(0.0, 0.0, "", fontsize=7.5, ha="center", va="center", zorder=7)
    background = CachedBackground(figure, (trail, body, number, caption))

    pieces = np.stack([positions[:-1], positions[1:]], axis=1)  # (T, 2, 2)
    colours = [skill_colour(int(code)) for code in codes]
    images = []
    for t in shown:
        code, colour = int(codes[t - 1]), colours[t - 1]
        trail.set_segments(list(pieces[:t]))
        trail.set_color(colours[:t])
        body.set_data([positions[t][0]], [positions[t][1]])
        body.set_color(colour)
        body.set_markeredgecolor("black")
        number.set_position((float(positions[t][0]), float(positions[t][1])))
        number.set(text=str(code) if code >= 0 else "", color=ink(colour))
        caption.set_text((f"skill {code:2d}   " if code >= 0 else "") + f"step {t:3d}")
        images.append(background.frame())
    return images


def replay_clip(
    task: Task, positions: NDArray[Any], code: int, frames: int = 30, fps: int = 12, size: float = 2.9
) -> bytes:
    """Encode one skill from several starts of a maze at once as an animated GIF.

    Args:
        task: The maze.
        positions: (N, T + 1, 2) metres; a replay that has ended (NaN) stays where it was.
        code: The skill's code, which determines the colour.
        frames: Maximum number of frames.
        fps: Frames per second.
        size: Width in inches at 80 dots per inch.
    """
    positions = np.asarray(positions, dtype=float)
    known = np.isfinite(positions[..., 0])
    last = np.maximum.accumulate(np.where(known, np.arange(known.shape[1]), 0), axis=1)
    positions = np.take_along_axis(positions, last[..., None], axis=1)
    shown = np.unique(np.linspace(0, positions.shape[1] - 1, min(frames, positions.shape[1])).round().astype(int))
    (left, right), (bottom, top) = extent(task)
    tall = size * (top - bottom) / (right - left) + 0.3
    figure = Figure(figsize=(size, tall), dpi=80)
    ax = figure.add_axes((0.0, 0.0, 1.0, (tall - 0.3) / tall))
    draw_walls(ax, task)
    ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    ax.spines[:].set_visible(False)
    draw_starts(ax, list(positions[:, 0]), 0.0, size=6)
    trails = LineCollection([], color=skill_colour(code), linewidths=2.0, zorder=3, capstyle="round")
    ax.add_collection(trails)
    (bodies,) = ax.plot([], [], "o", color=skill_colour(code), markersize=5, markeredgecolor="black", zorder=6)
    caption = figure.text(0.03, 1 - 0.08 / tall, "", fontsize=8.5, va="top")
    background = CachedBackground(figure, (trails, bodies, caption))
    pictures = []
    for t in shown:
        trails.set_segments(list(positions[:, : t + 1]))
        bodies.set_data(*positions[:, t].T)
        caption.set_text(f"skill {code}   {t * task.step_seconds:4.2f} s")
        pictures.append(background.frame())
    return gif_bytes(pictures, fps, colours=64)
