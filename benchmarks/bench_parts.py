"""What `bench.py` is made of: batches, plain loops, and the tables beside the main one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
import torch
from torch import Tensor

from datamodules.loader import TensorLoader
from dds_lightning.configs import find
from dds_lightning.module import StageModule
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.skill import SkillModule

OBSERVATIONS, ACTIONS, SKILLS = 29, 8, 16
Batch = dict[str, Tensor]


def segments(rows: int, horizon: int) -> Batch:
    """Random segments with AntMaze's widths."""
    return {
        "observations": torch.randn(rows, horizon, OBSERVATIONS),
        "actions": torch.rand(rows, horizon, ACTIONS) * 2 - 1,
    }


def transitions(rows: int) -> Batch:
    """Random transitions between skills."""
    return {
        "observations": torch.randn(rows, OBSERVATIONS),
        "codes": torch.randint(SKILLS, (rows,)),
        "rewards": torch.randn(rows),
        "next_observations": torch.randn(rows, OBSERVATIONS),
        "discounts": torch.full((rows,), 0.9),
        "dones": torch.zeros(rows),
    }


def settings(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings of the model and of the data in a packaged configuration."""
    config = read_yaml(find(name))
    schedules = ("lr_schedule", "warmup_steps", "critic_steps")
    return {key: value for key, value in config["model"].items() if key not in schedules}, config["data"]


def skill_model(**model: Any) -> SkillModule:
    """A skill model whose codebook needs no data to start."""
    return SkillModule(OBSERVATIONS, ACTIONS, **{**model, "codebook_init": "uniform"})


def loss_of(module: Any, batch: Batch) -> Tensor:
    """The scalar that a training minimises."""
    loss = module.loss(batch)
    return loss[0] if isinstance(loss, tuple) else loss


def alone(module: StageModule, batch: Batch, precision: str = "32-true", fused: bool = True) -> Callable[[int], None]:
    """Steps of a module in a plain loop."""
    module.train()
    optimiser = torch.optim.Adam([p for p in module.parameters() if p.requires_grad], lr=1e-4, fused=fused)

    def work(steps: int) -> None:
        for step in range(steps):
            with torch.autocast("cpu", torch.bfloat16, enabled=precision != "32-true"):
                loss = loss_of(module, batch)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            if isinstance(module, PolicyModule):
                module.after_step(step + 1)

    return work


def seconds_per_step(work: Callable[[int], Any], steps: int) -> float:
    """Processor seconds a step; work that keeps its own time returns it."""
    began = time.process_time()
    own = work(steps)
    spent = own if isinstance(own, float) else time.process_time() - began
    return spent / steps


# ---------------------------------------------------------------------- costs, runs, a busy program


def costs(steps: int = 3) -> pd.DataFrame:
    """Milliseconds of processor time against one size at a time."""
    usual = {"horizon": 10, "num_skills": SKILLS, "skill_dim": 64, "hidden_dim": 128}
    fixed = {"encoder_layers": 2, "encoder_heads": 4, "decoder_blocks": 3, "dropout": 0.0}
    sizes = {"horizon": (5, 10, 20, 40), "num_skills": (8, 16, 64, 256), "skill_dim": (16, 64, 256)}
    rows = []
    for name, values in {**sizes, "hidden_dim": (64, 128, 256)}.items():
        for value in values:
            chosen = {**usual, name: value}
            work = alone(skill_model(**chosen, **fixed), segments(64, chosen["horizon"]))
            work(1)
            spent = min(seconds_per_step(work, 1) for _ in range(steps))
            rows.append({"stage": "skill", "size": name, "value": value, "ms": 1000 * spent})
    for value in (10_000, 100_000, 1_000_000):
        spent = _with_batches(value, 10 * steps)
        rows.append({"stage": "policy", "size": "transitions", "value": value, "ms": 1000 * spent})
    return pd.DataFrame(rows)


def _with_batches(size: int, steps: int) -> float:
    """Processor seconds of a policy step and its batch, out of `size` transitions in a random order."""
    data = transitions(size)
    loader = iter(TensorLoader(lambda rows: {key: x[rows] for key, x in data.items()}, size, 256, shuffle=True))
    step = alone(PolicyModule(OBSERVATIONS, SKILLS, extraction="joint"), next(loader))

    def work(count: int) -> None:
        next(loader)
        step(count)

    return min(seconds_per_step(work, 1) for _ in range(steps))


def draw_costs(table: pd.DataFrame, path: Path) -> None:
    """One panel a size."""
    names = list(table["size"].unique())
    figure, axes = plt.subplots(1, len(names), figsize=(3 * len(names), 2.8), layout="constrained")
    for axis, name in zip(axes, names, strict=True):
        chosen = table[table["size"] == name]
        axis.plot(chosen["value"], chosen["ms"], "o-")
        axis.set(
            xscale="log",
            ylim=(0, 1.1 * chosen["ms"].max()),
            xlabel=name,
            title=chosen["stage"].iloc[0],
            ylabel="ms a step",
        )
        axis.set_xticks(chosen["value"], [f"{value:,}" for value in chosen["value"]], minor=False)
        axis.minorticks_off()
    with written_whole(path) as part:
        figure.savefig(part, format="png", dpi=120)
    plt.close(figure)


def finished_runs(folders: list[Path]) -> pd.DataFrame:
    """Seconds of each stage of finished runs, and the score of the contestant that each is about."""
    rows = []
    for folder in folders:
        markers = {path.parent.name: json.loads(path.read_text()) for path in sorted(folder.glob("*/stage.json"))}
        facts = markers["report"]["facts"]
        score = next(row["score"] for row in facts["table"] if row["contestant"] == facts["main"])
        seconds = {name: marker["seconds"] for name, marker in markers.items()}
        rows.append({"task": facts["task"], "score": score, "seconds": sum(seconds.values()), **seconds})
    return pd.DataFrame(rows)


@contextmanager
def busy_program() -> Iterator[None]:
    """A program that keeps one core busy."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def beside_busy(make: Callable[[], StageModule], batch: Batch, steps: int = 10) -> pd.DataFrame:
    """Milliseconds on the clock of a step, with one thread and with all, alone and beside a busy program."""
    rows, cores = [], os.cpu_count() or 1
    for threads in sorted({1, cores}):
        torch.set_num_threads(threads)
        work = alone(make(), batch)
        work(3)
        spent = {}
        for name in ("alone", "beside a busy program"):
            with busy_program() if name != "alone" else open(os.devnull):
                began = time.perf_counter()
                work(steps)
                spent[name] = 1000 * (time.perf_counter() - began) / steps
        rows.append({"threads": threads, **spent, "times as long": spent["beside a busy program"] / spent["alone"]})
    torch.set_num_threads(1)
    return pd.DataFrame(rows)
