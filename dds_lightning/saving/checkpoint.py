"""Training checkpoints one can trust: written whole or not at all, and read without running anything.

The directory that is published afterwards is in `dds_lightning.saving.published`.
"""

from __future__ import annotations

import errno
import os
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from torch import nn

from dds_lightning.errors import UserError
from dds_lightning.saving.files import neighbours, refuse_newer, written_whole
from dds_lightning.saving.published import Published as Published
from dds_lightning.saving.published import build_module, load_published
from dds_lightning.saving.published import publish as publish

FORMAT = 1
FORMAT_KEY = "dds_format"
"""Entry of a `.ckpt` that holds its version; files of before it have none and are of the first."""

STAGE_KEY = "stage"
"""Entry of a `.ckpt` that holds the name of the training stage; older files are known by a setting of theirs."""
_TELLTALES = {"tau": "policy", "horizon": "skill", "action_dim": "clone"}

M = TypeVar("M", bound=nn.Module)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, written beside their place, synced, checked and only then renamed.

    A full disk, a kill or a read-only folder leaves the previous file as it was, and the error is raised.
    Local paths only. The file says which version of the format it has; one that was written on an accelerator loads
    on a CPU.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Save a checkpoint.

        Args:
            checkpoint: what Lightning collected.
            path: where it goes.
            storage_options: not supported.

        Raises:
            TypeError: `storage_options` was given.
            OSError: the file could not be written; the previous one is untouched.
        """
        if storage_options is not None:
            raise TypeError("storage_options are for remote storage; checkpoints are written to local paths")
        with written_whole(Path(path)) as part:
            _write({**checkpoint, FORMAT_KEY: FORMAT}, part)
            try:
                _check_sums(part)
            except zipfile.BadZipFile as error:
                told = f"it reads back differently: {error}; the disk may be full or failing"
                raise OSError(errno.EIO, told) from None

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Load a checkpoint of tensors and plain values on the CPU; `weights_only` is always on.

        Raises:
            UserError: there is no such file, it is damaged, or it holds other objects.
        """
        del map_location, weights_only  # a Trainer moves what it loads to its own device
        return load_ckpt(path)


def load_ckpt(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a `.ckpt` on the CPU, wherever it was written, without running anything that it may contain.

    Raises:
        UserError: there is no such file, it is damaged or of a newer version, or it holds more than tensors and plain
            values.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no checkpoint {path}{neighbours(path)}")
    try:
        _check_sums(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = str(error).split("\n", 1)[0]
        raise UserError(f"{path} is damaged, or holds more than tensors and plain values: {reason}") from None
    except (RuntimeError, EOFError, OSError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} is not a readable checkpoint, cut short perhaps: {error}") from None
    if not isinstance(checkpoint, dict) or not isinstance(checkpoint.get("state_dict"), dict):
        raise UserError(f"{path} is not a Lightning checkpoint: it has no state_dict")
    refuse_newer(path, checkpoint.get(FORMAT_KEY, FORMAT), FORMAT)
    return checkpoint


def stage_of(checkpoint: Mapping[str, Any]) -> str | None:
    """The training stage that wrote a checkpoint; None where nothing says it."""
    settings = checkpoint.get("hyper_parameters") or {}
    older = next((stage for setting, stage in _TELLTALES.items() if setting in settings), None)
    return checkpoint.get(STAGE_KEY) or older


def _write(checkpoint: dict[str, Any], path: Path) -> None:
    """Like `torch.save`, but with the disk's own error where it fails: torch tells only of an unexpected position."""
    try:
        with path.open("wb") as file:
            torch.save(checkpoint, file)
    except RuntimeError as error:
        raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None


def _check_sums(path: Path) -> None:
    """Compare every part with its checksum: torch does not, and a changed byte would load as another weight.

    Raises:
        BadZipFile: a part differs.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
        if broken:
            raise zipfile.BadZipFile(f"'{broken}' was changed since it was written")


def load_module(cls: type[M], path: str | os.PathLike[str], part: str) -> M:
    """A module from a Lightning `.ckpt` or from a published directory, in evaluation mode on the CPU.

    Args:
        cls: `SkillModule` or `PolicyModule`.
        path: file or directory.
        part: the module's name in a published directory.

    Raises:
        UserError: the file is missing, damaged, or of another kind of module.
    """
    path = Path(path)
    if path.is_dir() or not path.suffix:
        return load_published(path).module(cls, part)
    checkpoint = load_ckpt(path)
    settings = dict(checkpoint.get("hyper_parameters") or {})
    return build_module(cls, settings, checkpoint["state_dict"], str(path))
