"""Figures as PNG files, also small ones for a repository."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import cKDTree

from dds_lightning.interpret.draw.palette import NO_SKILL, SKILL_COLOURS, START, WALL

SMALL = 200_000
"""Maximum size of a small picture in bytes."""
FIXED = np.array(
    [[round(255 * c) for c in to_rgb(name)] for name in (*SKILL_COLOURS, WALL, START, NO_SKILL, "white", "black")]
)
"""Colours (F, 3) that carry meaning."""


def png_bytes(figure: Figure, dpi: float = 130) -> bytes:
    """Encode a figure as PNG; the same figure gives the same bytes."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None})
    return file.getvalue()


def small_png(data: bytes, limit: int = SMALL) -> bytes:
    """Reduce a PNG picture to 256 colours, or to as many fewer as it takes to stay below `limit` bytes.

    The colours of skills, walls and paper stay exactly as they are, and so do the commonest ones; a photograph becomes
    coarser. A picture may still be larger with 64 colours, the minimum.
    """
    with Image.open(io.BytesIO(data)) as image:
        picture = image.convert("RGB")
    channels = np.asarray(picture, dtype=np.int64)
    weights = np.array([1 << 16, 1 << 8, 1])
    packed, place, count = np.unique((channels * weights).sum(axis=-1), return_inverse=True, return_counts=True)
    found = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=-1)  # (N, 3) distinct colours
    for colours in (256, 128, 64):
        commonest = found[np.argsort(-count, kind="stable")[: colours // 2 - len(FIXED)]]
        others = np.reshape(picture.quantize(colours // 2).getpalette() or [0, 0, 0], (-1, 3))
        palette = np.concatenate([FIXED, commonest, others])[:colours]
        nearest = cKDTree(palette).query(found)[1]
        reduced = Image.fromarray(nearest[place].reshape(channels.shape[:2]).astype(np.uint8), mode="P")
        reduced.putpalette(palette.astype(np.uint8).tobytes())
        file = io.BytesIO()
        reduced.save(file, format="png", optimize=True)
        if file.tell() < limit:
            break
    return file.getvalue()
