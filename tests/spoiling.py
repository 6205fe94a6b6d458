"""Ways to spoil an HDF5 file that a test then refuses to read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np

Spoil = Callable[[h5py.File], Any]
LINKS = (h5py.SoftLink, h5py.ExternalLink, h5py.HardLink, np.dtype, h5py.VirtualLayout)


def replace(key: str, value: Any, **options: Any) -> Spoil:
    """Put a link, or an array with options of h5py, in the place of an array."""

    def spoil(file: h5py.File) -> None:
        del file[key]
        if isinstance(value, LINKS):
            file[key] = value
        else:
            file.create_dataset(key, data=value, **options)

    return spoil


def declare(key: str, shape: tuple[int, ...], dtype: Any = "f4", **options: Any) -> Spoil:
    """Declare an array and write nothing into it."""

    def spoil(file: h5py.File) -> None:
        del file[key]
        file.create_dataset(key, shape=shape, dtype=dtype, **options)

    return spoil
