"""The checkpoint with the best value of a metric."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint

from dds_lightning.errors import UserError


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

    Raises:
        UserError: `every_n_steps` is less than 1.
    """

    def __init__(
        self, monitor: str | None = None, mode: Literal["max", "min"] = "max", every_n_steps: int | None = None
    ) -> None:
        if every_n_steps is not None and every_n_steps < 1:
            raise UserError(f"best.every_n_steps is {every_n_steps}, expected at least 1, or null for validations")
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

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from the best so far: its score comes from the state, its place never does.

        Lightning would take the paths of the state as they are, and delete the file or folder that they name when a
        better checkpoint comes.
        """
        score = state_dict.get("best_model_score")
        own = Path(str(self.dirpath), f"{self.filename}{self.FILE_EXTENSION}")
        if not isinstance(score, torch.Tensor) or score.numel() != 1 or not own.is_file():
            return  # nothing to compare with: the first look finds the best so far
        if state_dict.get("dirpath", self.dirpath) != self.dirpath:
            return  # what was best lies elsewhere
        self.best_k_models = {str(own): score}
        self.best_model_path = self.kth_best_model_path = str(own)
        self.best_model_score = self.kth_value = score

    def _remove_checkpoint(self, trainer: pl.Trainer, filepath: str) -> None:
        """Delete nothing: the best checkpoint always has the same name, so a better one replaces it."""

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Check right after the step: at an epoch's end Lightning waits for a validation, and saves later weights."""
        if not self.every_n_steps or trainer.global_step % self.every_n_steps:
            return
        candidates = self._monitor_candidates(trainer)
        if self.monitor in candidates and not self._should_skip_saving_checkpoint(trainer):
            self._save_topk_checkpoint(trainer, candidates)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say so where the metric was never logged: a name that is mistyped, or no validation."""
        super().on_train_end(trainer, pl_module)
        if not self.best_model_path and self.monitor not in trainer.callback_metrics:
            logged = ", ".join(sorted(trainer.callback_metrics)) or "nothing"
            warnings.warn(
                f"best.monitor is {self.monitor}, which was not logged ({logged} was): there is no best checkpoint",
                stacklevel=2,
            )
