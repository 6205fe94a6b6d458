"""Averaged weights: much of what a decaying learning rate gives at the end of a training, at every moment of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from dds_lightning.errors import UserError


class AverageWeights(WeightAveraging):
    """Validate, save and act with an exponential moving average of the weights, while training goes on with its own.

    With a constant learning rate the average gives much of what the end of a decay gives, so a training need not know
    beforehand when it ends (`Convergence` lowers the rate then). A checkpoint's `state_dict` is the average; what a
    resumed training needs lies beside it. Buffers (statistics, usage of codes) are not averaged, nor are parts of the
    module that have stopped learning: an average of codebook and encoder would lag behind both.

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
        self._copied: tuple[str, ...] | None = None  # parts whose average is what they are
        self._pairs: tuple[list[Tensor], list[Tensor]] = ([], [])  # averages, and the weights that they follow
        super().__init__(use_buffers=False)

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Copy the module when a fit begins, to the device where the module is about to go."""
        super().setup(trainer, pl_module, stage)
        if stage == "fit" and self._average_model is not None:
            self._average_model.module.to(trainer.strategy.root_device)  # its counter stays: reading it would wait
        self._copied = None

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any, **kwargs: Any) -> None:
        """Move the averages, and take the parts as they are that have just stopped learning.

        `AveragedModel.update_parameters` would collect all weights of both models again in every step, which takes
        longer than averaging them.
        """
        self._update(trainer, pl_module)

    def _update(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Follow the step that was just taken, once."""
        if trainer.global_step <= self._latest_update_step:
            return  # gradients are being accumulated
        self._latest_update_step = trainer.global_step
        copy: Any = self._average_model
        assert self.decay is not None, "without a decay the callback is left out"
        frozen = tuple(getattr(pl_module, "frozen_modules", ()))
        if frozen != self._copied:
            self._follow(copy.module, pl_module, frozen)
        count = int(copy.n_averaged)
        keep = min(self.decay, (1.0 + count) / (10.0 + count)) if count else 0.0
        torch._foreach_lerp_(*self._pairs, 1.0 - keep)
        copy.n_averaged += 1

    def _follow(self, averaged: Any, pl_module: pl.LightningModule, frozen: tuple[str, ...]) -> None:
        """Take frozen parts as they are, and let the averages of all others follow their weights."""
        for name in frozen:
            getattr(averaged, name).load_state_dict(getattr(pl_module, name).state_dict())
        weights = dict(pl_module.named_parameters())
        learning = [name for name in weights if name.partition(".")[0] not in frozen]
        followers = dict(averaged.named_parameters())
        self._pairs = ([followers[name].detach() for name in learning], [weights[name].detach() for name in learning])
        self._copied = frozen

    def _share_buffers(self, pl_module: pl.LightningModule) -> None:
        """Give the copy the buffers as they are now, before anyone sees it."""
        if self._average_model is not None:
            for theirs, ours in zip(self._average_model.module.buffers(), pl_module.buffers(), strict=True):
                theirs.copy_(ours)

    @contextmanager
    def shown(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> Iterator[None]:
        """Give the module the average between two training steps, the one that a checkpoint written now would hold."""
        self._update(trainer, pl_module)
        self._share_buffers(pl_module)
        self._swap_models(pl_module)
        try:
            yield
        finally:
            self._swap_models(pl_module)

    def on_validation_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Validate the average."""
        self._share_buffers(pl_module)
        super().on_validation_epoch_start(trainer, pl_module)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save the average as the module's state, and both sets of weights."""
        self._share_buffers(pl_module)
        super().on_save_checkpoint(trainer, pl_module, checkpoint)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights apart: what is saved now must go on exactly, should it be trained longer."""

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Leave the module with the averaged weights."""
        self._share_buffers(pl_module)
        self._copy_average_to_current(pl_module)

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Go on with both sets of weights."""
        if self._average_model is not None:  # a look at a model needs the average only, which is its state already
            super().on_load_checkpoint(trainer, pl_module, checkpoint)
