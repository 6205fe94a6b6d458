"""Stop before a loss that is not a number reaches the weights."""

from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from dds_lightning.errors import UserError


class FiniteGuard(Callback):
    """Refuse a loss that is NaN or infinite before the backward pass: the weights and the last checkpoint stay good.

    On a CPU every step is checked, which costs nothing. On an accelerator a check waits for the device, so only every
    ``every_n_steps``-th step gets a message; the steps between are checked by an assertion on the device, which stops
    the program as well, but cannot name the term.

    Args:
        every_n_steps: Steps between two checks on an accelerator.
    """

    def __init__(self, every_n_steps: int = 50) -> None:
        if every_n_steps < 1:
            raise UserError(f"finite guard: every_n_steps is {every_n_steps}, expected at least 1")
        self.every_n_steps = every_n_steps

    def on_before_backward(self, trainer: pl.Trainer, pl_module: pl.LightningModule, loss: Tensor) -> None:
        """Check the loss of this step.

        Raises:
            UserError: The loss is not finite; the message names the terms that are not.
        """
        if loss.is_cuda and trainer.global_step % self.every_n_steps:
            torch._assert_async(torch.isfinite(loss).all())
            return
        if bool(torch.isfinite(loss).all()):
            return
        terms: dict[str, Any] = getattr(pl_module, "terms", {})
        bad = [name for name, value in terms.items() if not bool(torch.isfinite(torch.as_tensor(value)).all())]
        blame = f" (not finite: {', '.join(bad)})" if bad else ""
        raise UserError(
            f"step {trainer.global_step}: the loss is {loss.item()}{blame}; the weights were not touched and the last "
            "checkpoint is good. Lower lr, check the data with `dds data check`, or train in 32-bit precision"
        )
