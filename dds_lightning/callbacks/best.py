"""The checkpoint with the best value of a metric."""

from collections.abc import Mapping
from typing import Any, Literal

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback, ModelCheckpoint


def callback_state(checkpoint: Mapping[str, Any], kind: type[Callback]) -> dict[str, Any] | None:
    """The state that a callback left in a Lightning checkpoint.

    Lightning files it under the callback's `state_key`: the name of its class, for a `ModelCheckpoint` followed by
    its settings, so that a training that continues with another metric does not compare with the old one's best.

    Args:
        checkpoint: As `saving.checkpoint.load_ckpt` reads it.
        kind: Class of the callback.

    Returns:
        What its `state_dict` returned; None if there was no such callback.
    """
    states = checkpoint.get("callbacks", {})
    return next((state for key, state in states.items() if key.partition("{")[0] == kind.__qualname__), None)


class BestCheckpoint(ModelCheckpoint):
    """Also keep the checkpoint with the best value of a logged metric, as `best.ckpt` beside `last.ckpt`.

    Args:
        monitor: Name of the metric, e.g. `rollout/score`; null keeps none.
        mode: `max` or `min`.
        every_n_steps: Optimiser steps between two looks at the metric; null looks after validations.
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
            save_on_train_epoch_end=False,  # but after validation, so that `RollingCheckpoint` saves its state
        )
        self.every_n_steps = every_n_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Check right after the step: at an epoch's end Lightning waits for a validation, and saves later weights."""
        if not self.every_n_steps or trainer.global_step % self.every_n_steps:
            return
        candidates = self._monitor_candidates(trainer)
        if self.monitor in candidates and not self._should_skip_saving_checkpoint(trainer):
            self._save_topk_checkpoint(trainer, candidates)
