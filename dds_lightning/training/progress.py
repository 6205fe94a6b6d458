"""One line of progress for a whole training: steps, time left, speed and the last logged numbers."""

import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ProgressBar

from dds_lightning.console.progress import progress_bar
from dds_lightning.module import planned_steps
from dds_lightning.saving.run_directory import duration


class StepProgress(ProgressBar):
    """Count optimiser steps towards the end of the training, across epochs.

    Lightning's bars count the batches of an epoch, but here a training is measured in optimiser steps. On a terminal
    the line is redrawn a few times a second; in a log file a line is written every minute. Metrics are read only
    then, so that a step never waits for the device.

    Args:
        metrics: Names of the metrics to show, if they were logged; a leading `train/` is dropped.
        log_every_n_seconds: Seconds between two lines where standard error is not a terminal.
    """

    def __init__(
        self,
        metrics: tuple[str, ...] = (
            *("train/loss", "val/loss", "val/codes_used", "rollout/success"),
            *("online/env_steps", "online/return", "online/success"),
        ),
        log_every_n_seconds: float = 60.0,
    ) -> None:
        super().__init__()
        self.metrics = metrics
        self.log_every_n_seconds = log_every_n_seconds
        self._bar = ExitStack()
        self._update: Callable[..., None] | None = None
        self._enabled = True
        self._next = self._started = 0.0
        self._first_step, self._last_step = 0, -1

    def disable(self) -> None:
        """Show nothing."""
        self._enabled = False

    def enable(self) -> None:
        """Show again."""
        self._enabled = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start counting."""
        self._started, self._first_step = time.monotonic(), trainer.global_step
        self._last_step = planned_steps(trainer)
        self._next = self._started + (0 if self._terminal else self.log_every_n_seconds)
        if self._enabled and self._terminal and trainer.is_global_zero:
            layout = ("  step", "bar", "count", "remaining", "{task.fields[facts]}")
            total = self._last_step if self._last_step > 0 else None
            bar = progress_bar(layout, total, completed=trainer.global_step, facts="")
            self._update = self._bar.enter_context(bar)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Redraw when it is time."""
        now = time.monotonic()
        if now < self._next or not self._enabled or not trainer.is_global_zero:
            return
        step = trainer.global_step
        rate = (step - self._first_step) / max(now - self._started, 1e-9)
        facts = f"{rate:,.0f} steps/s  " + self._facts(trainer.callback_metrics)
        if self._update is not None:
            self._update(completed=step, facts=facts)
            self._next = now + 0.3
            return
        left = f", {duration((self._last_step - step) / max(rate, 1e-9))} left" if self._last_step > 0 else ""
        print(f"  step {step:,}{left}  {facts}", file=sys.stderr, flush=True)
        self._next = now + self.log_every_n_seconds

    def _facts(self, logged: Mapping[str, Any]) -> str:
        shown = [(name, logged[name]) for name in self.metrics if name in logged]
        return "  ".join(f"{name.removeprefix('train/')} {float(value):.4g}" for name, value in shown)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Remove the line."""
        self._close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Remove the line before the message appears."""
        self._close()

    def _close(self) -> None:
        self._bar.close()
        self._update = None

    @property
    def _terminal(self) -> bool:
        return sys.stderr.isatty()
