"""Which checkpoint a training goes on from, and what it may not change on its way."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jsonargparse import Namespace
from lightning.pytorch.plugins.environments import SLURMEnvironment

from dds_lightning.errors import UserError
from dds_lightning.finetune import read
from dds_lightning.saving.checkpoint import load_ckpt, stage_of
from dds_lightning.saving.files import expand
from dds_lightning.training.stages import STARTS, Stage

PATHS = (
    *("data.data", "data.skill", "data.relabelled", "data.cache", "checkpoint.dirpath"),
    *("trainer.default_root_dir", "ckpt_path", *(f"model.{name}" for name in STARTS)),
)
"""Settings that may begin with `~`, also in a file."""


def expand_paths(settings: Namespace) -> None:
    """Replace `~` in `PATHS` by the user's home."""
    for name in PATHS:
        value = settings.get(name)
        if isinstance(value, str | Path) and str(value).startswith("~"):
            settings[name] = str(expand(value))


def take_shape(stage: Stage, model: Namespace, typed: Namespace) -> None:
    """Take what shapes the network from the checkpoint that a training starts from; files of settings yield to it.

    Args:
        stage: The training stage.
        model: Settings of the module, `init_from` among them; changed in place.
        typed: Settings on the command line, which do not yield.
    """
    cls = stage.module_class()
    trained = read(cls, model.init_from).hparams
    for name in cls.SHAPE:
        if f"model.{name}" not in typed and name not in stage.links:
            model[name] = trained[name]


def named_checkpoint(path: str, settings: Namespace) -> str:
    """The file that `--ckpt_path` names: `last` and `best` are those of the latest training in this place.

    Raises:
        UserError: There is none.
    """
    if path not in ("last", "best") or Path(path).is_file():
        return path
    folder, root = settings.checkpoint.dirpath, Path(settings.trainer.default_root_dir or ".")
    places = [Path(folder)] if folder else sorted(root.glob("logs/version_*/checkpoints"), key=os.path.getmtime)
    found = [place / f"{path}.ckpt" for place in places if (place / f"{path}.ckpt").is_file()]
    if not found:
        looked = folder or f"{root}/logs/version_*/checkpoints"
        raise UserError(f"--ckpt_path is {path}, but there is no {path}.ckpt in {looked}: give the path of a .ckpt")
    return str(found[-1])


def requeued_checkpoint(settings: Namespace) -> Path | None:
    """What Lightning saved when SLURM put this job back in its queue; None where it did not, or another is named.

    Raises:
        UserError: It is another job's: Lightning would silently go on from it.
    """
    root = Path(settings.trainer.default_root_dir or ".")
    found = sorted(root.glob("hpc_ckpt_*.ckpt"), key=os.path.getmtime)
    if not found or settings.get("ckpt_path") is not None or not SLURMEnvironment.detect():
        return None
    if int(os.environ.get("SLURM_RESTART_COUNT", "0")) == 0:
        raise UserError(
            f"trainer.default_root_dir: {found[-1]} is of an earlier SLURM job, and Lightning would go on from it: "
            f"move it away, choose another folder, or give --ckpt_path={found[-1]} to go on from it"
        )
    return found[-1]


def refuse_conflicts(trained: Mapping[str, Any], chosen: Namespace, path: str | Path) -> None:
    """Refuse settings that were given and differ from those that a checkpoint was trained with.

    Raises:
        UserError: Names the first.
    """
    for name, value in trained.items():
        if name in chosen and chosen[name] != value:
            raise UserError(
                f"--{name} is {chosen[name]!r}, but checkpoint {path} was trained with {value!r}, "
                f"and --ckpt_path continues exactly that training: give --{name}={value}, or train "
                "anew without --ckpt_path"
            )


def load_checkpoint(path: str, stage: str) -> dict[str, Any]:
    """Read a Lightning checkpoint of a stage without running code from it.

    Raises:
        UserError: No such file, unreadable, or another stage's.
    """
    try:
        checkpoint = load_ckpt(path)
    except UserError as error:
        raise UserError(f"--ckpt_path: {error}") from None
    saved = stage_of(checkpoint)
    if saved != stage:
        raise UserError(f"--ckpt_path: {path} is a checkpoint of stage {saved or 'unknown'}, expected {stage}")
    return checkpoint
