"""Trajectories as plain .npy files, which can be memory-mapped when they do not fit into memory."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from datamodules.trajectories import ARRAY_TYPES, Trajectories
from datamodules.validation import DataError
from dds_lightning.errors import UserError

FORMAT = 1


def save_trajectories(trajectories: Trajectories, directory: str | Path, *, overwrite: bool = False) -> Path:
    """Write `directory` with one .npy file an array and `trajectories.json` (name, format, fingerprint).

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
        for key, array in trajectories.arrays().items():
            with (partial / f"{key}.npy").open("wb") as file:
                np.save(file, array, allow_pickle=False)
                file.flush()
                os.fsync(file.fileno())
        facts = {"format": FORMAT, "name": trajectories.name, "fingerprint": trajectories.fingerprint()}
        write_durably(partial / "trajectories.json", json.dumps(facts, indent=1))
        put_in_place(partial, folder, overwrite)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return folder


def read_trajectories(directory: str | Path, *, mmap: bool = False, verify: bool = True) -> Trajectories:
    """Read what `save_trajectories` wrote.

    Args:
        directory: The folder.
        mmap: Map the arrays instead of reading them: memory is filled as they are used.
        verify: Compare with the stored fingerprint, which reads everything once.

    Raises:
        DataError: When a file is missing, damaged or does not match.
    """
    folder = Path(directory).expanduser()
    try:
        facts = json.loads((folder / "trajectories.json").read_text(encoding="utf-8"))
        name, version, fingerprint = str(facts["name"]), facts["format"], facts["fingerprint"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"data: {folder / 'trajectories.json'} is missing or damaged ({error!r})") from error
    if version != FORMAT:
        raise DataError(f"data set '{name}': its format is {version}, expected {FORMAT}; write it again")
    arrays = {}
    for key, dtype in ARRAY_TYPES.items():
        path = folder / f"{key}.npy"
        try:
            arrays[key] = np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise DataError(f"data set '{name}': {path} is missing, truncated or damaged ({error})") from error
        if arrays[key].dtype != dtype:
            raise DataError(f"data set '{name}', {key}: found type {arrays[key].dtype}, expected {np.dtype(dtype)}")
    steps, episodes = len(arrays["rewards"]), len(arrays["lengths"])
    rows = {"actions": steps, "terminations": steps, "truncations": steps, "observations": steps + episodes}
    for key, expected in rows.items():
        if len(arrays[key]) != expected:
            raise DataError(f"data set '{name}', {key}: found {len(arrays[key])} rows, expected {expected}")
    if arrays["lengths"].sum() != steps:
        raise DataError(f"data set '{name}', lengths: they add up to {arrays['lengths'].sum()}, expected {steps}")
    trajectories = Trajectories(name=name, **arrays)
    if verify and trajectories.fingerprint() != fingerprint:
        raise DataError(f"data set '{name}': the arrays in {folder} do not match their fingerprint; they were changed")
    return trajectories


def refuse_existing(folder: Path, overwrite: bool) -> None:
    """Raise UserError when `folder` exists and may not be replaced."""
    if folder.exists() and not overwrite:
        raise UserError(f"out: {folder} exists already; choose another place, or ask for it to be overwritten")


def write_durably(path: Path, text: str) -> None:
    """Write a text file and wait until it is on the disk."""
    with path.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


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
    if os.name == "posix":
        handle = os.open(folder.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
