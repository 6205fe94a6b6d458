"""Training checkpoints one can trust: written whole or not at all, and read without running anything.

The directory that is published afterwards is in `dds_lightning.saving.published`.
"""

from __future__ import annotations

import errno
import os
import pickle
import pickletools
import re
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from torch import nn

from dds_lightning.errors import UserError, reason
from dds_lightning.saving.arrays import check_archive
from dds_lightning.saving.build import build_module
from dds_lightning.saving.files import refuse_newer, written_whole
from dds_lightning.saving.places import refuse_no_checkpoint
from dds_lightning.saving.published import Published as Published
from dds_lightning.saving.published import load_published
from dds_lightning.saving.published import publish as publish
from dds_lightning.saving.untrusted import check_plain, regular_file

FORMAT = 1
FORMAT_KEY = "dds_format"
"""Entry of a `.ckpt` that holds its version; files of before it have none and are of the first."""

SPAWNED = ".temp.ckpt"
"""Name under which the processes of `ddp_spawn` hand bare weights to the one that started them."""

STAGE_KEY = "stage"
"""Entry of a `.ckpt` that holds the name of the training stage; older files are known by a setting of theirs."""
_TELLTALES = {"tau": "policy", "horizon": "skill", "action_dim": "clone"}

SETTINGS_KEY = "settings"
"""Entry of a `.ckpt` that holds the settings of data and seed: dotted name -> plain value."""

_ENTRIES: dict[str, type] = {
    **dict.fromkeys(("hyper_parameters", "callbacks", "loops", "settings"), dict),
    **dict.fromkeys(("optimizer_states", "lr_schedulers", "rng"), list),
    **dict.fromkeys(("global_step", "epoch"), int),
    STAGE_KEY: str,
}
"""What Lightning and this project keep in a checkpoint, and as what."""
_BUILT = re.compile(
    r"collections OrderedDict|(builtins|__builtin__) (set|complex)|torch (Size|device|\w+Storage|[a-z]\w*)"
    r"|torch\._utils _rebuild_(tensor_v2|parameter)|torch\.serialization _get_layout"
)
"""What a checkpoint may name: containers, and dense tensors of what the file itself holds."""
VALUES = 2_000_000
"""Values in a checkpoint, tensors not counted by their numbers."""

M = TypeVar("M", bound=nn.Module)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoint files, written beside their place, synced, checked and only then renamed.

    A full disk, a kill or a read-only folder leaves the previous file as it was, and the error is raised.
    Local paths only. The file says which version of the format it has; one that was written on an accelerator loads
    on a CPU. Only what this process has written is ever deleted.
    """

    def __init__(self) -> None:
        super().__init__()
        self._written: set[Path] = set()

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
        self._written.add(Path(path).resolve())
        with written_whole(Path(path)) as part:
            _write({**checkpoint, FORMAT_KEY: FORMAT}, part)
            try:
                check_archive(part, part.stat().st_size)
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
        if _is_spawned(Path(path)):
            weights: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
            return weights
        return load_ckpt(path)

    def remove_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Delete a checkpoint that this process has written; anything else stays.

        A `ModelCheckpoint` that goes on takes the paths to delete from the checkpoint's state, where anybody may have
        put them. Lightning would delete folders too.
        """
        place = Path(path)
        written = place.resolve() in self._written or _is_spawned(place)
        if written and place.is_file() and not place.is_symlink():
            place.unlink()
            self._written.discard(place.resolve())


def _is_spawned(path: Path) -> bool:
    """Whether a file holds the bare weights that a process of `ddp_spawn` has left for this one."""
    return path.name == SPAWNED and path.parent.parent == Path(tempfile.gettempdir())


