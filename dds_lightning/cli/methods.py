"""`dds evaluate --policy CHECKPOINT` with a baseline's checkpoint: the same episodes and table as an agent's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dds_lightning.agent import DDSAgent
from dds_lightning.baselines.methods import METHODS, Method, method_of
from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.saving.checkpoint import load_ckpt, stage_of
from dds_lightning.saving.published import load_published
from dds_lightning.study.evaluate import episodes_to_play, report_episodes
from dds_lightning.study.loose import loose_task
from dds_lightning.study.protocol import LAST, heading, protocol
from dds_lightning.tasks import Task


def baseline_at(path: str | None) -> Method | None:
    """Return the baseline that a checkpoint belongs to; None for our own stages, and for none."""
    if path is None:
        return None
    if Path(path).is_dir():
        config = load_published(path).config
        found = next((one for one in METHODS.values() if one.stages[-1] in config), None)
    else:
        found = method_of(stage_of(load_ckpt(path)))
    return found if found is not None and found.name != "dds" else None


def evaluate_baseline(
    method: Method,
    policy: str,
    skill: str | None,
    task: str | None,
    episodes: int | None,
    seed: int,
    workers: int | None,
    out: str | None,
    **acting: Any,
) -> Report:
    """Play a baseline; arguments and JSON keys are those of `dds evaluate`.

    Args:
        method: Whose checkpoint `policy` is.
        policy: Checkpoint of its last stage.
        skill: Checkpoint of its skills, if it has some.
        task: Name of the task; None takes the one that it was trained for.
        episodes: How many; None takes the task's.
        seed: Of environments and actor.
        workers: Processes for the environments.
        out: Parquet file for the episodes.
        **acting: Settings of agents over skills; None takes the agent's.

    Raises:
        UserError: A checkpoint is missing or does not fit, or a setting does not apply.
    """
    chosen = {name: value for name, value in acting.items() if value is not None}
    if "skill" not in method.stages:
        for name, value in chosen.items():
            raise UserError(f"--{name} is {value}, which {method.title} has no use for: leave it out")
    given = {"skill": skill, method.stages[-1]: policy}
    if skill is not None and "skill" not in method.stages:
        raise UserError(f"--skill is {skill}, but {method.title} has no skills: leave it out")
    wanted = loose_task(task, policy, skill)
    if wanted is None:
        raise UserError(f"{policy} does not say which task it is for: give --task; `dds tasks` lists them")
    count = episodes_to_play(wanted, episodes)
    actor = method.play({name: path for name, path in given.items() if path is not None})
    _refuse_other_task(actor, policy, wanted)
    actor = actor.variant(**chosen, seed=seed) if chosen else actor
    result = rollout(wanted, [Contestant(method.title, actor, count)], seed=seed, workers=workers)
    summary = result.summary()
    summary.insert(1, "checkpoint", LAST)
    agent = actor if isinstance(actor, DDSAgent) else None
    temperature = 1.0 if agent is None else agent.temperature
    facts = {"method": method.name, **protocol(wanted, agent, episodes=count, seed=seed, temperature=temperature)}
    how = (
        f"{facts['task']} ({wanted.env_id}): {count} episodes, seed {seed}"
        if agent is None
        else f"{heading(facts)}, {agent.selection}"
    )
    how += f"; {method.title}, {method.source}"
    data = {"agent": policy, "best": None, "task": wanted.name, "seed": seed, "protocol": facts}
    return report_episodes(result, summary, wanted, [how], data, out)


def _refuse_other_task(actor: Any, path: str, task: Task) -> None:
    found = actor.observation_dim if hasattr(actor, "observation_dim") else actor.module.hparams.observation_dim
    if found != task.observation_dim:
        raise UserError(
            f"{path} has observation_dim {found}, task {task.name} has {task.observation_dim}: it was trained for "
            "another task"
        )
