"""Episodes as a video: rendered by MuJoCo where a graphics driver works, else drawn; MP4 where something encodes it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.clip import maze_pictures
from dds_lightning.interpret.draw.gif import gif_bytes
from dds_lightning.interpret.draw.rendering import render_frames
from dds_lightning.interpret.draw.strobe import body_pictures
from dds_lightning.interpret.measure.body import body_frames
from dds_lightning.interpret.measure.replay import simulator
from dds_lightning.interpret.views import view_of
from dds_lightning.rollout.result import RolloutPath
from dds_lightning.saving.files import written_whole
from dds_lightning.tasks import Task

SUFFIXES = (".mp4", ".gif")
FPS = 25
"""Most frames a second."""
FRAMES = 300
"""Most frames of an episode; a longer one is shown faster."""


class Footage(NamedTuple):
    """One episode to be shown.

    Attributes:
        path: Positions (T + 1, 2) and codes (T,).
        qpos: (T + 1, nq) of the simulator; None where it is not MuJoCo.
        title: A line about it.
    """

    path: RolloutPath
    qpos: NDArray[Any] | None
    title: str


def episode_pictures(task: Task, episodes: Sequence[Footage]) -> tuple[list[NDArray[np.uint8]], float, str]:
    """Show episodes one after the other.

    Returns:
        Pictures (h, w, 3), how many a second, and "rendered" or "drawn".

    Raises:
        UserError: The environment is neither a maze nor simulated by MuJoCo.
    """
    every = max(1, round(1 / (FPS * task.step_seconds)))
    longest = max(len(episode.path.codes) for episode in episodes)
    every = max(every, -(-longest // FRAMES))
    fps = min(FPS, max(1.0, 1 / (every * task.step_seconds)))
    moments = [np.arange(0, len(episode.path.codes) + 1, every) for episode in episodes]
    states = [one.qpos[shown] for one, shown in zip(episodes, moments, strict=True) if one.qpos is not None]
    # From beside it a point in a maze is hidden by the walls.
    frames = render_frames(task, np.concatenate(states)) if states and view_of(task).limbs else None
    if frames is not None:
        return list(frames), fps, "rendered"
    pictures: list[NDArray[np.uint8]] = []
    for one, shown in zip(episodes, moments, strict=True):
        if task.maze_map is not None:
            pictures += maze_pictures(task, one.path, shown[1:], one.title)
        elif one.qpos is not None:
            with simulator(task) as env:
                body = body_frames(env.unwrapped.model, one.qpos)
            codes = np.append(one.path.codes, one.path.codes[-1:])
            pictures += body_pictures(task, body, codes, shown, size=4.2)
        else:
            raise UserError(
                f"task '{task.name}': {task.env_id} is neither a maze nor simulated by MuJoCo: nothing to draw"
            )
    return pictures, fps, "drawn"


def write_video(path: Path, pictures: Sequence[NDArray[np.uint8]], fps: float) -> Path:
    """Write pictures (h, w, 3) as MP4 or GIF; a GIF beside it where nothing encodes MP4.

    Returns:
        The file.
    """
    if path.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        path = path.with_suffix(".gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as part:
        if path.suffix == ".gif":
            part.write_bytes(gif_bytes(pictures, round(fps)))
        else:
            import imageio.v2 as imageio

            even = [picture[: len(picture) // 2 * 2, : picture.shape[1] // 2 * 2] for picture in pictures]  # H.264's
            settings: dict[str, Any] = {"format": "mp4", "fps": fps, "macro_block_size": 2}
            part.write_bytes(imageio.mimwrite("<bytes>", even, **settings))  # type: ignore[arg-type]
    return path
