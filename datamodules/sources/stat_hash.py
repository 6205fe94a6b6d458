"""Notices that a data set has changed without reading it: names, sizes and times of its files."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from datamodules.sources import parse_spec
from dds_lightning.errors import UserError


def stat_hash(spec: str) -> str:
    """Hash of the names, sizes and modification times of a data set's files.

    Args:
        spec: As in `load_trajectories`.

    Raises:
        UserError: For an unknown source, or when the data set does not exist.
    """
    path = locate(spec)
    files = [path] if path.is_file() else sorted(entry for entry in path.rglob("*") if entry.is_file())
    facts = [(str(f.relative_to(path)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


signature = stat_hash
"""Name in earlier versions."""


def locate(spec: str) -> Path:
    """The file or folder of a data set.

    Raises:
        UserError: For an unknown source, or when the data set does not exist.
    """
    source, rest = parse_spec(spec)
    path = source.locate(rest)
    if not path.exists():
        raise UserError(
            f"data: '{spec}' should be at {path}, but there is nothing at that path; expected {source.about}"
        )
    return path
