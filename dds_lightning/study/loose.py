"""Agents from the checkpoints of trainings, which nothing has published yet, and the task of these."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dds_lightning.agent import DDSAgent
from dds_lightning.configs import families, run_defaults
from dds_lightning.errors import UserError
from dds_lightning.online.parts import checkpoint_parts
from dds_lightning.saving.checkpoint import load_ckpt, stage_of, trained_for
from dds_lightning.saving.published import load_published
from dds_lightning.tasks import Task, get_task, known_task, restore_task
from dds_lightning.tasks.own import is_address


def loose_agent(skill: str | None, policy: str | None = None, task: Task | None = None, **acting: Any) -> DDSAgent:
    """Put a skill checkpoint and a policy checkpoint together.

    Args:
        skill: A `.ckpt` or a published directory; None for raw actions.
        policy: Likewise, offline or online; None for an agent that chooses its skills at random.
        task: What it plays; where `acting` does not say it, the decoder's noise is that of the task's preset, as in
            `dds run`.
        **acting: Settings of the agent.

    Raises:
        UserError: A file cannot be read, or the two do not belong together.
    """
    if task is not None and skill is not None and acting.get("noise_scale") is None and task.family in families():
        acting["noise_scale"] = run_defaults(task.family)["noise_scale"]
    return DDSAgent(*checkpoint_parts(skill, policy), "random" if policy is None else "sample", **acting)


def loose_task(asked: str | None, *checkpoints: str | None) -> Task | None:
    """Return the task that was asked for, else the one that the first checkpoint that knows was trained for.

    Raises:
        UserError: There is no such task, or a checkpoint names a file: it does not decide what is opened.
    """
    if asked is not None:
        return get_task(asked)
    for path in map(Path, filter(None, checkpoints)):
        if path.is_dir():
            task = restore_task(load_published(path).config, path)
        else:
            name = trained_for(load_ckpt(path))
            if name and is_address(name.partition("?")[0]):
                raise UserError(f"{path} was trained for task {name}: give --task={name}")
            task = known_task(name) if name else None
        if task is not None:
            return task
    return None


def advice(folder: Path) -> str:
    """Say how to use the last checkpoint in a training's folder; "" where there is none."""
    path = folder / "last.ckpt"
    if not path.is_file():
        return ""
    words = f"--skill {path}" if stage_of(load_ckpt(path)) == "skill" else f"--skill SKILL.ckpt --policy {path}"
    return f"; its checkpoint plays with `dds evaluate {words}` and is published with `dds publish - PLACE {words}`"
