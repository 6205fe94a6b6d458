"""What the nodes of a study do. Each function takes (settings, how, what it reads, folder, resuming)."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from dds_lightning.agent import DDSAgent
from dds_lightning.configs import known_as
from dds_lightning.grid.cells import PLAYERS
from dds_lightning.grid.nodes import arguments
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.saving.run_directory import Done
from dds_lightning.study.protocol import BEST, LAST, trained
from dds_lightning.tasks import get_task
from dds_lightning.training.stage_cli import command
from dds_lightning.training.stages import STAGES

Facts = Mapping[str, Any]
Reads = Mapping[str, Done]


def look_at_data(settings: Facts, how: Facts, reads: Reads, folder: Path, resuming: bool) -> Facts:
    """Data that a user gave."""
    return {"spec": settings["data"]}


def collect_data(settings: Facts, how: Facts, reads: Reads, folder: Path, resuming: bool) -> Facts:
    """Make the data in the environment."""
    from datamodules.collect.collectors import collect

    task = get_task(settings["task"])
    steps, seed = int(settings["steps"]), int(settings["seed"])
    made = collect(task, steps, seed, folder, 1, overwrite=True)
    words = ["data", "collect", task.name, f"--steps={steps}", f"--seed={seed}", f"--out={folder}"]
    return {"data": made, "command": _by_hand(words, folder)}


def relabel(settings: Facts, how: Facts, reads: Reads, folder: Path, resuming: bool) -> Facts:
    """Fill the cache that policies over the same skills read."""
    from datamodules.relabelled import RelabeledDataModule

    options = {name: value for name, value in settings.items() if not name.startswith("task")}
    skill = str(reads["skill"].outputs["checkpoint"])
    module = RelabeledDataModule(settings["task"], _spec(reads), skill, cache=str(folder), **options)
    module.prepare_data()
    return {"cache": module.cache_file()}


def train(settings: Facts, how: Facts, reads: Reads, folder: Path, resuming: bool) -> Facts:
    """Run `dds STAGE fit`, from its last checkpoint if there is one."""
    stage = settings["stage"]
    words = arguments(stage, how, settings["seed"])
    words += [f"--data.task={settings['task']}", f"--data.seed={settings['seed']}"]
    # Online, data would be prior data.
    words += [f"--data.data={_spec(reads)}"] if stage != "online" else []
    earlier = {flag: reads[read] for read, flag in STAGES[stage].reads.items() if read in reads}
    words += [f"--{flag}={read.outputs['checkpoint']}" for flag, read in earlier.items()]
    words += [f"--data.cache={reads['relabel'].outputs['cache'].parent}"] if "relabel" in reads else []
    words += _watching(settings["watch"], settings["seed"]) if "watch" in settings else []
    words += [f"--trainer.default_root_dir={folder}", f"--checkpoint.dirpath={folder}", "--trainer.devices=1"]
    words += ["--trainer.enable_model_summary=false", "--trainer.enable_progress_bar=false"]
    last = folder / "last.ckpt"
    resume = [f"--ckpt_path={last}"] if resuming and last.is_file() else []
    fitted = command(stage, [*words, *resume])().data
    # Where nobody watches in the environment, the preset itself keeps the best, by a loss.
    made = trained(fitted, takes_best="watch" not in settings)
    return {**made, "command": _by_hand([stage, *map(known_as, words)], folder)}


def evaluate(settings: Facts, how: Facts, reads: Reads, folder: Path, resuming: bool) -> Facts:
    """Play the last checkpoint and, where one was kept, the best, in the real environment."""
    method, task = PLAYERS[settings["method"]], get_task(settings["task"])
    method = replace(method, stages=tuple(stage for stage in method.stages if stage in reads))  # raw: without skills
    last = {stage: str(reads[stage].outputs["checkpoint"]) for stage in method.stages}
    ends = {LAST: last}
    final = reads[method.stages[-1]]
    if "best" in final.outputs:
        ends[BEST] = {**last, method.stages[-1]: str(final.outputs["best"])}
    names = ("selection", "temperature", "noise_scale", "hold")
    acting = {name: settings[name] for name in names if name in settings}
    players, commands = [], []
    for name, checkpoints in ends.items():
        actor = method.play(checkpoints)
        if isinstance(actor, DDSAgent):
            actor = actor.variant(**acting, seed=settings["seed"])
        players.append(Contestant(name, actor, settings["episodes"]))
        words = ["evaluate", *([f"--skill={checkpoints['skill']}"] if "skill" in checkpoints else [])]
        words += [f"--policy={checkpoints[method.stages[-1]]}", *(f"--{key}={value}" for key, value in acting.items())]
        words += [f"--task={task.name}", f"--episodes={settings['episodes']}", f"--seed={settings['seed']}"]
        commands.append(_by_hand(words, folder))
    result = rollout(task, players, seed=settings["seed"], workers=0)
    result.save(folder)
    rows = json.loads(result.summary().round(4).to_json(orient="records"))
    return {"episodes": folder / "episodes.parquet", "results": rows, "command": " && ".join(commands)}


def _by_hand(words: Sequence[str], folder: Path) -> str:
    """The line that does the same in any folder: places of the study's are named from its own.

    Args:
        words: What follows `dds`.
        folder: Of the job, OUT/nodes/KEY.
    """
    return shlex.join(["dds", *(word.replace(f"{folder.parents[1]}{os.sep}", "") for word in words)])


def _spec(reads: Reads) -> str:
    data = reads["data"]
    return data.facts["spec"] if "spec" in data.facts else f"local:{data.outputs['data']}"


def _watching(watch: Facts, seed: int) -> list[str]:
    """The arguments that evaluate a training now and then and keep its best checkpoint."""
    acting = {name: watch[name] for name in ("temperature", "noise_scale") if name in watch}
    # Other starts than those of the table: the best is not scored by the episodes that chose it.
    chosen = {"episodes": watch["episodes"], "every_n_steps": watch["every"], "seed": seed + 1, "workers": 0, **acting}
    chosen["selections"] = [watch.get("selection", "greedy")]
    callback = {"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": chosen}
    best = ["--best.monitor=rollout/score", f"--best.every_n_steps={watch['every']}"]
    return [f"--trainer.callbacks+={json.dumps(callback)}", *best]
