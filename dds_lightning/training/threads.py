"""Choose torch's threads for a training by a short measurement: on small networks a second thread only costs."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.accelerators import CPUAccelerator
from rich.console import Console

from dds_lightning.errors import UserError
from dds_lightning.module import StageModule

WORTH = 1.15
"""How much faster twice as many threads must be to be used: the others could do something else."""
SECONDS, LEAST, MOST = 1.5, 2, 15
"""Seconds that each number of threads is measured for, within these numbers of repetitions."""
HOPELESS = 2.0
"""How many times as slow as the best a number of threads is not tried again: threads may be waiting for a busy core."""
HELP = "threads of torch; without it, as many as a short measurement finds worth it"


def times(work: Callable[[], Any], counts: list[int]) -> dict[int, float]:
    """Measure some work, in turn with each number of threads.

    Args:
        work: What to measure; it has been done before.
        counts: Numbers of threads.

    Returns:
        Number of threads to the least seconds on the clock.
    """
    before = torch.get_num_threads()
    best = dict.fromkeys(counts, float("inf"))
    started = time.perf_counter()
    try:
        for turn in range(MOST):
            for count in counts:
                if best[count] < float("inf") and best[count] > HOPELESS * min(best.values()):
                    continue
                torch.set_num_threads(count)
                began = time.perf_counter()
                work()
                best[count] = min(best[count], time.perf_counter() - began)
            if turn + 1 >= LEAST and time.perf_counter() - started > SECONDS * len(counts):
                break
    finally:
        torch.set_num_threads(before)
    return best


def worthwhile(seconds: Mapping[int, float]) -> int:
    """The number of threads to use, from what each takes: a larger one only where it is clearly faster."""
    chosen = min(seconds)
    for count in sorted(seconds):
        if seconds[count] * WORTH < seconds[chosen]:
            chosen = count
    return chosen


def settle_threads(trainer: pl.Trainer, module: StageModule, data: pl.LightningDataModule) -> int | None:
    """Measure with which number of threads this training is fastest, on a copy of the module and one of its batches.

    The random streams stay untouched.

    Returns:
        The number; None where torch's own stays: on an accelerator, in several processes, on one thread, or for a
        module without `loss`.
    """
    most = torch.get_num_threads()
    on_cpu = isinstance(trainer.accelerator, CPUAccelerator) and trainer.world_size == 1
    if most == 1 or not on_cpu or not hasattr(module, "loss"):
        return None
    with torch.random.fork_rng(devices=[]):
        data.prepare_data()
        data.setup("fit")
        batch = next(iter(data.train_dataloader()))
        trial: Any = copy.deepcopy(module).train()

        def work() -> None:
            with trainer.precision_plugin.forward_context():
                loss = trial.loss(batch)
            (loss[0] if isinstance(loss, tuple) else loss).backward()

        work()
        seconds = times(work, [*(2**power for power in range((most - 1).bit_length())), most])
    chosen = worthwhile(seconds)
    best = min(count for count in seconds if seconds[count] == min(seconds.values()))
    other = best if best != chosen else max(seconds)
    why = f" ({other} would be {seconds[chosen] / seconds[other]:.1f} times as fast)" if other != chosen else ""
    Console(stderr=True).print(f"threads: {chosen} of {most}{why}", style="dim", highlight=False)
    return chosen


def refuse_threads(count: int | None) -> None:
    """Refuse a number of threads that cannot be.

    Raises:
        UserError: It is less than 1.
    """
    if count is not None and count < 1:
        raise UserError(f"--threads is {count}, expected at least 1")
