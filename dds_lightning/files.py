"""Files written whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

STALE_AFTER = 3600.0
"""Seconds after which an unfinished file belongs to nobody."""


def beside(path: Path) -> Path:
    """A hidden name next to `path` that nobody else uses, for what is not finished yet.

    What a kill left under such a name more than an hour ago is removed.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'?' * 8}.part"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > STALE_AFTER:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Write to the path this yields; when the block ends well it is synced and takes the place of `path`.

    Raises:
        OSError: it could not be written; what was at `path` is still there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = beside(path)
    try:
        yield part
        sync(part)
        os.replace(part, path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Flush a file or a directory to the disk."""
    if os.name == "nt" and path.is_dir():
        return  # Windows opens no directory
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sha256(path: Path) -> str:
    """Hash of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def neighbours(path: Path) -> str:
    """What lies where `path` was expected, as the end of a message."""
    folder = path.parent
    if not folder.is_dir():
        return f": the folder {folder} does not exist either"
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    return f"; {folder} holds {', '.join(names[:8]) or 'nothing'}{' ...' if names[8:] else ''}"
