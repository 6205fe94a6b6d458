"""Reads arrays of numbers from HDF5 files of strangers.

HDF5 can point at other files on the reader's machine, load filters as plug-ins (which is foreign code), store
Python objects, and declare arrays of any size in a few bytes. h5py and Minari allow all of that. A file of trajectories
needs none of it, so this module reads only plain numbers that the file itself holds, at the size they have in it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import open_h5
from dds_lightning.saving.files import neighbours

FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32", 5: "n-bit", 6: "scale-offset", 32000: "lzf"}
"""Filters that need no plug-in."""

SMALL = 64 * 2**20
"""Bytes that any array may have, however well it is compressed: a million zeros are legitimate data."""

MAX_RATIO = 50
"""Greatest compression of a larger array. Measurements shrink to a tenth at best."""

SLICE = 8 * 2**20
"""Bytes read at a time."""

_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError)
"""What HDF5's library raises over damaged files."""


@contextlib.contextmanager
def open_hdf5(path: Path, where: str, root: Path | None = None) -> Iterator[h5py.File]:
    """Open a file for reading; what HDF5 raises inside the block becomes a DataError that names it.

    Args:
        path: The file.
        where: The data set, as messages begin.
        root: The folder that it must lie in, links followed; None accepts any place.

    Raises:
        DataError: When the file is missing, damaged, not HDF5, or a link out of `root`.
    """
    if not path.is_file():
        raise DataError(f"{where}: {path} is {'a folder' if path.is_dir() else 'missing'}{neighbours(path)}")
    try:
        file = open_h5(path, root)
    except UserError as error:
        raise DataError(f"{where}: {error}") from error
    except _DAMAGE as error:
        kind = "" if h5py.is_hdf5(path) else ", or not an HDF5 file at all"
        raise DataError(f"{where}: {path} is truncated or damaged{kind} ({error})") from error
    with file:
        try:
            yield file
        except DataError:
            raise
        except (OSError, RuntimeError, KeyError) as error:
            raise DataError(f"{where}: {path} is truncated or damaged ({error})") from error


def member(group: h5py.Group, key: str, where: str) -> Any:
    """A member that is stored in this file itself: links may point at any file on the reader's machine.

    Raises:
        DataError: When it is a link, stored elsewhere or damaged.
    """
    try:
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            raise DataError(f"{where}: '{key}' is a link to elsewhere, expected the data themselves")
        node = group[key]
        if isinstance(node, h5py.Dataset) and (node.external or node.is_virtual):
            raise DataError(f"{where}: '{key}' is stored in another file, expected the data themselves")
    except DataError:
        raise
    except _DAMAGE as error:
        raise DataError(f"{where}, {key}: {group.file.filename} is damaged there ({error})") from error
    return node


def group_in(group: h5py.Group, key: str, where: str) -> h5py.Group:
    """A member that must be a group.

    Raises:
        DataError: When it is an array, a link, stored elsewhere or damaged.
    """
    node = member(group, key, where)
    if not isinstance(node, h5py.Group):
        raise DataError(f"{where}, {key}: got an array, expected a group")
    return node


