"""Take several optimiser steps between two of the Trainer's rounds through its hooks."""

from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from dds_lightning.callbacks.guard import FiniteGuard
from dds_lightning.errors import UserError
from dds_lightning.module import StageModule

KEY = "updates_at_once"
"""Entry of a checkpoint."""


class SeveralUpdates(Callback):
    """Take several optimiser steps for each round of the Trainer, whose hooks cost as much as a small network's step.

    Nothing that is learnt changes by a bit, and every counter goes on counting optimiser steps: the loader hands over
    that many batches at once, in the same order, and the module takes one step for each (Lightning's manual
    optimisation). What the Trainer does after a step (logging, saving, validating, callbacks) it does after each group
    of them, so settings in steps must be multiples of the group.

    Args:
        updates: Optimiser steps of a group.

    Raises:
        UserError: A setting of the training does not go with it; the message names it.
    """

    def __init__(self, updates: int = 10) -> None:
        if updates < 2:
            raise UserError(f"several updates: updates is {updates}, expected at least 2")
        self.updates = updates
        self._validates_every: Any = None

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Take the optimisation over from the Trainer."""
        if stage != "fit":
            return
        self._refuse(trainer, pl_module)
        pl_module.automatic_optimization = False
        self._validates_every = trainer.val_check_interval
        if isinstance(trainer.val_check_interval, int):  # Lightning counts what the loader hands over
            trainer.val_check_interval //= self.updates

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Let the loader hand over groups, and the module step through them."""
        loader: Any = trainer.train_dataloader
        if not hasattr(loader, "group"):
            raise UserError(
                f"several updates: the training batches come from {type(loader).__name__}, expected recorded data from "
                "a data module of this project: leave the callback out"
            )
        loader.group = self.updates
        own: Any = pl_module.training_step
        module: Any = pl_module

        def training_step(batches: list[Any], batch_idx: int) -> None:
            optimizer, scheduler = module.optimizers(), module.lr_schedulers()
            for batch in batches:
                module.learning = module.learning_at(trainer.global_step)
                loss: Tensor = own(batch, batch_idx)
                optimizer.zero_grad()
                module.manual_backward(loss)
                optimizer.step()
                module.after_step(trainer.global_step)
                if scheduler is not None:
                    scheduler.step()
                if trainer.global_step == trainer.max_steps:  # of a `fast_dev_run`
                    break
            # Loggers and `log_every_n_steps` go by this counter, which Lightning raises by one after each group.
            trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step - 1

        pl_module.training_step = training_step  # type: ignore[method-assign]

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Say that Lightning's counters in this checkpoint are of groups."""
        checkpoint[KEY] = self.updates

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Leave module and Trainer as they were."""
        pl_module.__dict__.pop("training_step", None)
        if stage == "fit" and not pl_module.automatic_optimization:
            loop = trainer.fit_loop.epoch_loop
            # `trainer.global_step` reads the one counter or the other.
            loop.automatic_optimization.optim_progress.optimizer.step.total.completed = trainer.global_step
            pl_module.automatic_optimization = True
            trainer.val_check_interval = self._validates_every

    def _refuse(self, trainer: Any, pl_module: pl.LightningModule) -> None:
        if not isinstance(pl_module, StageModule):
            raise UserError(f"several updates: {type(pl_module).__name__} is no module of this project")
        checks = [
            ("trainer.accumulate_grad_batches", trainer.accumulate_grad_batches, trainer.accumulate_grad_batches == 1),
            ("trainer.gradient_clip_val", trainer.gradient_clip_val, trainer.gradient_clip_val is None),
            ("trainer.max_epochs", trainer.max_epochs, trainer.max_epochs in (-1, None) or bool(trainer.fast_dev_run)),
            ("number of processes", trainer.world_size, trainer.world_size == 1),
        ]
        for name, value, fine in checks:
            if not fine:
                raise UserError(f"several updates: {name} is {value}, which does not go with it: leave one of them out")
        steps = {"trainer.log_every_n_steps": trainer.log_every_n_steps}
        if not trainer.fast_dev_run:
            steps["trainer.max_steps"] = trainer.max_steps
        if isinstance(trainer.val_check_interval, int):
            steps["trainer.val_check_interval"] = trainer.val_check_interval
        for callback in trainer.callbacks:
            name = type(callback).__name__
            if getattr(callback, "decay", None):  # it does something at every step
                raise UserError(f"several updates: {name} looks at every step: give its decay as null or 0")
            every = getattr(callback, "every_n_steps", None)
            if isinstance(every, int) and not isinstance(callback, FiniteGuard):  # that one is asked at every step
                steps[f"every_n_steps of {name}"] = every
        for name, value in steps.items():
            if value % self.updates:
                raise UserError(
                    f"several updates: {name} is {value}, expected a multiple of the {self.updates} updates that are "
                    "taken at once"
                )


def refuse_other_groups(trainer: pl.Trainer, checkpoint: dict[str, Any]) -> None:
    """Refuse to go on with a training whose counters in the checkpoint count something else.

    Args:
        trainer: Goes on.
        checkpoint: As it was saved.

    Raises:
        UserError: It took other numbers of updates at once.
    """
    callbacks = (one for one in trainer.callbacks if isinstance(one, SeveralUpdates))  # type: ignore[attr-defined]
    here, there = next((one.updates for one in callbacks), 1), checkpoint.get(KEY, 1)
    if here != there:
        given = "leave SeveralUpdates out" if there == 1 else f"give SeveralUpdates(updates={there})"
        raise UserError(
            f"several updates: the checkpoint's training took {there} at once, this one takes {here}: {given}"
        )
