"""How an agent was evaluated, in one line for people and as numbers for programs, and which checkpoint it was."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dds_lightning.errors import UserError
from dds_lightning.rollout.schedule import episode_seed
from dds_lightning.tasks import Task
from dds_lightning.tasks.facts import PAPERS_DATA

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent

LAST, BEST = "last", "best"


def protocol(
    task: Task,
    agent: DDSAgent | None,
    *,
    episodes: int,
    seed: int,
    temperature: float = 1.0,
    checkpoint: str = LAST,
    best: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return everything that a score depends on besides the weights.

    Args:
        task: The task, in its variant.
        agent: The agent that plays; None for an actor without skills.
        episodes: Episodes of each contestant.
        seed: Seed of environments and agents.
        temperature: Temperature of sampled codes.
        checkpoint: "last", "best" or "last and best".
        best: Facts of the best checkpoint, see `best_facts`, if it plays too.

    Returns:
        Plain values: `task` (with its variant), `environment`, `episodes`, `seed`, `checkpoint`, `noise_scale`
        (factor on the decoder's noise), `sampler` (of the decoder; None for one without noise), `temperature`,
        `horizon` (steps for which a skill is held), `max_episode_steps`, `score_min` and `score_max` (returns that
        score 0 and 100), `paper_score` (None if the paper has none), `best` (None without one). What only skills have
        is None without an agent.
    """
    settings = {} if agent is None else agent.skill.hparams
    return {
        "task": full_name(task),
        "environment": task.env_id,
        "episodes": episodes,
        "seed": seed,
        "checkpoint": checkpoint,
        "noise_scale": None if agent is None else agent.noise_scale,
        "sampler": settings["sampler"] if settings.get("decoder") == "diffusion" else None,
        "temperature": None if agent is None else temperature,
        "horizon": None if agent is None else agent.hold,
        "max_episode_steps": task.max_episode_steps,
        "score_min": task.score_min,
        "score_max": task.score_max,
        "paper_score": task.paper_score,
        "best": dict(best) if best else None,
    }


def full_name(task: Task) -> str:
    """Return a task's name with its variant, as accepted by `get_task`."""
    return f"{task.base_name}@{task.physics}" if task.physics else task.name


def heading(facts: Mapping[str, Any]) -> str:
    """Return the protocol of an agent as the line above its table."""
    decoder = "decoder without noise"
    if facts["sampler"] is not None:
        decoder = f"decoder noise {facts['noise_scale']:g} ({facts['sampler']})"
    return (
        f"{facts['task']} ({facts['environment']}): {facts['episodes']} episodes each, seed {facts['seed']}, "
        f"{facts['checkpoint']} checkpoint, {decoder}, temperature {facts['temperature']:g}, a skill every "
        f"{facts['horizon']} steps"
    )


def paper_line(task: Task) -> str | None:
    """Return what the paper reports for a task and why it may not be comparable; None if it reports nothing."""
    return None if task.paper_score is None else f"The paper reports {task.paper_score:.1f}, {PAPERS_DATA}."


def best_facts(last: Path, best: Path) -> dict[str, Any]:
    """Return how a training chose its best checkpoint, read from its two files.

    Args:
        last: The training's last checkpoint, which has the history of all evaluations.
        best: The best checkpoint that was kept.

    Returns:
        `monitor` (name of the metric), `value`, `step` and `evaluations`, how many of them the best was chosen from
        (None for a metric that no rollout measured).

    Raises:
        UserError: A file cannot be read, or `best` was not written by a `BestCheckpoint`.
    """
    from dds_lightning.callbacks.best import BestCheckpoint, callback_state
    from dds_lightning.callbacks.rollouts import RolloutEvaluation
    from dds_lightning.saving.checkpoint import load_ckpt
    from dds_lightning.saving.untrusted import parsing, safe_name

    checkpoint = load_ckpt(best)
    kept = callback_state(checkpoint, BestCheckpoint)
    if kept is None:
        raise UserError(f"{best} was not kept as a best checkpoint: it has no state of a BestCheckpoint")
    with parsing(best, "delete it, and train on"):
        evaluated = callback_state(load_ckpt(last), RolloutEvaluation) or {"history": []}
        count = sum(kept["monitor"] in row for row in evaluated["history"])
        return {
            "monitor": safe_name(kept["monitor"]),
            "value": float(kept["best_model_score"]),
            "step": int(checkpoint["global_step"]),
            "evaluations": count or None,
        }


def trained(fitted: Mapping[str, Any], takes_best: bool) -> dict[str, Any]:
    """Return what `dds STAGE fit` left, as the facts that a finished step or node of a study keeps.

    Args:
        fitted: Its report.
        takes_best: Whether what follows goes on with the best checkpoint, where one was kept, in place of the last.

    Returns:
        `checkpoint`, `steps` and `metrics`; where a best was kept, how it was `chosen`, see `best_facts`; and `best`
        itself, unless it takes the last one's place.
    """
    made: dict[str, Any] = {name: Path(fitted[name]) for name in ("checkpoint", "best") if fitted[name]}
    if "best" in made:
        made["chosen"] = best_facts(made["checkpoint"], made["best"])
        if takes_best:
            made["checkpoint"] = made.pop("best")
    metrics = {name: round(value, 6) for name, value in fitted["metrics"].items()}
    return {**made, "steps": fitted["steps"], "metrics": metrics}


def start_value(task: Task, agent: DDSAgent, seed: int, episodes: int = 10) -> dict[str, float] | None:
    """Return the critic's value at the starts of episodes, in discounted learning rewards.

    Returns:
        `mean` of V over the starts of some evaluation episodes, and `low` and `high`, its bounds given the rewards and
        discounts of the data; None for an agent without a policy.
    """
    import torch

    if agent.policy is None:
        return None
    env = task.make_env()
    try:
        starts = np.stack([env.reset(seed=episode_seed(seed, i))[0] for i in range(episodes)])
    finally:
        env.close()
    with torch.inference_mode():
        values = agent.policy.v(torch.from_numpy(starts).to(agent.device))
    low, high = agent.policy.value_range.tolist()
    return {"mean": float(values.mean()), "low": low, "high": high}
