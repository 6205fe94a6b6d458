"""Stores arrays as plain .npy files in a folder, which can be memory-mapped when they do not fit into memory."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_npy
from dds_lightning.saving.files import expand, folder_written_whole, mend_folder, refuse_newer
from dds_lightning.saving.untrusted import mapping, read_json, safe_name

FORMAT = 1


def save_arrays(
    directory: str | Path, arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any], *, overwrite: bool = False
) -> Path:
    """Write `directory` with one .npy file per array and `trajectories.json`, which has `facts` and the format.

    The folder is complete or absent (`dds_lightning.saving.files.folder_written_whole`).

    Raises:
        UserError: When the folder exists and `overwrite` is False.
    """
    folder = Path(directory)
    refuse_existing(folder, overwrite)
    with folder_written_whole(folder) as part:
        for key, array in arrays.items():
            np.save(part / f"{key}.npy", array, allow_pickle=False)
        text = json.dumps({"format": FORMAT, **facts}, indent=1)
        (part / "trajectories.json").write_text(text, encoding="utf-8")
        refuse_existing(folder, overwrite)
    return folder


def read_arrays(
    directory: str | Path, types: Mapping[str, Any], *, mmap: bool = False
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read what `save_arrays` wrote.

    Args:
        directory: The folder.
        types: The arrays to read and their types.
        mmap: Map the arrays instead of reading them: memory is filled as they are used.

    Returns:
        The facts and the arrays.

    Raises:
        DataError: When a file is missing, damaged or of another type.
        UserError: When a newer version of this package wrote them.
    """
    folder = expand(directory)
    with contextlib.suppress(OSError):
        mend_folder(folder)
    try:
        facts = mapping(read_json(folder / "trajectories.json", root=folder), folder / "trajectories.json")
        name, version = safe_name(facts["name"]), facts["format"]
        if not isinstance(facts["fingerprint"], str):
            raise UserError("the fingerprint is no text")
    except (UserError, KeyError) as error:
        raise DataError(f"data: {folder / 'trajectories.json'} is missing or damaged ({error})") from error
    refuse_newer(folder / "trajectories.json", version, FORMAT)
    arrays = {}
    for key, dtype in types.items():
        path = folder / f"{key}.npy"
        try:
            arrays[key] = read_npy(path, mmap=mmap, root=folder)
        except UserError as error:
            raise DataError(f"data set '{name}': {path} is missing, truncated or damaged ({error})") from error
        if arrays[key].dtype != dtype:
            raise DataError(f"data set '{name}', {key}: got type {arrays[key].dtype}, expected {np.dtype(dtype)}")
    return {**facts, "name": name}, arrays


def refuse_existing(folder: Path, overwrite: bool) -> None:
    """Raise UserError when `folder` exists and may not be replaced."""
    mend_folder(folder)
    if folder.exists() and not overwrite:
        raise UserError(f"out: {folder} exists already; choose another folder, or allow it to be overwritten")
