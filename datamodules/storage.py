"""Arrays as plain .npy files in one folder, which can be memory-mapped when they do not fit into memory."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.files import sync

FORMAT = 1


def save_arrays(
    directory: str | Path, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any], *, overwrite: bool = False
) -> Path:
    """Write `directory` with one .npy file an array and `trajectories.json`, which holds `facts` and the format.

    Everything goes into a hidden sibling folder first, so that the folder is whole or absent.

    Raises:
        UserError: When the folder exists and `overwrite` is False.
    """
    folder = Path(directory)
    refuse_existing(folder, overwrite)
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", suffix=".partial", dir=folder.parent))
    try:
        partial.chmod(0o755)
        for key, array in arrays.items():
            path = partial / f"{key}.npy"
            with path.open("wb") as file:
                np.save(file, array, allow_pickle=False)
            sync(path)
        write_durably(partial / "trajectories.json", json.dumps({"format": FORMAT, **facts}, indent=1))
        put_in_place(partial, folder, overwrite)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return folder


def read_arrays(
    directory: str | Path, types: Mapping[str, Any], *, mmap: bool = False
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what `save_arrays` wrote.

    Args:
        directory: The folder.
        types: The arrays to read and their types.
        mmap: Map the arrays instead of reading them: memory is filled as they are used.

    Returns:
        The facts and the arrays.

    Raises:
        DataError: When a file is missing, damaged or of another type.
    """
    folder = Path(directory).expanduser()
    try:
        facts = json.loads((folder / "trajectories.json").read_text(encoding="utf-8"))
        name, version, _ = str(facts["name"]), facts["format"], facts["fingerprint"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"data: {folder / 'trajectories.json'} is missing or damaged ({error!r})") from error
    if version != FORMAT:
        raise DataError(f"data set '{name}': its format is {version}, expected {FORMAT}; write it again")
    arrays = {}
    for key, dtype in types.items():
        path = folder / f"{key}.npy"
        try:
            arrays[key] = np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"data set '{name}': {path} is missing, truncated or damaged ({error})") from error
        if arrays[key].dtype != dtype:
            raise DataError(f"data set '{name}', {key}: found type {arrays[key].dtype}, expected {np.dtype(dtype)}")
    return facts, arrays


def refuse_existing(folder: Path, overwrite: bool) -> None:
    """Raise UserError when `folder` exists and may not be replaced."""
    if folder.exists() and not overwrite:
        raise UserError(f"out: {folder} exists already; choose another place, or ask for it to be overwritten")


def write_durably(path: Path, text: str) -> None:
    """Write a text file and wait until it is on the disk."""
    path.write_text(text, encoding="utf-8")
    sync(path)


def put_in_place(partial: Path, folder: Path, overwrite: bool) -> None:
    """Give a complete folder its name, replacing an old one of that name if allowed."""
    refuse_existing(folder, overwrite)
    old: Path | None = None
    if folder.exists():
        old = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", suffix=".old", dir=folder.parent))
        os.replace(folder, old / "replaced")
    os.replace(partial, folder)
    if old is not None:
        shutil.rmtree(old, ignore_errors=True)
    sync(folder.parent)
