"""Stroboscopic pictures and clips of moving bodies: stick figures of the model's limbs (the paper's figure 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.drawing import LABEL, TICKS, draw_walls, grid, heading, write_title
from dds_lightning.interpret.draw.gif import CachedBackground, gif_bytes
from dds_lightning.interpret.draw.palette import NO_SKILL, WALL, skill_colour
from dds_lightning.interpret.measure.body import BodyFrames
from dds_lightning.interpret.views import View, has_view, view_of
from dds_lightning.tasks import Task

WIDTH = 7.0
"""Width of a figure in inches."""
FAINTEST = 0.16
"""Opacity of the first body of a series; that of the last one is 1."""
MARGIN = 0.25
"""Margin around the drawing in metres."""
WIDE = 3.5
"""Panels wider than this times their height are placed one below the other."""
ROUND = np.linspace(-np.pi / 2, np.pi / 2, 7)
"""Angles of the polygon corners at the round end of a limb."""

Floats = NDArray[np.float64]


def plot_strobes(
    task: Task, frames: Mapping[int, BodyFrames], every: int, step_seconds: float | None = None, title: str = ""
) -> Figure:
    """Draw a body under several skills: its pose at regular intervals, the last one solid, and the paths of its joints.

    All panels have the same scale. A runner is seen from the side, an ant from above between the walls, the kitchen's
    arm from behind with the objects that it can move.

    Args:
        task: The environment.
        frames: Code -> T + 1 frames, all from the same state; one panel each, in this order.
        every: Steps between two drawn bodies.
        step_seconds: Seconds per step; None takes the task's.
        title: Title above the panels; None describes what is drawn.

    Raises:
        UserError: There is nothing to draw.
    """
    if not frames or every < 1:
        raise UserError(f"frames has {len(frames)} skills and every is {every}, expected at least 1 of each")
    view = _view(task, list(frames.values()))
    seconds = task.step_seconds if step_seconds is None else step_seconds
    low, high = _window(view, list(frames.values()))
    across, up = high - low
    columns = 1 if across > WIDE * up else 2
    wide = WIDTH / min(columns, len(frames))
    figure, axes = grid(len(frames), wide, (wide - 0.6) * up / across + 0.72, columns)
    for ax, (code, body) in zip(axes, frames.items(), strict=True):
        _scene(ax, task, view, body)
        last = len(body) - 1
        for t in range(last % every, last + 1, every):  # the last one is always shown
            colour = to_rgba(skill_colour(code), FAINTEST + (1 - FAINTEST) * (t / max(last, 1)) ** 1.5)
            _draw_body(ax, view, body, t, colour)
        faint = 0.35 if view.axes == (0, 1) else 0.8  # an ant has many joints
        for path in np.moveaxis(body.joints[:, :, view.axes], 1, 0):  # (J, T + 1, 2)
            ax.plot(*path.T, color=NO_SKILL, linewidth=0.7, alpha=faint, zorder=4)
        if view.axes == (0, 1):
            ax.plot(*body.root[:, view.axes].T, color="black", linewidth=1.2, zorder=5)
        if len(body.names):
            _draw_moved(ax, view, body, skill_colour(code))
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.tick_params(labelsize=TICKS - 2)
        falls = view.ground and len(body) < max(map(len, frames.values()))
        heading(ax, code, _moved(view, body, seconds, falls))
        ax.set_xlabel(view.labels[0], fontsize=LABEL - 2)
        ax.set_ylabel(view.labels[1], fontsize=LABEL - 2)
        ax.yaxis.set_major_locator(MaxNLocator(nbins=5))
        ax.label_outer()
        ax.tick_params(labelbottom=True, labelleft=True)
    shown_title = title or f"Each skill from the same state, a body every {every * seconds:g} s"
    write_title(figure, shown_title, LABEL - 1)
    return figure


def body_clip(
    task: Task, body: BodyFrames, code: int, frames: int = 36, fps: int = 12, size: float = 2.9, seconds: float = 0.0
) -> bytes:
    """Encode a moving stick figure as an animated GIF.

    Args:
        task: The environment.
        body: T + 1 frames.
        code: The skill's code, which determines the colour.
        frames: Maximum number of frames.
        fps: Frames per second.
        size: Width in inches at 80 dots per inch.
        seconds: Seconds per step; 0 takes the task's.
    """
    shown = np.unique(np.linspace(0, len(body) - 1, min(frames, len(body))).round().astype(int))
    pictures = body_pictures(task, body, np.full(len(body), code), shown, size, seconds)
    return gif_bytes(pictures, fps, colours=64)


def body_pictures(
    task: Task,
    body: BodyFrames,
    codes: NDArray[Any],
    shown: NDArray[np.int64],
    size: float = 2.9,
    seconds: float = 0.0,
) -> list[NDArray[np.uint8]]:
    """Draw a moving stick figure.

    Args:
        task: The environment.
        body: T + 1 frames.
        codes: (T + 1,) codes in use, which determine the colour.
        shown: The frames to draw.
        size: Width in inches at 80 dots per inch.
        seconds: Seconds per step; 0 takes the task's.
    """
    view, seconds = _view(task, [body]), seconds or task.step_seconds
    follows = view.ground
    low, high = _window(view, [_centred(body) if follows else body])
    tall = float(np.clip(size * (high[1] - low[1]) / (high[0] - low[0]), 1.2, 0.8 * size)) + 0.3
    if follows:  # the ground extends on both sides
        half = max((high[1] - low[1]) * size / (tall - 0.3), high[0] - low[0]) / 2
        low[0], high[0] = np.array([-half, half]) + (low[0] + high[0]) / 2
    figure = Figure(figsize=(size, tall), dpi=80)
    ax = figure.add_axes((0.0, 0.0, 1.0, (tall - 0.3) / tall))
    _scene(ax, task, view, body)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[], xlabel="", ylabel="")
    ax.spines[:].set_visible(False)
    limbs = PolyCollection([], edgecolor="white", linewidth=0.5, zorder=3)
    marks = LineCollection([], color=NO_SKILL, linewidth=1.0, zorder=2)
    for artist in (limbs, marks):
        ax.add_collection(artist)
    (joints,) = ax.plot([], [], ".", color="black", markersize=3, zorder=4)
    (things,) = ax.plot([], [], "s", color=NO_SKILL, markersize=4, zorder=2)
    caption = figure.text(0.03, 1 - 0.08 / tall, "", fontsize=8.5, va="top")
    background = CachedBackground(figure, (marks, limbs, joints, things, caption))
    pictures = []
    for t in shown:
        offset = np.array([body.root[t, view.axes[0]], 0.0]) if follows else np.zeros(2)
        code = int(codes[t])
        limbs.set_facecolor(skill_colour(code))
        limbs.set_verts(list(_capsules(body, t, view) - offset))
        joints.set_data(*(body.joints[t][:, view.axes] - offset).T)
        things.set_data(*body.objects[t][:, view.axes].T)
        if follows:  # a mark on the ground every half metre shows the speed
            left, right = ax.get_xlim()
            places = np.arange(np.ceil((left + offset[0]) * 2) / 2, right + offset[0], 0.5) - offset[0]
            marks.set_segments([[(x, 0.0), (x, -0.07)] for x in places])
        caption.set_text(f"skill {code}   {t * seconds:4.2f} s   {_travel(view, body, t)}")
        pictures.append(background.frame())
    return pictures


# ---------------------------------------------------------------------- parts


def _view(task: Task, bodies: list[BodyFrames]) -> View:
    """A task's view; of a robot without one, from where its limbs spread most."""
    view = view_of(task)
    if has_view(task):
        return view
    spread = np.ptp(np.concatenate([body.limbs.reshape(-1, 3) for body in bodies]), axis=0)
    right, up = np.sort(np.argsort(spread)[1:])
    return replace(view, axes=(int(right), int(up)))


