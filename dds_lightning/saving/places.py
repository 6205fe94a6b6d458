"""Places that a user names, told apart and checked before anything heavy is imported."""

import os
from pathlib import Path

from dds_lightning.errors import UserError
from dds_lightning.saving.files import neighbours

PREFIX = "hf:"


def is_hub(place: str | Path) -> bool:
    """Whether an address is on the Hub."""
    return str(place).startswith(PREFIX)


def refuse_no_folder(agent: str | Path) -> None:
    """Refuse the folder of an agent that does not exist.

    Raises:
        UserError: There is no such folder.
    """
    if not Path(agent).is_dir():
        raise UserError(f"there is no folder {agent}: give a run of `dds run` or a published checkpoint")


def refuse_unwritable(out: str | None) -> None:
    """Refuse a file that could not be written, before the work whose result it is to hold.

    Raises:
        UserError: It is a folder, or nothing can be written where it is to be.
    """
    if out is None:
        return
    path = Path(out).expanduser().absolute()
    there = next(parent for parent in path.parents if parent.exists())
    if path.is_dir():
        raise UserError(
            f"--out is {out}, a folder: give the name of a file in it, for example {Path(out) / 'table.parquet'}"
        )
    if not there.is_dir() or not os.access(path if path.exists() else there, os.W_OK):
        raise UserError(f"--out is {out}, but nothing can be written in {there}: give another place")


def refuse_no_checkpoint(path: Path, setting: str = "") -> None:
    """Refuse a checkpoint that does not exist.

    Raises:
        UserError: There is no such file; `setting` begins the sentence.
    """
    if not path.exists():
        raise UserError(f"{setting}there is no checkpoint {path}{neighbours(path)}")
