"""`dds evaluate`: play a published agent, or a run's last and best checkpoint, and report the scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from dds_lightning.agent import DDSAgent
from dds_lightning.console.reports import Report, table
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.saving.published import CONFIG, load_published
from dds_lightning.saving.untrusted import conform
from dds_lightning.study.contestants import agent_directory, best_directory, way
from dds_lightning.study.loose import loose_agent, loose_task
from dds_lightning.study.protocol import BEST, LAST, heading, paper_line, protocol
from dds_lightning.tasks import Task


def evaluate(
    directory: Path | None,
    *,
    skill: str | None = None,
    policy: str | None = None,
    task: str | None = None,
    episodes: int | None = None,
    selection: str | Sequence[str] = ("greedy", "sample"),
    temperature: float = 1.0,
    noise_scale: float | None = None,
    hold: int | None = None,
    checkpoint: Literal["last", "best", "both"] = "both",
    seed: int = 0,
    workers: int | None = None,
    out: str | None = None,
) -> Report:
    """Roll out a trained agent; arguments and JSON keys are those of `dds evaluate`.

    If both checkpoints play, the report's `protocol` is that of the last one; a line says how the best one's differs.

    Raises:
        UserError: There is no agent or no such checkpoint, or it does not fit the task or the selection.
    """
    if directory is not None and policy is not None and skill is None:
        raise UserError(f"--policy is {policy} without --skill: give both")
    if (directory is None) == (skill is None and policy is None):
        raise UserError(
            f"the run is {directory} and --skill is {skill}: give a run or a published checkpoint, or the checkpoints "
            "of trainings, --skill SKILL.ckpt --policy POLICY.ckpt"
        )
    loose = directory is None  # raw actions have a policy alone
    places = _places(directory, checkpoint) if directory is not None else {LAST: Path(policy or skill or "")}
    first = next(iter(places.values()))
    wanted = loose_task(task, policy, skill) if loose else loose_task(task, str(first))
    if wanted is None:
        raise UserError(f"{first} does not say which task it is for: give --task; `dds tasks` lists them")
    count = episodes_to_play(wanted, episodes)
    chosen = {"noise_scale": noise_scale, "hold": hold}
    acting: dict[str, Any] = {"seed": seed, **{name: value for name, value in chosen.items() if value is not None}}
    agents = {
        kind: loose_agent(skill, policy, wanted, **acting) if loose else DDSAgent.load(place, **acting)
        for kind, place in places.items()
    }
    for kind, agent in agents.items():
        refuse_other_task(agent, places[kind], wanted)
    best = _best_facts(places[BEST]) if BEST in places else None
    players: list[Contestant] = []
    shown: dict[str, str] = {}
    for kind, agent in agents.items():
        for choice in [selection] if isinstance(selection, str) else dict.fromkeys(selection):
            heat = temperature if choice == "sample" else 1.0
            players.append(way(agent, choice, count, heat, best if kind == BEST else None))
            shown[players[-1].name] = kind
    settings: dict[str, Any] = {"episodes": count, "seed": seed, "temperature": temperature}
    settings |= {"checkpoint": " and ".join(places), "best": best}
    how, *others = [protocol(wanted, agent, **settings) for agent in agents.values()]
    result = rollout(wanted, players, seed=seed, workers=workers)
    summary = result.summary()
    summary.insert(1, "checkpoint", summary["actor"].map(shown))
    data: dict[str, Any] = {"agent": places.get(LAST), "best": places.get(BEST), "task": wanted.name, "seed": seed}
    differing = [f"The best checkpoint's: {heading({**other, 'checkpoint': BEST})}" for other in others if other != how]
    told = [heading(how), *differing]
    return report_episodes(result, summary, wanted, told, {**data, "protocol": how}, out)


def episodes_to_play(task: Task, asked: int | None) -> int:
    """How many episodes an evaluation has: those asked for, else the task's.

    Raises:
        UserError: None at all.
    """
    count = task.evaluation_episodes if asked is None else asked
    if count < 1:
        raise UserError(f"--episodes is {count}, expected at least 1")
    return count


def report_episodes(
    result: RolloutResult,
    summary: pd.DataFrame,
    task: Task,
    told: Sequence[str],
    data: Mapping[str, Any],
    out: str | None,
) -> Report:
    """The report of an evaluation, and its episodes as a file where one was asked for.

    Args:
        result: What was played.
        summary: A row for each player, with its `checkpoint`.
        task: What was played.
        told: Sentences before the table.
        data: What the report holds beside `results`.
        out: Parquet file for the episodes.
    """
    hidden = ["checkpoint", *([] if task.measures_success else ["success", "length_success"])]
    lines: list[Any] = [*told, table(summary.drop(columns=hidden))]
    lines += [line] if (line := paper_line(task)) else []
    report = Report({**data, "results": summary}, lines)
    if out is not None:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        if Path(out).suffix == ".csv":
            result.episodes.to_csv(out, index=False)
        else:
            result.episodes.to_parquet(out, index=False)
        report.data["episodes"] = out
        report.text.append(out)
    return report


def _best_facts(place: Path) -> dict[str, Any]:
    """Return how the best checkpoint was chosen, see `protocol.best_facts`."""
    form = {"monitor": (str,), "value": (int, float), "step": (int,), "evaluations": (int, type(None))}
    return conform(load_published(place).config.get("checkpoint"), form, f"{place / CONFIG}, checkpoint")


def _places(directory: Path, checkpoint: str) -> dict[str, Path]:
    """Return the published directories to play, by checkpoint."""
    last: Path | None = agent_directory(directory)
    best = best_directory(directory)
    if last == directory and isinstance(load_published(directory).config.get("checkpoint"), dict):
        last, best = None, directory  # a run published this as its best
    places = {kind: place for kind, place in ((LAST, last), (BEST, best)) if place is not None}
    if checkpoint == "both":
        return places
    if checkpoint not in places:
        raise UserError(
            f"--checkpoint is {checkpoint}, but {directory} holds only the {' and '.join(places)} one (`dds run "
            "--evaluate_every STEPS` keeps the best beside the last)"
        )
    return {checkpoint: places[checkpoint]}


def refuse_other_task(agent: DDSAgent, path: Path, task: Task) -> None:
    """Refuse an agent whose widths are not the task's.

    Raises:
        UserError: It was trained for another task.
    """
    found, expected = (agent.observation_dim, agent.action_dim), (task.observation_dim, task.action_dim)
    if found != expected:
        raise UserError(
            f"the agent in {path} has (observation_dim, action_dim) {found}, task {task.name} has {expected}: it was "
            "trained for another task"
        )
