"""Places that a user names, told apart and checked before anything heavy is imported."""

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


def refuse_no_checkpoint(path: Path, setting: str = "") -> None:
    """Refuse a checkpoint that does not exist.

    Raises:
        UserError: There is no such file; `setting` begins the sentence.
    """
    if not path.exists():
        raise UserError(f"{setting}there is no checkpoint {path}{neighbours(path)}")
