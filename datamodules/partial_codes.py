"""The codes of an unfinished relabelling, on disk."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_npz
from dds_lightning.saving.files import written_whole


class PartialCodes:
    """The codes so far, in a hidden file beside the result, so that relabelling continues where it was stopped.

    Args:
        path: File of the result.
        key: What the result is made from (`relabel_key`); codes of anything else are not read.
        seconds: Time between two writes.
    """

    def __init__(self, path: Path, key: dict[str, str | int | float], seconds: float = 30.0) -> None:
        self.path = path.with_name(f".{path.name}.codes")
        self.key = json.dumps(key, sort_keys=True)
        self.seconds = seconds
        self._written = time.monotonic()

    def read(self) -> list[Tensor]:
        """The codes of the first n segments, one tensor (n,); an empty list if no codes of this key are stored."""
        try:
            stored = read_npz(self.path)
            codes = stored["codes"]
            sound = codes.ndim == 1 and codes.dtype == np.int64 and str(stored["key"]) == self.key
            return [torch.from_numpy(codes)] if sound else []
        except (UserError, KeyError):
            return []

    def write(self, codes: list[Tensor]) -> None:
        """Store the codes so far, (n,) each."""
        if codes:
            with written_whole(self.path) as part, part.open("wb") as file:
                np.savez(file, codes=torch.cat(codes).numpy(), key=np.array(self.key))
        self._written = time.monotonic()

    def write_if_due(self, codes: list[Tensor]) -> None:
        """Store them unless they were stored less than `seconds` ago."""
        if time.monotonic() - self._written >= self.seconds:
            self.write(codes)

    def remove(self) -> None:
        """Delete the file once the result exists."""
        self.path.unlink(missing_ok=True)
