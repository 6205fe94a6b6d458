"""Files and folders written completely or not at all.

The libraries for atomic files cover a single file only, without folders, stale leftovers of killed processes and a
message that tells the user what a full or read-only disk means.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dds_lightning._version import __version__
from dds_lightning.errors import UserError

STALE_AFTER = 3600.0
"""Seconds after which an unfinished file belongs to nobody."""
DISK_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),  # full or failing
    *(errno.EROFS, errno.EACCES, errno.EPERM),  # not ours to write
    *(errno.ENOTDIR, errno.EISDIR),  # a path that leads elsewhere
)
"""What a disk says that the user can mend."""


def beside(path: Path) -> Path:
    """A hidden name next to `path` that nobody else uses, for what is not finished yet.

    What a kill left under such a name more than an hour ago is removed.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'?' * 8}.part"):
        with contextlib.suppress(OSError):
            touched = max(entry.stat().st_mtime for entry in (left, *left.rglob("*")))
            if time.time() - touched > STALE_AFTER:
                shutil.rmtree(left) if left.is_dir() else left.unlink()
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Write to the path this yields; when the block ends well it is synced and takes the place of `path`.

    Raises:
        OSError: it could not be written; what was at `path` is still there.
    """
    with _errors_name(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = beside(path)
        try:
            yield part
            sync(part)
            os.replace(part, path)
            sync(path.parent)
        finally:
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def folder_written_whole(folder: Path) -> Iterator[Path]:
    """Fill the folder this yields; when the block ends well it is synced and takes the place of `folder`.

    No system call exchanges two folders everywhere, so for a moment neither has the name: whoever reads calls
    `mend_folder` first.

    Raises:
        OSError: it could not be written; what was at `folder` is still there.
    """
    with _errors_name(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        mend_folder(folder)
        part = beside(folder)
        part.mkdir()
        try:
            yield part
            for entry in (*part.rglob("*"), part):
                sync(entry)
            if folder.exists():
                os.rename(folder, _previous(folder))
            os.rename(part, folder)
            sync(folder.parent)
        finally:
            mend_folder(folder)
            shutil.rmtree(part, ignore_errors=True)


def mend_folder(folder: Path) -> None:
    """After a stop while `folder` was replaced: the previous one comes back, or goes if the new one is in place."""
    previous = _previous(folder)
    if previous.is_dir():
        if folder.exists():
            shutil.rmtree(previous, ignore_errors=True)
        else:
            os.rename(previous, folder)


def _previous(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.previous")


@contextlib.contextmanager
def _errors_name(path: Path) -> Iterator[None]:
    """Let an error of the disk say what it kept from being written; its kind and number stay."""
    try:
        yield
    except OSError as error:
        number = errno.EIO if error.errno is None else error.errno  # NumPy tells of a short write without one
        if number not in DISK_ERRORS:
            raise
        told = f"{path} could not be written ({error.strerror or error}); what was there before is untouched"
        raise OSError(number, told) from error


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


def short(digest: str) -> str:
    """The beginning of a hash, as people compare it."""
    return digest[:8]


def refuse_newer(what: str | Path, found: Any, known: int) -> None:
    """Refuse what a later version of this package wrote.

    Args:
        what: the file or directory.
        found: the version of its format.
        known: the latest version that is understood here.

    Raises:
        UserError: it is newer, or no version.
    """
    if not isinstance(found, int) or found < 1:
        raise UserError(f"{what}: format_version is {found!r}, expected a number from 1 on")
    if found > known:
        raise UserError(
            f"{what} has format {found}, but this version of dds-lightning ({__version__}) reads up to "
            f"{known}: install a newer one"
        )


def neighbours(path: Path) -> str:
    """What lies where `path` was expected, as the end of a message."""
    folder = path.parent
    if not folder.is_dir():
        return f": the folder {folder} does not exist either"
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    return f"; {folder} holds {', '.join(names[:8]) or 'nothing'}{' ...' if names[8:] else ''}"
