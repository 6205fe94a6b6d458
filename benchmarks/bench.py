"""How fast is a step of each training, beside what the processor could do, the paper's plain loop and other packages?

    make bench        # or: python benchmarks/bench.py [--rounds 5] [--run runs/TASK ...] [--out benchmarks/results]

Everything is measured in one run, on one thread, in seconds of processor time, in turn, so that another program on the
machine changes the ratios little; the best of the rounds counts. Batches are ready: nobody pays for reading data. The
columns of the table:

- steps/s: optimiser steps a second of processor time, of the module alone and through the Trainer with this project's
  callbacks (all but files and logs).
- of the limit: against the floating-point operations of the step (torch counts those of matrix products) divided by the
  speed of a product of two 1024 x 1024 matrices in the same precision.
- against the paper: against a plain float32 loop of the paper's own configuration.
- against the best peer: against the fastest other package that is installed; those that are missing are said.

With `--run`, also the seconds of finished runs of `dds run` and their score, with `--busy` what a program that keeps
one core busy does to a step. Writes tables as Markdown and Parquet, and costs.png: processor time of a skill step
against H, K, D and width, and of a policy step with its batch against the number of transitions.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import bench_parts as parts  # with `peers` beside this file
import lightning.pytorch as pl
import pandas as pd
import peers
import torch
from bench_parts import (
    ACTIONS,
    OBSERVATIONS,
    SKILLS,
    Batch,
    alone,
    loss_of,
    seconds_per_step,
    segments,
    settings,
    skill_model,
    transitions,
)
from torch.utils.flop_counter import FlopCounterMode

from datamodules.loader import TensorLoader
from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
from dds_lightning.callbacks.compiled import CompiledLoss
from dds_lightning.callbacks.several import SeveralUpdates
from dds_lightning.module import StageModule
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.files import written_whole
from dds_lightning.study.tables import markdown
from dds_lightning.training.fit import quieten
from dds_lightning.training.trainer import trainer_settings

FIRST = 5
"""Steps before the clock starts, and of a group where several are taken at once."""
PRECISIONS = {"32-true": torch.float32, "bf16-mixed": torch.bfloat16}
PEERS = {
    "policy": {
        "single-file IQL": peers.single_file_iql,
        "TorchRL DiscreteIQLLoss": peers.torchrl_iql,
        "d3rlpy IQL": peers.d3rlpy_iql,
    },
    "clone": {"d3rlpy BC": lambda batch, _: peers.d3rlpy_bc(batch["observations"][:, 0], batch["actions"][:, 0])},
}


class Contender(NamedTuple):
    """Something whose steps are timed; `work(n)` does n of them."""

    stage: str
    name: str
    precision: str
    work: Callable[[int], Any]
    flops: int = 0
    ours: bool = False


# ---------------------------------------------------------------------- what is measured


def ours() -> dict[str, tuple[Callable[[], StageModule], Batch]]:
    """Each stage with the settings of the AntMaze presets."""
    skill, skill_data = settings("antmaze/skill.yaml")
    policy, _ = settings("antmaze/policy.yaml")
    clone, clone_data = settings("clone.yaml")
    return {
        "skill": (lambda: skill_model(**skill), segments(skill_data["batch_size"], skill_data["horizon"])),
        "policy": (lambda: PolicyModule(OBSERVATIONS, SKILLS, **policy), transitions(256)),
        "policy, without Fourier features": (
            lambda: PolicyModule(OBSERVATIONS, SKILLS, **{**policy, "fourier_features": 0}),
            transitions(256),
        ),
        "clone": (lambda: BehaviourCloning(OBSERVATIONS, ACTIONS, **clone), segments(clone_data["batch_size"], 1)),
    }


class Ready(pl.LightningDataModule):
    """One batch again and again, with statistics under which nothing is scaled."""

    def __init__(self, batch: Batch, steps: int) -> None:
        super().__init__()
        self.batch, self.steps = batch, steps

    def statistics(self) -> dict[str, Any]:
        """Of observations, actions, codes and rewards."""
        units = {"observation_mean": torch.zeros(OBSERVATIONS), "observation_std": torch.ones(OBSERVATIONS)}
        units |= {"action_low": -torch.ones(ACTIONS), "action_high": torch.ones(ACTIONS)}
        share = torch.full((SKILLS,), 1.0 / SKILLS)
        return {**units, "code_share": share, "reward_range": (-3.0, 3.0), "max_discount": 0.9}

    def train_dataloader(self) -> TensorLoader:
        """The batches."""
        return TensorLoader(lambda _: self.batch, self.steps, 1)


def trained(
    make: Callable[[], StageModule], batch: Batch, precision: str, *callbacks: pl.Callback
) -> Callable[[int], None]:
    """Steps of a module through the Trainer."""

    def work(asked: int) -> float:
        steps = -(-asked // FIRST) * FIRST
        usual = {"accelerator": "cpu", "precision": precision, "max_steps": steps + FIRST, "max_epochs": -1}
        quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
        clock = _Clock()
        pl.Trainer(**trainer_settings({**usual, **quiet, "callbacks": [clock, *callbacks]}, [])).fit(
            make(), Ready(batch, steps + FIRST)
        )
        return clock.seconds * asked / steps

    return work


class _Clock(pl.Callback):
    """Processor time of all steps but the first."""

    seconds = 0.0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.global_step == FIRST:
            self.began = time.process_time()

    def on_train_end(self, *_: Any) -> None:
        self.seconds = time.process_time() - self.began


def contenders() -> Iterator[Contender]:
    """Everyone in the table; those that are missing say so."""
    for stage, (make, batch) in ours().items():
        module = make()
        with FlopCounterMode(display=False) as counted:
            loss_of(module.train(), batch).backward()
        flops = counted.get_total_flops()
        for precision in PRECISIONS:
            yield Contender(stage, "module alone", precision, alone(make(), batch, precision), flops, True)
            yield Contender(stage, "through the Trainer", precision, trained(make, batch, precision), flops, True)
            if stage != "skill":  # whose step hardly consists of anything but products
                compiled = trained(make, batch, precision, CompiledLoss())
                yield Contender(stage, "through the Trainer, compiled", precision, compiled, flops, True)
                both = trained(make, batch, precision, CompiledLoss(), SeveralUpdates(FIRST))
                yield Contender(stage, "compiled, several updates a round", precision, both, flops, True)
        for name, peer in PEERS.get(stage.partition(",")[0], {}).items():
            try:
                update = peer(batch, SKILLS)
            except ImportError as error:
                print(f"{name} is left out: {error}", file=sys.stderr)
                continue
            yield Contender(stage, name, "32-true", _repeat(update))
    for stage in ("skill", "policy"):
        model, data = settings(f"paper/{stage}.yaml")
        module = skill_model(**model) if stage == "skill" else PolicyModule(OBSERVATIONS, SKILLS, **model)
        batch = segments(data["batch_size"], data["horizon"]) if stage == "skill" else transitions(data["batch_size"])
        part = "" if stage == "skill" else " of its first phase, the critic alone"
        name = f"the paper's configuration, plain loop{part}"
        yield Contender(stage, name, "32-true", alone(module, batch, fused=False))


def _repeat(update: Callable[[], Any]) -> Callable[[int], None]:
    def work(steps: int) -> None:
        for _ in range(steps):
            update()

    return work


# ---------------------------------------------------------------------- measuring


def product_speed(kind: torch.dtype, size: int = 1024, repeats: int = 8) -> float:
    """Floating-point operations a second of processor time of a matrix product."""
    a, b = torch.randn(size, size).to(kind), torch.randn(size, size).to(kind)
    best = min(seconds_per_step(lambda _: a @ b, 1) for _ in range(repeats))
    return 2.0 * size**3 / best


def measure(rounds: int, budget: float) -> pd.DataFrame:
    """The table: every contender in turn, `budget` seconds a round, the best round counts."""
    everyone = list(contenders())
    speeds = dict.fromkeys(PRECISIONS, 0.0)
    best = [float("inf")] * len(everyone)
    counts = [max(2, round(budget / max(seconds_per_step(one.work, 2), 1e-6))) for one in everyone]
    for turn in range(rounds):
        print(f"round {turn + 1} of {rounds}", file=sys.stderr)
        for precision, kind in PRECISIONS.items():
            speeds[precision] = max(speeds[precision], product_speed(kind))
        for number, one in enumerate(everyone):
            best[number] = min(best[number], seconds_per_step(one.work, counts[number]))
    rows = []
    for one, spent in zip(everyone, best, strict=True):
        limit = one.flops / speeds[one.precision] / spent if one.flops else None
        rows.append({**one._asdict(), "steps_per_s": 1.0 / spent, "of_limit": limit, "product": speeds[one.precision]})
    table = pd.DataFrame(rows).drop(columns="work")
    for column, chosen in (
        ("against_paper", table["name"].str.startswith("the paper")),
        ("against_peer", ~table["ours"] & ~table["name"].str.startswith("the paper")),
    ):
        fastest = table[chosen].groupby(table["stage"].str.partition(",")[0])["steps_per_s"].max()
        table[column] = table["steps_per_s"] / table["stage"].str.partition(",")[0].map(fastest)
        table.loc[~table["ours"], column] = float("nan")
    return table


TITLES = {
    "bench": "Steps per second",
    "costs": "What a step costs\n\n![costs](costs.png)",
    "runs": "Seconds to a score\n\nWhat the run directories recorded, stage by stage.",
    "busy": "Beside a busy program",
}


def write(tables: dict[str, pd.DataFrame], out: Path) -> str:
    """Write the tables, the figure and the page, which is returned."""
    parts.draw_costs(tables["costs"], out / "costs.png")
    speeds = tables["bench"].groupby("precision")["product"].first() / 1e9
    about = f"torch {torch.__version__}, {platform.machine()}, one thread; matrix product: "
    about += ", ".join(f"{speed:.0f} GFLOP/s in {name}" for name, speed in speeds.items())
    page = [f"# Speed\n\nWritten by `make bench`, whose docstring explains the columns. {about}."]
    for name, table in tables.items():
        with written_whole(out / f"{name}.parquet") as part:
            table.to_parquet(part, index=False)
        formats = {key: ".2f" for key in table.columns if table[key].dtype.kind == "f"}
        shown = table.drop(columns=["flops", "ours", "product"], errors="ignore")
        formats |= {"steps_per_s": ".1f", "ms": ".1f", "value": ",.0f"}
        page += [f"## {TITLES[name]}", markdown(shown, formats)]
    text = "\n\n".join(page) + "\n"
    with written_whole(out / "bench.md") as part:
        part.write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5, help="processor time of each contender in a round")
    parser.add_argument("--run", type=Path, nargs="*", default=[], help="finished run directories")
    parser.add_argument("--busy", action="store_true", help="measure beside a busy program, too; on an idle machine")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    asked = parser.parse_args()
    quieten()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    asked.out.mkdir(parents=True, exist_ok=True)
    tables = {"bench": measure(asked.rounds, asked.seconds), "costs": parts.costs()}
    if asked.run:
        tables["runs"] = parts.finished_runs(asked.run)
    if asked.busy:
        skill, batch = ours()["skill"]
        tables["busy"] = parts.beside_busy(skill, batch)
    print(write(tables, asked.out))


if __name__ == "__main__":
    main()
