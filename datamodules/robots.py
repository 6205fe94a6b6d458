"""Whose skills they are: the numbers of observations and actions alone do not tell one robot from another."""

from __future__ import annotations

from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import load_trained
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import Task, known_task
from dds_lightning.tasks.bodies import body_name


def load_skills(skill: str, task: Task | None) -> SkillModule:
    """Load a skill model for a task.

    Args:
        skill: `.ckpt` or published directory.
        task: Where its skills are to be used; None for anywhere.

    Raises:
        UserError: The file cannot be read, or the skills were trained on another robot of ours; of one that nobody here
            knows, widths have to do.
    """
    module, name = load_trained(SkillModule, skill, SkillModule.STAGE)
    try:
        other = None if task is None or name is None else known_task(name)
    except UserError:
        other = None  # a task of somebody's own
    if task is None or other is None:
        return module
    here, there = body_name(task), body_name(other)
    if here != there:
        raise UserError(
            f"data.skill is {skill}, trained on {other.name} ({there}), but data.task is {task.name} ({here}), another "
            "robot: give skills of that robot"
        )
    return module
