"""Settle the precision of a training that asks for the faster one."""

from __future__ import annotations

import math
import os

import torch
from jsonargparse import Namespace
from rich.console import Console

from dds_lightning.nn.precision import fastest_precision

SETTLED = "DDS_PRECISION"
"""Variable by which the processes of one training agree."""
OVERRULED = "auto: measure whether bfloat16 is faster here; --trainer.precision overrules it"
"""Help of the option."""


def settle_precision(settings: Namespace) -> str | None:
    """Settle `precision: auto` of a training, unless the user or the checkpoint that goes on has.

    Returns:
        What was measured; None where nothing was.
    """
    if settings.get("precision") != "auto" or settings.trainer.precision is not None:
        return None
    use_gpu = torch.cuda.is_available() and settings.trainer.accelerator in ("auto", "gpu", "cuda")
    if "LOCAL_RANK" in os.environ and SETTLED in os.environ:  # the first process, which started this one, has measured
        settings.trainer.precision = os.environ[SETTLED]
        return os.environ[SETTLED]
    choice = fastest_precision(use_gpu)
    settings.trainer.precision = os.environ[SETTLED] = choice.precision
    why = "" if math.isnan(choice.speedup) else f" (bfloat16 is {choice.speedup:.1f} times as fast as float32 here)"
    Console(stderr=True).print(f"precision: {choice.precision}{why}", style="dim", highlight=False)
    return choice.precision
