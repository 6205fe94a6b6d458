"""Averaged weights: what a decaying learning rate gives at the end of a training, at every moment of it."""

from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from dds_lightning.errors import UserError


class AverageWeights(WeightAveraging):
    """Validate, save and act with an exponential moving average of the weights, while training goes on with its own.

    With a constant learning rate the average is as good as the end of a decay, so a training need not know
    beforehand when it ends. A checkpoint's `state_dict` is the average; what a resumed training needs lies beside it.
    Buffers (statistics, usage of codes) are not averaged, nor are parts of the module that have stopped learning: an
    average of codebook and encoder would lag behind both.

    Args:
        decay: Share of the average that a step keeps; the first steps keep less, (1 + n) / (10 + n) after n. Null
            averages nothing.

    Raises:
        UserError: `decay` outside (0, 1).
    """

    def __init__(self, decay: float | None = None) -> None:
        if decay is not None and not 0.0 < decay < 1.0:
            raise UserError(f"average.decay is {decay}, expected null or a number in (0, 1)")
        self.decay = decay
        self._copied: tuple[str, ...] = ()  # parts whose average is what they are
        super().__init__(use_buffers=False, multi_avg_fn=self._average)

    def _average(self, averages: list[Tensor], weights: list[Tensor], count: Tensor | int) -> None:
        """Move the averages towards the weights after `count` updates."""
        assert self.decay is not None, "without a decay the callback is left out"
        keep = min(self.decay, (1.0 + float(count)) / (10.0 + float(count)))
        torch._foreach_lerp_(averages, weights, 1.0 - keep)

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any, **kwargs: Any) -> None:
        """Move the averages, and take the parts as they are that have just stopped learning."""
        super().on_train_batch_end(trainer, pl_module, *args, **kwargs)
        frozen = getattr(pl_module, "frozen_modules", ())
        if frozen != self._copied and self._average_model is not None:
            self._copied = frozen
            averaged: Any = self._average_model.module
            for name in frozen:
                getattr(averaged, name).load_state_dict(getattr(pl_module, name).state_dict())

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights apart: what is saved now must go on exactly, should it be trained longer."""

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the module with the averaged weights."""
        self._copy_average_to_current(pl_module)

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Go on with both sets of weights."""
        if self._average_model is not None:  # a look at a model needs the average only, which is its state already
            super().on_load_checkpoint(trainer, pl_module, checkpoint)
