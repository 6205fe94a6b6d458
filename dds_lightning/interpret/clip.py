"""A short clip of an episode in a maze, drawn without any graphics driver.

The walls are drawn once. Every frame starts from that picture, adds what moved, and shares one table of colours with
the others: that is what makes it fast and the file small.
"""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from dds_lightning.files import written_whole
from dds_lightning.interpret.drawing import draw_starts, draw_walls
from dds_lightning.interpret.palette import ink, skill_colour
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
    figure = Figure(figsize=(4.2, 3.5), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
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
    canvas.draw()
    figure.set_layout_engine("none")  # what moves must not move the maze
    moving = (trail, body, number, caption)
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)

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
        canvas.restore_region(background)
        for artist in moving:
            figure.draw_artist(artist)
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    # The last picture has nearly every colour of the others; of the rest the nearest is near enough.
    colour_table = images[-1].quantize(256)
    small = [image.quantize(palette=colour_table, dither=Image.Dither.NONE) for image in images]
    durations = [1000 // fps] * (len(small) - 1) + [1500]  # the last one stays, to see the end
    path = Path(path)
    with written_whole(path) as part:
        small[0].save(part, format="GIF", save_all=True, append_images=small[1:], duration=durations, loop=0)
    return path
