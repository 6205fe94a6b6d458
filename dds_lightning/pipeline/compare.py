"""`dds online compare`: the same task learned online over codes, continuous skills and raw actions, seed by seed.

Every training is a `dds online fit` in a folder of its own and is done once; a comparison that was stopped goes on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from dds_lightning.agent import DDSAgent
from dds_lightning.console.refusals import did_you_mean
from dds_lightning.console.reports import Report, table
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.online import plot_comparison
from dds_lightning.online.offline import refuse_other_networks, refuse_other_policy
from dds_lightning.online.parts import checkpoint_parts
from dds_lightning.pipeline.evaluating import publish_played
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.arrays import read_npy
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.saving.published import weights_hash
from dds_lightning.saving.run_directory import Done, RunDirectory, locked
from dds_lightning.saving.untrusted import read_csv
from dds_lightning.tasks import get_task
from dds_lightning.training.stage_cli import command, settings_of
from dds_lightning.training.stages import get_stage

Facts = Mapping[str, Any]
CURVE = {
    "online/env_steps": "env_steps",
    "online/success": "success",
    "online/return": "return",
    "online/cells": "cells",
}


VARIANTS = {
    "discrete": "discrete skills",
    "continuous": "continuous skills",
    "raw": "raw actions",
    "prior": "discrete skills, prior data",
    "offline": "offline to online",
}
"""What `--variants` takes, and how tables and figures call it."""


@dataclass(frozen=True)
class Comparison:
    """What `dds online compare` was asked to do; see its help."""

    task: str
    out: Path
    skill: str | None = None
    gaussian: str | None = None
    data: str | None = None
    policy: str | None = None
    seeds: int = 3
    env_steps: int = 150_000
    episodes: int = 20
    workers: int | None = None
    config: str = "online.yaml"
    arguments: tuple[str, ...] = ()
    chosen: tuple[str, ...] = ()

    def variants(self) -> dict[str, list[str]]:
        """The variants that were chosen, or all whose files were given: name to arguments of `dds online fit`.

        Raises:
            UserError: One does not exist, or lacks a file.
        """
        units = [f"--data.skill={self.skill}"] if self.skill else []
        prior = [*units, f"--data.data={self.data}", f"--data.cache={self.out / 'relabel'}"]
        needs: dict[str, tuple[tuple[str, ...], list[str]]] = {
            "discrete": (("skill",), units),
            "continuous": (("gaussian",), [f"--data.skill={self.gaussian}"]),
            "raw": ((), [*units, "--data.actions=raw"]),
            "prior": (("skill", "data"), prior),
            "offline": (("skill", "data", "policy"), [*prior, f"--model.offline={self.policy}"]),
        }
        lacks = {key: [f"--{name}" for name in files if not getattr(self, name)] for key, (files, _) in needs.items()}
        chosen = self.chosen or [key for key in VARIANTS if not lacks[key]]
        for key in chosen:
            if key not in VARIANTS:
                near = did_you_mean(key, VARIANTS)
                raise UserError(f"--variants has {key}, expected some of {', '.join(VARIANTS)}{near}")
            if lacks[key]:
                raise UserError(f"--variants has {key}, which needs {' and '.join(lacks[key])} too")
        return {VARIANTS[key]: needs[key][1] for key in VARIANTS if key in chosen}


def compare(asked: Comparison) -> Report:
    """Train every variant with every seed, play the agents, and write one table and one figure.

    Raises:
        UserError: A setting or a file does not fit, found before the first training.
    """
    for name, value in (("seeds", asked.seeds), ("episodes", asked.episodes)):
        if value < 1:
            raise UserError(f"--{name} is {value}, expected at least 1")
    task = get_task(asked.task)
    variants = asked.variants()
    prepared = {name: _arguments(asked, more) for name, more in variants.items()}
    configs = {name: settings_of("online", arguments) for name, arguments in prepared.items()}
    _refuse_misfits(configs)
    with locked(asked.out):
        directory = RunDirectory(asked.out, Console(stderr=True))
        done = {
            (name, seed): _do(asked, directory, name, seed, prepared[name], configs[name])
            for name in variants
            for seed in range(asked.seeds)
        }
        rows = _table(variants, asked.seeds, done)
        rows.to_csv(asked.out / "table.csv", index=False)
        curves = {key: read_csv(one.outputs["curve"], {"env_steps": "iuf"}) for key, (one, _) in done.items()}
        visits = {key: read_npy(one.outputs["visits"]) for key, (one, _) in done.items()}
        figure = asked.out / "comparison.png"
        plot_comparison(task, curves, visits).savefig(figure, dpi=150)
    files = () if asked.chosen else ("skill", "gaussian", "data", "policy")
    left = [f"--{name}" for name in files if getattr(asked, name) is None]
    notes = [f"not given, so not compared: {', '.join(left)}"] if left else []
    data = {"task": task.name, "out": asked.out, "env_steps": asked.env_steps, "table": rows, "figure": figure}
    return Report(data, [table(rows), *notes, f"figure: {figure}"])


def _arguments(asked: Comparison, more: Sequence[str]) -> list[str]:
    """The arguments of a variant's `dds online fit`, seed and places aside; its steps follow from `env_steps`."""
    arguments = ["fit", "--config", asked.config, f"--data.task={asked.task}", *more, *asked.arguments]
    settings = settings_of("online", arguments)
    data, logged = settings["data"], settings["trainer"]["log_every_n_steps"]
    steps = int(data["updates"] * (asked.env_steps - data["random_steps"]))
    if steps < 1:
        raise UserError(
            f"--env_steps is {asked.env_steps}, expected more than data.random_steps {data['random_steps']}"
        )
    often = max(1, min(logged, steps // 20))  # a curve needs points
    return [*arguments, f"--trainer.max_steps={steps}", f"--trainer.log_every_n_steps={often}"]


def _refuse_misfits(configs: Mapping[str, Facts]) -> None:
    """Build the data of each variant and look at its policy, without training.

    Raises:
        UserError: A file is missing or of another kind, or a policy is one over other skills.
    """
    for name, config in configs.items():
        data: Any = get_stage("online").data_class()(**config["data"])
        expected = {"discrete skills": "discrete", "continuous skills": "continuous"}.get(name, data.space)
        if data.space != expected:
            flag, other = ("skill", "gaussian") if expected == "discrete" else ("gaussian", "skill")
            raise UserError(
                f"--{flag} is {data.hparams.skill}, whose skills are {data.space}, expected {expected}: give it as "
                f"--{other}"
            )
        if path := config["model"]["offline"]:
            policy = PolicyModule.load(path)
            refuse_other_policy(policy, path, data.skill_hash, data.choices)
            sizes = {"observation_dim": data.observation_dim}
            refuse_other_networks(policy, path, {**config["model"], **sizes}, data.hparams.data is not None)


def _settings(config: Facts) -> dict[str, Any]:
    """What a training's result depends on: its settings, and what the files hold instead of where they are."""
    places = {"skill": config["data"]["skill"], "policy": config["model"]["offline"]}
    data = {name: value for name, value in config["data"].items() if name not in ("skill", "cache", "seed")}
    return {
        "model": {name: value for name, value in config["model"].items() if name != "offline"},
        "data": data,
        "steps": config["trainer"]["max_steps"],
        "files": {name: weights_hash(Path(place)) for name, place in places.items() if place},
    }


def _do(
    asked: Comparison, directory: RunDirectory, name: str, seed: int, prepared: Sequence[str], config: Facts
) -> tuple[Done, Done]:
    """One training, and its agent at play; neither is repeated where it was done."""
    place, title = f"{name.replace(', ', '-').replace(' ', '-')}/{seed}", f"{name}, seed {seed}"
    trained = directory.do(place, title, _settings(config), [], partial(_train, seed, prepared))
    play = {"episodes": asked.episodes, "seed": seed}
    work = partial(_play, asked, name, seed, config["data"], trained)
    return trained, directory.do(f"{place}-played", f"{title}, at play", play, [trained], work)


def _train(seed: int, prepared: Sequence[str], folder: Path, resuming: bool) -> Mapping[str, Any]:
    """One training, its curve and its map."""
    last = folder / "last.ckpt"
    arguments = [*prepared, f"--seed_everything={seed}", f"--trainer.default_root_dir={folder}"]
    arguments += [f"--checkpoint.dirpath={folder}", "--trainer.enable_model_summary=false"]
    if resuming and last.is_file():
        arguments = [one for one in arguments if not one.startswith("--model.offline")] + [f"--ckpt_path={last}"]
    command("online", arguments)()
    curve = pd.concat(read_csv(path, {"step": "iuf"}) for path in sorted(folder.glob("logs/version_*/metrics.csv")))
    curve = curve.drop_duplicates("step", keep="last").sort_values("step")
    curve = curve[[name for name in CURVE if name in curve]].rename(columns=CURVE).dropna(subset="env_steps")
    curve.to_csv(folder / "curve.csv", index=False)
    visits = load_ckpt(last)["loops"]["fit_loop"]["state_dict"]["combined_loader"][0]["collector"]
    np.save(folder / "visits.npy", visits["visits"].numpy())
    collected = {key: float(value) for key, value in curve.iloc[-1].to_dict().items()}
    return {"curve": folder / "curve.csv", "visits": folder / "visits.npy", "checkpoint": last, "collected": collected}


def _play(
    asked: Comparison, name: str, seed: int, data: Facts, trained: Done, folder: Path, resuming: bool
) -> Mapping[str, Any]:
    """How the agent of a training plays, and the agent published with it."""
    skill = None if data["actions"] == "raw" else data["skill"]
    agent = DDSAgent(*checkpoint_parts(skill, str(trained.outputs["checkpoint"])), seed=seed)
    task = get_task(asked.task)
    return publish_played(agent, name, task, folder / "agent", asked.episodes, seed, asked.workers)


def _table(variants: Mapping[str, Any], seeds: int, done: Mapping[tuple[str, int], tuple[Done, Done]]) -> pd.DataFrame:
    """One row a variant: means over seeds, with the standard deviation (ddof 1) of what agents reach when they play."""
    rows = []
    for name in variants:
        pairs = [done[name, seed] for seed in range(seeds)]
        collected = pd.DataFrame([trained.facts["collected"] for trained, _ in pairs])
        played = pd.DataFrame([play.facts["played"] for _, play in pairs])
        measure = "score" if played["success"].isna().all() else "success"
        rows.append(
            {
                "variant": name,
                "seeds": seeds,
                "env_steps": int(collected["env_steps"].mean()),
                measure: played[measure].astype(float).mean(),
                "std": float(played[measure].astype(float).std(ddof=1)),
                "while learning": _mean(collected, "success" if measure == "success" else "return"),
                "cells": _mean(collected, "cells"),
            }
        )
    return pd.DataFrame(rows)


def _mean(collected: pd.DataFrame, name: str) -> float:
    """Mean over seeds; NaN where it was not counted: not every task is a maze, not every training ended an episode."""
    return float(collected[name].mean()) if name in collected else float("nan")
