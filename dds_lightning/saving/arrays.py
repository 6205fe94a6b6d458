"""Opens files of arrays that a stranger may have made: safetensors, .npy, .npz, Parquet and HDF5.

A header of a few bytes can declare arrays of any size, so each is compared with what its file holds before memory is
asked for. See `dds_lightning.saving.untrusted` for what is refused, and how.
"""

from __future__ import annotations

import json
import math
import struct
import zipfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import REMEDY, TEXT, check_columns, check_plain, parsing, regular_file

if TYPE_CHECKING:
    import h5py
    import pandas as pd

LARGEST = 512 * TEXT
"""Bytes that the arrays of one file may have once they are unpacked, where a reader sets no other limit."""
HEADER = TEXT
"""Bytes of a safetensors header: enough for ten thousand tensors."""
TENSORS = 4096
"""Tensors in a file. The paper's agent has about two hundred."""
ROWS = 2_000_000
"""Rows of a table, and values of a column whose rows are lists."""


def read_tensors(
    path: str | Path,
    framework: Literal["pt", "numpy"] = "pt",
    largest: int | None = None,
    root: str | Path | None = None,
    remedy: str = REMEDY,
) -> tuple[dict[str, Any], dict[str, str]]:
    """Read a safetensors file.

    Args:
        path: The file.
        framework: Whether to return tensors of torch or arrays of NumPy.
        largest: Bytes that it may have.
        root: The folder that it must lie in.
        remedy: What to do about a damaged file.

    Returns:
        Name -> tensor, and the metadata of the header.

    Raises:
        UserError: It is refused by `regular_file`, damaged, or has a header of unbearable size.
    """
    from safetensors import safe_open

    size = regular_file(path, largest, root)
    with parsing(path, remedy):
        with open(path, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > min(HEADER, size):
                raise UserError(f"{path} is damaged: it declares a header of {length:,} bytes in a file of {size:,}")
            header = check_plain(json.loads(file.read(length)), path)
        if not isinstance(header, dict) or len(header) > TENSORS:
            raise UserError(f"{path} declares {len(header):,} tensors, expected at most {TENSORS:,}")
        with safe_open(path, framework=framework) as opened:
            metadata = opened.metadata() or {}
            return {name: opened.get_tensor(name) for name in opened.keys()}, metadata  # noqa: SIM118 - not a dict


def read_npy(path: str | Path | BytesIO, *, mmap: bool = False, root: str | Path | None = None) -> NDArray[Any]:
    """Read or map one array, of a file or in memory.

    Raises:
        UserError: It is refused by `regular_file`, damaged, or holds objects.
    """
    with parsing(str(path)):
        if isinstance(path, BytesIO):
            _declared(path, path.getbuffer().nbytes, "the array")
            path.seek(0)
            return np.load(path, allow_pickle=False)
        size = regular_file(path, None, root)
        with open(path, "rb") as file:
            _declared(file, size, path)
        return np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False)


def read_npz(
    path: str | Path | BytesIO, largest: int = LARGEST, root: str | Path | None = None, remedy: str = REMEDY
) -> dict[str, NDArray[Any]]:
    """Read every array of an archive, a file or one in memory.

    Raises:
        UserError: It is refused by `regular_file`, damaged, holds objects, or unpacks to more than `largest` bytes.
    """
    if isinstance(path, (str, Path)):
        regular_file(path, largest, root)
    with parsing(str(path), remedy):
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if len(members) > TENSORS or sum(member.file_size for member in members) > largest:
                raise UserError(f"{path} unpacks to more than {TENSORS:,} arrays or {largest:,} bytes")
            for member in members:
                with archive.open(member) as file:
                    _declared(file, member.file_size, path)
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}


def _declared(file: Any, size: int, path: object) -> None:
    """Refuse an array that declares more than its file holds, or other values than numbers, flags and texts."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if dtype.kind not in "biufU" or dtype.hasobject:
        raise UserError(f"{path} holds values of type {dtype}, expected numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > size:  # older NumPy reads -1 as "all there is"
        raise UserError(f"{path} declares an array of shape {shape}, more than its {size:,} bytes hold")


def read_parquet(
    path: str | Path, columns: Mapping[str, str], remedy: str = REMEDY, root: str | Path | None = None
) -> pd.DataFrame:
    """Read a table.

    Args:
        path: The file.
        columns: Column that must be there -> kinds of NumPy that it may have ("O": texts or lists); others are left
            out.
        remedy: What to do about a damaged file.
        root: The folder that it must lie in.

    Returns:
        The table, with the attributes that pandas stored.

    Raises:
        UserError: It is refused by `regular_file`, damaged, too large, or lacks a column.
    """
    import pandas as pd
    import pyarrow.parquet

    regular_file(path, LARGEST, root)
    with parsing(path, remedy):
        with pyarrow.parquet.ParquetFile(path, thrift_string_size_limit=TEXT) as file:
            about = file.metadata
            groups = [about.row_group(i) for i in range(about.num_row_groups)]
            values = max((group.column(j).num_values for group in groups for j in range(group.num_columns)), default=0)
            unpacked = sum(group.total_byte_size for group in groups)
            if about.num_rows > ROWS or values > ROWS or unpacked > LARGEST or len(groups) > 1000:
                raise UserError(f"{path} declares {about.num_rows:,} rows, expected at most {ROWS:,} values a column")
            if missing := [name for name in columns if name not in file.schema_arrow.names]:
                raise UserError(f"{path} has no column '{missing[0]}': {remedy}")
        table = pd.read_parquet(path, columns=list(columns))
        check_columns(table, columns, path, remedy)
    return table


def open_h5(path: str | Path, root: str | Path | None = None) -> h5py.File:
    """Open an HDF5 file for reading; `datamodules.sources.hdf5` says what may be read from it.

    Args:
        path: The file.
        root: The folder that it must lie in; None accepts any place.

    Raises:
        UserError: It is refused by `regular_file`.
        OSError: HDF5 cannot open it.
    """
    import h5py

    regular_file(path, None, root)
    return h5py.File(path, "r")


def create_h5(path: str | Path) -> h5py.File:
    """Create an HDF5 file that every version of the library since 1.10 reads, in place of what was there."""
    import h5py

    return h5py.File(path, "w", libver="v110")


def check_archive(file: Path, size: int) -> None:
    """Refuse an archive whose parts unpack to more than it holds: what is written without packing cannot.

    Raises:
        BadZipFile: It does, or a part differs from its checksum.
    """
    with zipfile.ZipFile(file) as archive:
        if sum(member.file_size for member in archive.infolist()) > size:
            raise zipfile.BadZipFile("its parts unpack to more than the file holds")
        if broken := archive.testzip():
            raise zipfile.BadZipFile(f"'{broken}' was changed since it was written")
