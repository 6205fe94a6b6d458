"""Codes of a relabelling that is under way, on disk."""

from __future__ import annotations

import json
import time
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dds_lightning.saving.files import written_whole


class KeptCodes:
    """Codes found so far, in a hidden file beside the result, so that relabelling goes on where it was stopped.

    Args:
        path: the result's file.
        key: what it is made from (`relabel_key`); codes of anything else are not read.
        seconds: between two writes.
    """

    def __init__(self, path: Path, key: dict[str, str | int | float], seconds: float = 30.0) -> None:
        self.path = path.with_name(f".{path.name}.codes")
        self.key = json.dumps(key, sort_keys=True)
        self.seconds = seconds
        self._written = time.monotonic()

    def read(self) -> list[Tensor]:
        """The codes of the first segments, (n,) in one tensor; none if nothing fitting is there."""
        try:
            with np.load(self.path, allow_pickle=False) as stored:
                return [torch.from_numpy(stored["codes"])] if str(stored["key"]) == self.key else []
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return []

    def write(self, codes: list[Tensor]) -> None:
        """Keep them."""
        if codes:
            with written_whole(self.path) as part, part.open("wb") as file:
                np.savez(file, codes=torch.cat(codes).numpy(), key=np.array(self.key))
        self._written = time.monotonic()

    def write_now_and_then(self, codes: list[Tensor]) -> None:
        """Keep them if some time has passed."""
        if time.monotonic() - self._written >= self.seconds:
            self.write(codes)

    def remove(self) -> None:
        """Forget them: the result is there."""
        self.path.unlink(missing_ok=True)
