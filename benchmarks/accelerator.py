"""What a GPU makes of each training, and what each option of it brings.

    python benchmarks/accelerator.py [--device cuda] [--steps 500] [--rows 1000000] [--variants ...] [--out FOLDER]

Each stage has the settings of the AntMaze presets and random numbers of AntMaze's widths; batches are drawn from
`--rows` steps. Variants, each with all that comes before it: data in the machine's memory, data on the GPU, bfloat16,
a compiled loss, the same replayed as CUDA graphs, ten updates for each of the Trainer's rounds, and with these 8 times
the batch. Every one runs through the Trainer with this project's callbacks (all but files and logs), on the clock, and
the device is waited for at both ends; the last row of a stage is its module alone, so that the Trainer's share can be
read. Writes a table as Markdown and Parquet.

On a processor (`--device cpu --variants host device bf16`) it shows that the same code runs, and nothing else.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench  # with `bench_parts` beside this file
import lightning.pytorch as pl
import pandas as pd
import torch
from bench_parts import Batch, alone, segments, transitions
from torch import Tensor

from datamodules.loader import TensorLoader
from dds_lightning.callbacks.compiled import CompiledLoss
from dds_lightning.callbacks.several import SeveralUpdates
from dds_lightning.module import StageModule
from dds_lightning.saving.files import written_whole
from dds_lightning.study.tables import markdown
from dds_lightning.training.fit import quieten
from dds_lightning.training.trainer import trainer_settings

WARM = 20
"""Steps before the clock starts: compiling, choosing kernels, recording graphs."""
STAGES = ("skill", "policy", "clone")


@dataclass(frozen=True)
class Variant:
    """A way to train."""

    title: str
    on_device: bool = True
    precision: str = "bf16-mixed"
    mode: str | None = None  # of `CompiledLoss`; None compiles nothing
    group: int = 1  # of `SeveralUpdates`
    times: int = 1  # as many rows in a batch as the preset has


VARIANTS = {
    "host": Variant("data in the machine's memory, float32", on_device=False, precision="32-true"),
    "device": Variant("data on the device, float32", precision="32-true"),
    "bf16": Variant("bfloat16"),
    "compiled": Variant("compiled", mode="default"),
    "graphs": Variant("compiled, CUDA graphs", mode="reduce-overhead"),
    "several": Variant("compiled, CUDA graphs, 10 updates a round", mode="reduce-overhead", group=10),
    "batch": Variant("the same, batches 8 times as large", mode="reduce-overhead", group=10, times=8),
}


class Drawn(bench.Ready):
    """Batches drawn from many rows on some device, with statistics under which nothing is scaled."""

    def __init__(self, rows: Batch, batch_size: int, device: torch.device) -> None:
        super().__init__(rows, 0)
        self.rows = {name: values.to(device) for name, values in rows.items()}
        self.batch_size, self.device = batch_size, device

    def train_dataloader(self) -> TensorLoader:
        """Shuffled batches."""
        size = len(next(iter(self.rows.values())))

        def gather(index: Tensor) -> Batch:
            return {name: values[index] for name, values in self.rows.items()}

        return TensorLoader(gather, size, self.batch_size, shuffle=True, drop_last=True, device=self.device)


class Clock(pl.Callback):
    """Seconds on the clock of all steps but the first ones."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.began, self.seconds = device, 0.0, 0.0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Start after the first steps."""
        if trainer.global_step == WARM:
            self.began = now(self.device)

    def on_train_end(self, *_: Any) -> None:
        """Stop."""
        self.seconds = now(self.device) - self.began


def now(device: torch.device) -> float:
    """Seconds on the clock, once the device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def rate(make: Callable[[], StageModule], rows: Batch, size: int, one: Variant, device: str, steps: int) -> float:
    """Optimiser steps a second through the Trainer."""
    place = torch.device(device)
    clock = Clock(place)
    data = Drawn(rows, size * one.times, place if one.on_device else torch.device("cpu"))
    callbacks: list[pl.Callback] = [clock]
    if one.mode is not None:
        callbacks.append(CompiledLoss(one.mode))  # type: ignore[arg-type]
    if one.group > 1:
        callbacks.append(SeveralUpdates(one.group))
    usual = {"accelerator": device, "devices": 1, "precision": one.precision, "max_steps": steps + WARM}
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    pl.Trainer(**trainer_settings({**usual, **quiet, "max_epochs": -1, "callbacks": callbacks}, [])).fit(make(), data)
    return steps / clock.seconds


def rate_alone(make: Callable[[], StageModule], rows: Batch, size: int, device: str, steps: int) -> float:
    """Optimiser steps a second of the module in a plain loop, in bfloat16, on one batch."""
    place = torch.device(device)
    batch = {name: values[:size].to(place) for name, values in rows.items()}
    work = alone(make().to(place), batch, "bf16-mixed")
    work(WARM)
    began = now(place)
    work(steps)
    return steps / (now(place) - began)


def measure(device: str, steps: int, rows: int, variants: list[str], stages: list[str]) -> pd.DataFrame:
    """A row for each stage and variant."""
    found = []
    for stage in stages:
        make, batch = bench.ours()[stage]
        first = next(iter(batch.values()))
        size, horizon = len(first), first.shape[1]
        many = transitions(rows) if stage == "policy" else segments(-(-rows // horizon), horizon)
        for name in variants:
            one = VARIANTS[name]
            speed = rate(make, many, size, one, device, steps)
            found.append(
                {"stage": stage, "variant": one.title, "steps_per_s": speed, "rows_per_s": speed * size * one.times}
            )
        speed = rate_alone(make, many, size, device, steps)
        found.append(
            {"stage": stage, "variant": "module alone, bfloat16", "steps_per_s": speed, "rows_per_s": speed * size}
        )
    return pd.DataFrame(found)


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--stages", nargs="+", choices=STAGES, default=list(STAGES))
    parser.add_argument(
        "--out", type=Path, help="folder for accelerator.md and accelerator.parquet; none writes nothing"
    )
    asked = parser.parse_args()
    if asked.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch sees no GPU here; --device cpu shows only that the code runs")
    quieten()
    torch.manual_seed(0)
    table = measure(asked.device, asked.steps, asked.rows, asked.variants, asked.stages)
    name = torch.cuda.get_device_name() if asked.device == "cuda" else "a processor"
    shown = markdown(table, {"steps_per_s": ",.1f", "rows_per_s": ",.0f"})
    page = f"# Trainings on {name}\n\nWritten by `benchmarks/accelerator.py`; torch {torch.__version__}.\n\n{shown}\n"
    print(page)
    if asked.out is not None:
        asked.out.mkdir(parents=True, exist_ok=True)
        with written_whole(asked.out / "accelerator.parquet") as part:
            table.to_parquet(part, index=False)
        with written_whole(asked.out / "accelerator.md") as part:
            part.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
