"""Places that a user names, checked before anything heavy is imported."""

from pathlib import Path

from dds_lightning.errors import UserError


def refuse_no_folder(agent: str | Path | None) -> None:
    """Refuse an agent's place that does not exist; one on the Hub, ``-`` and None are nobody's folder.

    Raises:
        UserError: There is no such folder.
    """
    if agent is None or str(agent) == "-" or str(agent).startswith("hf:"):
        return
    if not Path(agent).is_dir():
        raise UserError(f"there is no folder {agent}: give a run of `dds run` or a published checkpoint")