def _scene(ax: Axes, task: Task, view: View, body: BodyFrames) -> None:
    """Draw what does not move: walls, or the ground."""
    if task.maze_map is not None:
        draw_walls(ax, task)
    elif view.ground:
        ax.axhline(0.0, color=NO_SKILL, linewidth=0.8, zorder=1)
        ax.axhspan(-10.0, 0.0, color=WALL, zorder=0)
        ax.spines[["top", "right"]].set_visible(False)
    if len(body.names):
        draw_objects(ax, body.objects[0][:, view.axes], body.names)


def draw_objects(ax: Axes, places: Floats, names: Sequence[str]) -> None:
    """Draw a square at each place (M, 2), and write the name of each kind of object once, above its squares."""
    stems = [name.rstrip(" 0123456789") for name in names]
    kinds = [stem if stem == name else f"{stem}s" for stem, name in zip(stems, names, strict=True)]
    for kind in dict.fromkeys(kinds):
        members = places[[one == kind for one in kinds]]
        ax.plot(*members.T, "s", color=WALL, markeredgecolor=NO_SKILL, markersize=4, zorder=1)
        above = (float(members[:, 0].mean()), float(members[:, 1].max()))
        # To the left of a single one, whose neighbour may be close; above the middle of several.
        shift, side = (4, "right") if len(members) == 1 else (0, "center")
        ax.annotate(kind, above, (shift, 5), textcoords="offset points", ha=side, fontsize=7, color=NO_SKILL)


