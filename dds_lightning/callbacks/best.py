"""The checkpoint with the best value of a metric."""

from typing import Any, Literal

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ModelCheckpoint


class BestCheckpoint(ModelCheckpoint):
    """Also keep the checkpoint with the best value of a logged metric, as `best.ckpt` beside `last.ckpt`.

    Args:
        monitor: name of the metric, e.g. `rollout/score`; null keeps none.
        mode: `max` or `min`.
        every_n_steps: look after every so many optimiser steps; null looks after validations.
    """

    def __init__(
        self, monitor: str | None = None, mode: Literal["max", "min"] = "max", every_n_steps: int | None = None
    ) -> None:
        super().__init__(
            filename="best",
            monitor=monitor,
            mode=mode,
            save_top_k=1,
            enable_version_counter=False,
            every_n_train_steps=every_n_steps,
            save_on_train_epoch_end=False,  # after the validation: `RollingCheckpoint` keeps what this one knows then
        )
        self.every_n_steps = every_n_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Look right after the step: at an epoch's end Lightning waits for a validation, and keeps later weights."""
        if not self.every_n_steps or trainer.global_step % self.every_n_steps:
            return
        candidates = self._monitor_candidates(trainer)
        if self.monitor in candidates and not self._should_skip_saving_checkpoint(trainer):
            self._save_topk_checkpoint(trainer, candidates)
