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
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dds_lightning._version import __version__
from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import remove_tree

STALE_AFTER = 3600.0
"""Seconds after which an unfinished file is taken for a leftover."""
DISK_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),  # full or failing
    *(errno.EROFS, errno.EACCES, errno.EPERM),  # no permission to write
    *(errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP),  # a path that leads elsewhere
    *(errno.ESTALE, errno.ENODEV, errno.ENXIO, errno.ETIMEDOUT),  # a share that has gone
)
"""Errors of a disk that the user can fix."""
UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
"""What shares and FUSE answer to a flush that they do not know: the file is in place all the same."""


def beside(path: Path) -> Path:
    """Return a unique hidden name next to `path`, for what is not finished yet.

    Leftovers of a killed process, more than an hour old, are removed.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'?' * 8}.part"):
        with contextlib.suppress(OSError):
            touched = max(entry.stat().st_mtime for entry in (left, *left.rglob("*")))
            if time.time() - touched > STALE_AFTER:
                left.unlink() if left.is_symlink() or not left.is_dir() else remove_tree(left, path.parent)
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a path to write to; if the block succeeds, it is synced and replaces `path`.

    Raises:
        OSError: It could not be written; what was at `path` is still there.
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
    """Yield a folder to fill; if the block succeeds, it is synced and replaces `folder`.

    No portable system call exchanges two folders, so for a moment neither has the name: readers call `mend_folder`
    first.

    Raises:
        OSError: It could not be written; what was at `folder` is still there.
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
            remove_tree(part, part.parent)


def mend_folder(folder: Path) -> None:
    """Finish an interrupted replacement of `folder`: restore the previous one, or delete it if a new one exists."""
    previous = _previous(folder)
    if previous.is_dir() and not previous.is_symlink():
        if folder.exists():
            remove_tree(previous, previous.parent)
        else:
            os.rename(previous, folder)


def _previous(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.previous")


@contextlib.contextmanager
def _errors_name(path: Path) -> Iterator[None]:
    """Add to a disk error what could not be written; its type and number stay."""
    try:
        yield
    except OSError as error:
        number = errno.EIO if error.errno is None else error.errno  # NumPy reports a short write without one
        if number not in DISK_ERRORS:
            raise
        message = f"{path} could not be written ({error.strerror or error}); what was there before is untouched"
        raise OSError(number, message) from error


def sync(path: Path) -> None:
    """Flush a file or a directory to the disk."""
    if os.name == "nt" and path.is_dir():
        return  # Windows cannot open a directory
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
    finally:
        os.close(handle)


def home() -> Path:
    """The user's home; where there is none, as in some containers, a folder for temporary files."""
    try:
        return Path.home()
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"dds-lightning-{os.getuid() if hasattr(os, 'getuid') else 0}"


def expand(path: str | os.PathLike[str]) -> Path:
    """A path with `~` replaced by the user's home.

    Raises:
        UserError: It begins with `~` and there is no such home.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise UserError(f"{path}: there is no home folder here (HOME is not set): give the whole path") from None


def sha256(path: Path) -> str:
    """Return the hash of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def short(digest: str) -> str:
    """Return the beginning of a hash, enough for people to compare."""
    return digest[:8]


def refuse_newer(what: str | Path, found: Any, known: int) -> None:
    """Refuse what a newer version of this package wrote.

    Args:
        what: The file or directory.
        found: The version of its format.
        known: The latest version that is understood here.

    Raises:
        UserError: It is newer, or not a version number.
    """
    if not isinstance(found, int) or found < 1:
        raise UserError(f"{what}: format_version is {found!r}, expected a whole number of at least 1")
    if found > known:
        raise UserError(
            f"{what} has format {found}, but this version of dds-lightning ({__version__}) reads up to "
            f"{known}: install a newer one"
        )


def neighbours(path: Path) -> str:
    """Return what is in the folder where `path` was expected, as the end of a message."""
    folder = path.parent
    if not folder.is_dir():
        return f": the folder {folder} does not exist either"
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    return f"; {folder} holds {', '.join(names[:8]) or 'nothing'}{' ...' if names[8:] else ''}"