def _draw_body(ax: Axes, view: View, body: BodyFrames, t: int, colour: Any) -> None:
    polygons = list(_capsules(body, t, view))
    ax.add_collection(PolyCollection(polygons, facecolor=colour, edgecolor=(1, 1, 1, 0.7), linewidth=0.4, zorder=3))
    ax.plot(*body.joints[t][:, view.axes].T, ".", color="black", markersize=2.2, alpha=float(colour[3]), zorder=4)


def _draw_moved(ax: Axes, view: View, body: BodyFrames, colour: str) -> None:
    """Draw the paths of the objects that the arm moved."""
    for path in np.moveaxis(body.objects[:, :, view.axes], 1, 0):
        if np.linalg.norm(path[-1] - path[0]) > 0.01:
            ax.plot(*path.T, color=colour, linewidth=2.0, zorder=2)
            ax.plot(*path[-1], "s", color=colour, markersize=5, zorder=2)


def _capsules(body: BodyFrames, t: int, view: View) -> Floats:
    """Return the outlines (L, P, 2) of the limbs in the view."""
    ends = body.limbs[t][:, :, view.axes]  # (L, 2, 2)
    along = ends[:, 1] - ends[:, 0]
    angle = np.arctan2(along[:, 1], along[:, 0])[:, None]  # (L, 1)
    radius = (body.widths / 2)[:, None, None]
    front = radius * np.stack([np.cos(angle + ROUND), np.sin(angle + ROUND)], axis=-1)  # (L, 7, 2)
    return np.concatenate([ends[:, 1:] + front, ends[:, :1] - front], axis=1)


def _centred(body: BodyFrames) -> BodyFrames:
    """Return the body with its root at x = 0 in every frame."""
    shift = np.zeros_like(body.root)
    shift[:, 0] = body.root[:, 0]
    limbs, joints = body.limbs - shift[:, None, None], body.joints - shift[:, None]
    return BodyFrames(limbs, body.widths, joints, body.root - shift, body.objects, body.names)


def _window(view: View, bodies: list[BodyFrames]) -> tuple[Floats, Floats]:
    """Return lower left and upper right corner (2,) of the area that bodies, ground and objects need."""
    points = [body.limbs[..., view.axes].reshape(-1, 2) for body in bodies]
    points += [body.objects[..., view.axes].reshape(-1, 2) for body in bodies]
    everything = np.concatenate(points)
    low, high = everything.min(axis=0) - MARGIN, everything.max(axis=0) + MARGIN
    if view.ground:
        low[1] = -0.15
    return low, high


def _travel(view: View, body: BodyFrames, t: int) -> str:
    """Describe how far the root has moved by frame t."""
    away = (body.root[t] - body.root[0])[list(view.axes)]
    return f"{away[0]:+.2f} m" if view.ground else f"{np.linalg.norm(away):.2f} m"


def _moved(view: View, body: BodyFrames, seconds: float, falls: bool) -> str:
    """Describe a panel: how long, how far, how fast, or that the body falls."""
    last = len(body) - 1
    away = (body.root[-1] - body.root[0])[list(view.axes)]
    far = away[0] if view.ground else np.linalg.norm(away)
    what = "hand moves" if len(body.names) else "moves"
    end = "then falls" if falls else f"{far / max(last * seconds, 1e-9):.1f} m/s"
    return f"{what} {far:.2f} m in {last * seconds:.2g} s ({end})"
