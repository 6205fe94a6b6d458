"""The one way in which every stage is trained: stoppable, resumable, with advice when memory runs out."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import lightning.pytorch as pl
import torch
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher, _SubprocessScriptLauncher
from lightning.pytorch.utilities.exceptions import SIGTERMException

from dds_lightning.callbacks.best import BestCheckpoint, callback_state
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.console import interrupts
from dds_lightning.errors import UserError, is_out_of_memory, reason
from dds_lightning.module import StageModule
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.training.stages import Stage, get_stage
from dds_lightning.training.threads import settle_threads
from dds_lightning.training.trainer import THREADS, TrainingSettings

_CONNECTOR = "checkpoint_connector.py"
"""Where Lightning restores the state of a training at its start."""
_RESTORING = ("load_state_dict", "_load_state_dicts", "set_rng_state")
"""What restores the rest later, when loaders are made and training starts."""


class Fitted(NamedTuple):
    """What a training left.

    Attributes:
        checkpoint: The last checkpoint, from which it can go on; None where none is kept.
        best: The checkpoint with the best value of the monitored metric, if one is kept.
        steps: Optimiser steps in all, those of earlier launches included.
        metrics: The last value of every metric.
        logs: Folder of the logs.
    """

    checkpoint: Path | None
    best: str | None
    steps: int
    metrics: dict[str, float]
    logs: str | None


def fit(
    trainer: pl.Trainer,
    module: StageModule,
    data: pl.LightningDataModule,
    checkpoint: str | Path | None = None,
    threads: int | None = None,
) -> Fitted:
    """Train a stage.

    Args:
        trainer: With this project's parts, see `trainer_settings`.
        module: Of one of the registered stages.
        data: What it learns from.
        checkpoint: `.ckpt` to go on from; None starts.
        threads: Of torch; None takes the stage's own number, or as many as `settle_threads` finds worth it.

    Raises:
        UserError: Data or settings that cannot work, or memory that does not suffice.
        Interrupted: SIGTERM or Ctrl-C asked to stop; everything was saved before.
    """
    stage = get_stage(module.STAGE)
    if checkpoint is None:
        module.refuse_frozen_without_weights()
    spawns = isinstance(trainer.strategy.launcher, _MultiProcessingLauncher)
    # The processes of `ddp_spawn` defer a signal themselves, and this one passes it on.
    waits = _standard_output_to_error() if spawns else interrupts.deferred()
    try:
        with (
            resuming(checkpoint),
            advice_on_memory(trainer, module, data),
            torch_threads(_keep(threads or stage.threads or settle_threads(trainer, module, data), trainer)),
            waits,
        ):
            trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except SIGTERMException:  # before the first step; Lightning would end with status 0
        raise interrupts.Interrupted(signal.SIGTERM) from None
    except interrupts.Interrupted as stop:
        if spawns:
            stop.saved = _end_processes(trainer, stop.signum)
        raise
    except BaseException:
        if isinstance(trainer.strategy.launcher, _SubprocessScriptLauncher):
            trainer.strategy.launcher.kill(signal.SIGKILL)  # they would wait for this one in a collective
        raise
    saved = rolling(trainer)
    if spawns and saved is not None:
        return _fitted_elsewhere(trainer, saved.place(trainer))
    best = next((c.best_model_path for c in trainer.checkpoint_callbacks if isinstance(c, BestCheckpoint)), None)
    metrics = saved.latest(trainer) if saved else {name: float(x) for name, x in trainer.callback_metrics.items()}
    path = saved.path if saved and saved.path and saved.path.is_file() else None
    if path is None and saved and checkpoint is not None:
        path = Path(checkpoint)  # it had been trained for so many steps already
    return Fitted(path, best or None, trainer.global_step, metrics, trainer.log_dir)


def _keep(threads: int | None, trainer: pl.Trainer) -> int | None:
    """Let every checkpoint say with how many threads its training runs: with others, sums round otherwise."""
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, TrainingSettings) and threads is not None:
            callback.settings[THREADS] = threads
    return threads


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """Let processes that are started inside the block print to standard error: output is the report's alone."""
    sys.stdout.flush()
    before = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(before, 1)
        os.close(before)


def _fitted_elsewhere(trainer: pl.Trainer, path: Path) -> Fitted:
    """What the processes of `ddp_spawn` left; of their trainers only the checkpoint and the last metrics are here."""
    checkpoint = load_ckpt(path)
    kept = callback_state(checkpoint, RollingCheckpoint) or {}
    best = callback_state(checkpoint, BestCheckpoint) or {}
    metrics = {**kept.get("metrics", {}), **{name: float(x) for name, x in trainer.callback_metrics.items()}}
    return Fitted(path, best.get("best_model_path") or None, checkpoint["global_step"], metrics, trainer.log_dir)


def _end_processes(trainer: pl.Trainer, signum: int) -> str | None:
    """Pass a signal on to the processes of `ddp_spawn`, and wait until they have saved."""
    launcher: Any = trainer.strategy.launcher
    launcher.kill(signum)
    for process in launcher.procs:
        process.join()
    saved = rolling(trainer)
    path = saved.place(trainer) if saved else None
    return str(path) if path and path.is_file() else None


@contextlib.contextmanager
def resuming(checkpoint: str | Path | None) -> Iterator[None]:
    """Turn what goes wrong while the state in a checkpoint is restored into one sentence; other errors pass.

    Raises:
        UserError: The state is damaged, or another training's.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        frames = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
        restores = any(code.co_name in _RESTORING or code.co_filename.endswith(_CONNECTOR) for code in frames)
        if checkpoint is None or not restores:
            raise
        told = f"{type(error).__name__}: {' '.join(reason(error).split())[:200]}"
        raise UserError(
            f"{checkpoint} cannot be continued, its state is damaged or another training's ({told}): take an earlier "
            "checkpoint, or start from its weights with --model.init_from"
        ) from error


def rolling(trainer: pl.Trainer) -> RollingCheckpoint | None:
    """The trainer's callback that keeps the last checkpoint, if it has one."""
    return next((c for c in trainer.checkpoint_callbacks if isinstance(c, RollingCheckpoint)), None)


@contextlib.contextmanager
def advice_on_memory(trainer: pl.Trainer, module: StageModule, data: Any) -> Iterator[None]:
    """Turn an error of memory into a sentence that says what to make smaller and what is left."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        stage: Stage = get_stage(module.STAGE)
        sizes = f"data.batch_size {data.batch_size} and horizon {data.horizon}"
        saved = rolling(trainer)
        path = saved.path if saved else None
        left = f"; {path} is whole, and --model.init_from={path} starts from it" if path and path.is_file() else ""
        raise UserError(
            f"out of memory at step {trainer.global_step} with {sizes} ({reason(error)}): lower data.batch_size "
            f"first, then {stage.widths}{left}"
        ) from error


@contextlib.contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use `count` threads; None changes nothing."""
    before = torch.get_num_threads()
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def quieten() -> None:
    """Silence what Lightning says at each start, and warnings about choices that were made on purpose."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for text in (
        ".*does not have many workers.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*You're resuming from a checkpoint that ended before the epoch ended.*",
        ".*`IterableDataset` has `__len__` defined.*",
        ".*The number of training batches .* is smaller than the logging interval.*",
        ".*isinstance.treespec, LeafSpec.*",
        ".*module.s. in eval mode at the start of training.*",  # the frozen parts of a fine-tuning
        ".*find_unused_parameters=True was specified.*",
    ):
        warnings.filterwarnings("ignore", message=text)
