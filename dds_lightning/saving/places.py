"""Places that a user names, told apart and checked before anything heavy is imported."""

from pathlib import Path

from dds_lightning.errors import UserError

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