def array_in(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """A member that must be an array of numbers, see `check_array`.

    Raises:
        DataError: When it is missing, a link, stored elsewhere, or refused by `check_array`.
    """
    found = list(map(str, group))  # h5py gives bytes for a name that is no text
    if key not in found:
        raise DataError(f"{where}: '{key}' is missing; found {', '.join(found[:8]) or 'nothing'}")
    return check_array(member(group, key, where), f"{where}, {key}")


def check_array(node: Any, where: str) -> h5py.Dataset:
    """Refuse anything but a plain array of numbers that fits into its file. Reads no data.

    Args:
        node: From `member`.
        where: Data set and field, as messages begin.

    Raises:
        DataError: For a group, an empty or scalar array, values other than numbers and flags, filters that
            need plug-ins, and arrays whose declared size the file does not hold.
    """
    if not isinstance(node, h5py.Dataset):
        raise DataError(f"{where}: got a group, expected an array")
    try:
        _check_type(node, where)
        _check_filters(node, where)
        _check_size(node, where)
    except DataError:
        raise
    except _DAMAGE as error:
        raise DataError(f"{where}: {node.file.filename} is damaged there ({error})") from error
    return node


def _check_type(dataset: h5py.Dataset, where: str) -> None:
    if not dataset.shape:
        raise DataError(f"{where}: got {'nothing' if dataset.shape is None else 'one value'}, expected an array")
    try:
        kind = dataset.dtype
    except (TypeError, ValueError) as error:
        raise DataError(f"{where}: got values of a type unknown to NumPy, expected real numbers") from error
    if kind.kind not in "biuf" or kind.subdtype is not None:
        raise DataError(f"{where}: got values of type {kind}, expected real numbers")


def _check_filters(dataset: h5py.Dataset, where: str) -> None:
    layout = dataset.id.get_create_plist()
    for index in range(layout.get_nfilters()):
        number, *_ = layout.get_filter(index)
        if number not in FILTERS:
            raise DataError(
                f"{where}: it is stored with filter {number}, which needs a plug-in, and plug-ins are foreign code; "
                f"expected {', '.join(FILTERS.values())} or none"
            )


def _check_size(dataset: h5py.Dataset, where: str) -> None:
    """Compare the declared with the stored size: HDF5 fills in zeros for what is not stored."""
    shape, item = dataset.shape, dataset.id.get_type().get_size()
    declared = math.prod(shape) * item
    stored, whole = dataset.id.get_storage_size(), Path(dataset.file.filename).stat().st_size
    if declared == 0:
        return
    claim = f"{where}: it declares shape {shape}, {_size(declared)},"
    if stored > whole:
        raise DataError(f"{claim} and {_size(stored)} of storage, but its file has only {_size(whole)}")
    if dataset.chunks is None:
        if stored < declared:
            raise DataError(f"{claim} but its file holds {_size(stored)} of it")
        return
    expected = math.prod(-(-length // chunk) for length, chunk in zip(shape, dataset.chunks, strict=True))
    limit = max(SMALL, MAX_RATIO * stored)
    if max(declared, expected * math.prod(dataset.chunks) * item) > limit:
        raise DataError(
            f"{claim} but its file holds {_size(stored)} of it; more than {MAX_RATIO} times smaller than the "
            "numbers themselves is not plausible"
        )
    found = dataset.id.get_num_chunks()
    if found != expected:
        raise DataError(f"{claim} in {expected} blocks, but its file holds {found} of them")


def _size(count: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"


def read_array(node: Any, where: str) -> NDArray[Any]:
    """A complete array, after `check_array`.

    Raises:
        DataError: See `check_array`.
    """
    dataset = check_array(node, where)
    return read_rows(dataset, where, 0, len(dataset))


def read_rows(dataset: h5py.Dataset, where: str, start: int, stop: int, columns: int | None = None) -> NDArray[Any]:
    """Rows `start` to `stop` of a dataset that `check_array` has passed, of a matrix only the first `columns`.

    Raises:
        DataError: When the file is damaged there.
    """
    try:
        return np.asarray(dataset[start:stop] if columns is None else dataset[start:stop, :columns])
    except _DAMAGE as error:
        raise DataError(f"{where}: {dataset.file.filename} is damaged there ({error})") from error


def row_slices(dataset: h5py.Dataset) -> Iterator[tuple[int, int]]:
    """Ranges of rows of about `SLICE` bytes, in complete blocks of the file, so that each is unpacked once."""
    rows, row_bytes = len(dataset), max(1, dataset.dtype.itemsize * math.prod(dataset.shape[1:]))
    block = dataset.chunks[0] if dataset.chunks else 1
    count = max(1, SLICE // (row_bytes * block)) * block
    for start in range(0, rows, count):
        yield start, min(start + count, rows)