def load_ckpt(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a `.ckpt` on the CPU, wherever it was written, without running anything that it may contain.

    Raises:
        UserError: there is no such file, it is damaged or of a newer version, or it holds more than tensors and plain
            values.
    """
    path = Path(path)
    refuse_no_checkpoint(path)
    size = regular_file(path)
    try:
        _check_parts(path, size)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise UserError(f"{path} is damaged, or holds more than tensors and plain values: {reason(error)}") from None
    except UserError:
        raise
    except Exception as error:  # torch and zipfile raise anything over damaged files
        told = f"{reason(error)[:200]} ({type(error).__name__})"
        raise UserError(f"{path} is not a readable checkpoint, cut short perhaps: {told}") from None
    if not isinstance(checkpoint, dict) or not isinstance(checkpoint.get("state_dict"), dict):
        raise UserError(f"{path} is not a Lightning checkpoint: it has no state_dict")
    refuse_newer(path, checkpoint.get(FORMAT_KEY, FORMAT), FORMAT)
    check_plain(checkpoint, path, VALUES)
    for name, kind in _ENTRIES.items():
        if (value := checkpoint.get(name)) is not None and not isinstance(value, kind):
            raise UserError(f"{path}: '{name}' is a {type(value).__name__}: the file is damaged, take another one")
    for name, value in checkpoint["state_dict"].items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise UserError(f"{path}: '{name}' in state_dict is a {type(value).__name__}, expected a tensor")
    if (declared := sum(tensor.numel() * tensor.itemsize for tensor in _tensors(checkpoint))) > 4 * size + 2**20:
        raise UserError(f"{path} declares {declared:,} bytes of tensors, but has only {size:,}")
    return checkpoint


def _check_parts(path: Path, size: int) -> None:
    """Refuse an archive that is damaged, that unpacks to more than it holds, or that names unusual parts to build.

    torch compares no checksums, so a changed byte would load as another weight. And what its own list of harmless
    callables can build includes any amount of memory.

    Raises:
        BadZipFile: It is no archive, or damaged.
        UnpicklingError: It asks for something that no checkpoint of ours holds.
    """
    check_archive(path, size)
    with zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            if member.endswith("data.pkl"):
                for operation, argument, _ in pickletools.genops(archive.read(member)):
                    if operation.name == "GLOBAL" and not _BUILT.fullmatch(str(argument)):
                        raise pickle.UnpicklingError(f"it asks for {str(argument)[:80]}")


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (dict, list, tuple)):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _tensors(inner)


def stage_of(checkpoint: Mapping[str, Any]) -> str | None:
    """The training stage that wrote a checkpoint; None where nothing says it."""
    settings = checkpoint.get("hyper_parameters") or {}
    older = next((stage for setting, stage in _TELLTALES.items() if setting in settings), None)
    return checkpoint.get(STAGE_KEY) or older


def trained_for(checkpoint: Mapping[str, Any]) -> str | None:
    """The name of the task that a checkpoint was trained for; None where nothing says it."""
    for entry, name in ((SETTINGS_KEY, "data.task"), ("datamodule_hyper_parameters", "task")):
        settings = checkpoint.get(entry)
        if isinstance(settings, Mapping) and isinstance(settings.get(name), str):
            return str(settings[name])
    return None


def _write(checkpoint: dict[str, Any], path: Path) -> None:
    """Like `torch.save`, but with the disk's own error where it fails: torch tells only of an unexpected position."""
    try:
        with path.open("wb") as file:
            torch.save(checkpoint, file)
    except RuntimeError as error:
        raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None


def load_module(cls: type[M], path: str | os.PathLike[str], part: str) -> M:
    """A module from a Lightning `.ckpt` or from a published directory, in evaluation mode on the CPU.

    Args:
        cls: `SkillModule` or `PolicyModule`.
        path: file or directory.
        part: the module's name in a published directory.

    Raises:
        UserError: the file is missing, damaged, or of another kind of module.
    """
    return load_trained(cls, path, part)[0]


def load_trained(cls: type[M], path: str | os.PathLike[str], part: str) -> tuple[M, str | None]:
    """As `load_module`, with the name of the task that it was trained for; None where nothing says it."""
    path = Path(path)
    if path.is_dir() or not path.suffix:
        published = load_published(path)
        task = published.config.get("task")
        return published.module(cls, part), task if isinstance(task, str) else None
    checkpoint = load_ckpt(path)
    if (saved := stage_of(checkpoint)) not in (None, part):
        raise UserError(f"{path} is a checkpoint of stage {saved}, expected {part}")
    settings = dict(checkpoint.get("hyper_parameters") or {})
    return build_module(cls, settings, checkpoint["state_dict"], str(path)), trained_for(checkpoint)
