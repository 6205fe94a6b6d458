"""Whose skills they are: the numbers of observations and actions alone do not tell one robot from another."""

from __future__ import annotations

from pathlib import Path

from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import load_ckpt, trained_for
from dds_lightning.saving.published import load_published
from dds_lightning.tasks import Task, known_task
from dds_lightning.tasks.bodies import body_name


def refuse_other_robot(skill: str, task: Task) -> None:
    """Refuse skills that were trained on another robot of ours; of one that nobody here knows, widths have to do.

    Args:
        skill: `.ckpt` or published directory of a skill model.
        task: Where its skills are to be used.

    Raises:
        UserError: The robots differ.
    """
    path = Path(skill)
    name = load_published(path).config.get("task") if path.is_dir() else trained_for(load_ckpt(path))
    try:
        other = known_task(str(name))
    except UserError:
        return  # nothing says it, or it is a task of somebody's own
    here, there = body_name(task), body_name(other)
    if here != there:
        raise UserError(
            f"data.skill is {skill}, trained on {other.name} ({there}), but data.task is {task.name} ({here}), another "
            "robot: give skills of that robot"
        )
