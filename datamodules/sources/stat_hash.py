"""Telling given data from changed ones without reading them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from datamodules.sources import SOURCES
from datamodules.sources.fetch import find_d4rl
from datamodules.sources.minari import minari_root
from dds_lightning.errors import UserError


def signature(spec: str) -> str:
    """Hash of the names, sizes and times of a data set's files.

    Args:
        spec: As in `load_trajectories`.

    Raises:
        UserError: An unknown source, or nothing is there.
    """
    place = locate(spec)
    files = [place] if place.is_file() else sorted(entry for entry in place.rglob("*") if entry.is_file())
    facts = [(str(f.relative_to(place)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


def locate(spec: str) -> Path:
    """The file or folder of a data set.

    Raises:
        UserError: An unknown source, or nothing is there.
    """
    source, _, rest = spec.partition(":")
    place = Path(rest).expanduser()
    if source == "minari":
        place = minari_root() / rest
    elif source == "d4rl" and rest:
        place = find_d4rl(rest)
    if source not in SOURCES or not rest or not place.exists():
        expected = ", ".join(f"{name}:..." for name in SOURCES)
        raise UserError(f"data: there is nothing at {place} (from '{spec}'); expected one of {expected}")
    return place
