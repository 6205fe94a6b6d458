"""The task of a run directory, which stores the definition of a custom task."""

import contextlib
from pathlib import Path

import yaml

from dds_lightning.errors import UserError
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.tasks import Task, definition, get_task, is_own, known_task, remember
from dds_lightning.tasks.own import OwnCodeError, build_task

TASK_FILE = "task.yaml"


def keep_task(run: Path, task: Task) -> None:
    """Write the definition of a custom task into a run directory; does nothing for a task of the table."""
    if is_own(task):
        with written_whole(run / TASK_FILE) as part:
            part.write_text(yaml.safe_dump(definition(task), sort_keys=False), encoding="utf-8")


def recall_task(run: Path, asked: str | None = None) -> None:
    """Register the custom task of a run directory, so that it is found by name; does nothing if there is none.

    Args:
        run: The run directory.
        asked: What the user gave as its task: the name or the file of one. Only a file that the user names may bring
            code of its own.

    Raises:
        UserError: The file does not define a task, or there is no task `asked`.
    """
    if asked is not None:
        get_task(asked)
    path = run / TASK_FILE
    if not path.is_file():
        return
    kept = read_yaml(path, root=run, verdict="is not valid YAML")
    if not isinstance(kept, dict):
        raise UserError(f"{path} is not a mapping, expected the definition of a task")
    try:
        remember(build_task(kept, str(path), trusted=False))
    except OwnCodeError:
        with contextlib.suppress(UserError):
            known_task(str(kept.get("name")))  # known because the user named its file, in this process
            return
        raise
