"""The step of `dds run` that lets everyone play; those who need no policy can play before it is trained."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.pipeline.context import Run, Settings
from dds_lightning.study import contestants, protocol
from dds_lightning.tasks import Task, facts_to_keep

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent


def evaluation_settings(run: Run) -> Settings:
    """What a table of episodes depends on beside those who play."""
    wanted = run.wanted
    settings: Settings = {
        **facts_to_keep(run.task),
        "seed": wanted.seed,
        "episodes": run.episodes,
        "episodes_per_skill": wanted.episodes_per_skill,
        "selection": wanted.selection,
        "temperature": wanted.temperature,
    }
    return settings if wanted.noise_scale is None else {**settings, "noise_scale": wanted.noise_scale}


def play_baselines(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Let everyone play who needs no policy: random and single skills, the clone, the data's controller."""
    from dds_lightning.agent import DDSAgent
    from dds_lightning.baselines.behaviour_cloning import CloneActor
    from dds_lightning.rollout.actors import Contestant, single_skills
    from dds_lightning.rollout.play import rollout
    from dds_lightning.skill import SkillModule

    wanted, task = run.wanted, run.task
    skill = SkillModule.load(run.output("skill", "checkpoint"))
    agent = DDSAgent(skill, selection="random", noise_scale=wanted.noise_scale, seed=wanted.seed)
    clone = CloneActor.load(run.output("clone", "checkpoint"))
    players = [
        contestants.way(agent, "random", run.episodes),
        single_skills(agent, wanted.episodes_per_skill),
        Contestant("behaviour cloning", clone, run.episodes),
    ]
    if wanted.data is None and (controller := contestants.behaviour_controller(task)) is not None:
        players.append(Contestant("the data's controller", controller, run.episodes))
    rollout(task, players, seed=wanted.seed, workers=wanted.workers, record=True).save(folder)
    return {"episodes": folder / "episodes.parquet"}


def publish_played(
    agent: DDSAgent, name: str, task: Task, place: Path, episodes: int, seed: int, workers: int | None
) -> Mapping[str, Any]:
    """Let an agent play by itself, and publish it with what it reached.

    Args:
        agent: Who plays.
        name: What a table calls it.
        task: What it plays.
        place: Folder to publish it in.
        episodes: Number of episodes.
        seed: Of the episodes.
        workers: Processes for the environments; None takes one per core.

    Returns:
        ``agent``, the published folder, and ``played``, the row of the table.
    """
    from dds_lightning.rollout.actors import Contestant
    from dds_lightning.rollout.play import rollout

    result = rollout(task, [Contestant(name, agent, episodes)], seed=seed, workers=workers)
    (played,) = json.loads(result.summary().to_json(orient="records"))
    metrics = {"episodes": episodes, "seed": seed, "results": [played]}
    return {"agent": agent.save(place, metrics=metrics, **facts_to_keep(task)), "played": played}


def evaluate(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Publish the agent and let everyone in the table play."""
    from dds_lightning.agent import DDSAgent
    from dds_lightning.baselines.behaviour_cloning import CloneActor
    from dds_lightning.console.reports import plain
    from dds_lightning.policy import PolicyModule
    from dds_lightning.rollout.play import rollout
    from dds_lightning.rollout.result import RolloutResult
    from dds_lightning.skill import SkillModule

    wanted, task = run.wanted, run.task
    chosen: dict[str, Any] = run.facts("policy").get("chosen", {})
    skill = SkillModule.load(run.output("skill", "checkpoint"))

    def agent_of(checkpoint: str, way: Any = wanted.selection, alpha: float | None = None) -> DDSAgent:
        policy = PolicyModule.load(run.output("policy", checkpoint))
        policy.hparams.alpha = policy.hparams.alpha if alpha is None else alpha
        return DDSAgent(skill, policy, way, wanted.temperature, wanted.noise_scale, seed=wanted.seed)

    agent = agent_of("checkpoint")
    best = agent_of("best") if chosen else None
    closed = agent.policy is not None and agent.policy.hparams.awr == "closed_form"
    players = contestants.final_contestants(
        agent,
        task,
        run.episodes,
        wanted.episodes_per_skill,
        clone=CloneActor.load(run.output("clone", "checkpoint")),
        controller=contestants.behaviour_controller(task) if wanted.data is None else None,
        best=contestants.best_ways(best, run.episodes, chosen) if best else (),
        data_policy=agent_of("checkpoint", "sample", alpha=0.0) if closed else None,
    )
    earlier = RolloutResult.load(run.output("baselines", "episodes").parent)
    left = [player for player in players if player.name not in set(earlier.episodes["actor"])]
    result = rollout(task, left, seed=wanted.seed, workers=wanted.workers, record=True)
    result = result.joined(earlier, [player.name for player in players])
    result.save(folder)
    results = json.loads(result.summary().round(4).to_json(orient="records"))  # NaN becomes null
    metrics = {"episodes": run.episodes, "seed": wanted.seed, "results": results}
    kept = facts_to_keep(task)
    made: dict[str, Any] = {
        "protocol": protocol.protocol(
            task, agent, episodes=run.episodes, seed=wanted.seed, temperature=wanted.temperature, best=chosen
        ),
        "start_value": plain(protocol.start_value(task, agent, wanted.seed)),
        "agent": agent.save(run.out / "agent", metrics=metrics, card=_card(run, result.episodes), **kept),
    }
    if best:
        place = run.out / contestants.BEST_AGENT
        made["best"] = best.save(place, metrics=metrics, **kept, checkpoint=chosen)
    return {"episodes": folder / "episodes.parquet", **made, "results": results}


def _card(run: Run, episodes: Any) -> str:
    """The README.md of the published agent."""
    from datamodules.collect.collectors import collection_command
    from dds_lightning.study.card import agent_card

    wanted = run.wanted
    command = f"dds data collect {run.task.name} --steps {wanted.data_steps} --seed {wanted.seed}"
    source = f"collected by `{command}`"
    if wanted.data is not None:
        known = collection_command(wanted.data.removeprefix("local:")) if wanted.data.startswith("local:") else None
        source = f"collected by `{known}` ({wanted.data})" if known else wanted.data
    return agent_card(
        run.task,
        episodes,
        seed=wanted.seed,
        data={"source": source, **run.facts("data")["facts"]},
        settings={stage: run.trainings.settings(stage) for stage in ("skill", "policy")},
        command=wanted.command(),
    )
