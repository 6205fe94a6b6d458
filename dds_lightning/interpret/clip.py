"""A short clip of an episode in a maze, drawn without any graphics driver."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dds_lightning.files import written_whole
from dds_lightning.interpret.maze import draw_walls
from dds_lightning.interpret.palette import START, skill_colour
from dds_lightning.results import RolloutPath
from dds_lightning.tasks import Task


def write_clip(
    path: str | Path, task: Task, episode: RolloutPath, title: str = "", frames: int = 90, fps: int = 15
) -> Path:
    """Write an episode as an animated GIF: the walls, the body, its trail coloured by the skill in use.

    Args:
        path: the file to write.
        task: the maze.
        episode: the path to show.
        title: one line above the maze.
        frames: at most this many frames; the episode is thinned to fit.
        fps: frames a second.
    """
    positions, codes = np.asarray(episode.positions), np.asarray(episode.codes)
    shown = np.unique(np.linspace(1, len(codes), min(frames, len(codes))).round().astype(int))
    figure = Figure(figsize=(4.2, 3.3), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    draw_walls(ax, task)
    ax.set(xlabel="", ylabel="", xticks=[], yticks=[])
    ax.plot(*positions[0], marker="*", markersize=11, color=START, markeredgecolor="#7a3b00", zorder=3)
    pieces = np.stack([positions[:-1], positions[1:]], axis=1)
    trail = LineCollection([], linewidths=2.0, zorder=2)
    ax.add_collection(trail)
    (body,) = ax.plot([], [], "o", markersize=8, markeredgecolor="black", zorder=6)
    heading = ax.set_title(title, fontsize=9, family="monospace")
    canvas.draw()
    figure.set_layout_engine(
        "none"
    )  # the layout stays as it is: computing it for each frame costs most of the time
    colours = [skill_colour(int(code)) for code in codes]
    images = []
    for t in shown:
        trail.set_segments(list(pieces[:t]))
        trail.set_color(colours[:t])
        body.set_data([positions[t][0]], [positions[t][1]])
        body.set_color(colours[t - 1])
        heading.set_text(f"{title}  skill {codes[t - 1]:2d}  step {t:3d}".strip())
        canvas.draw()
        images.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    durations = [1000 // fps] * (len(images) - 1) + [1500]  # the last one stays, to see the end
    path = Path(path)
    with written_whole(path) as part:
        imageio.imwrite(part, images, extension=".gif", duration=durations, loop=0)
    return path
