"""Exact resuming: Lightning does not save the state of the random streams, so this callback does."""

from __future__ import annotations

import contextlib
import random
import warnings
from collections.abc import Iterator
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback

from dds_lightning.callbacks.several import refuse_other_groups


def rng_state() -> dict[str, Any]:
    """State of the global streams of torch, CUDA, NumPy and Python, as tensors and plain values.

    They are safe to load with `weights_only=True`.
    """
    version, words, gauss = random.getstate()
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [
            str(name),
            torch.from_numpy(np.asarray(keys).astype(np.int64)),
            int(position),
            int(has_gauss),
            float(cached),
        ],
        "python": [version, torch.tensor(words, dtype=torch.int64), gauss],
    }


def set_rng_state(state: dict[str, Any]) -> None:
    """Set the global streams to what `rng_state` returned."""
    torch.set_rng_state(state["torch"].cpu())
    cuda = state["cuda"]
    if len(cuda) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all([stream.cpu() for stream in cuda])
    elif cuda:
        warnings.warn(
            f"the checkpoint has random streams of {len(cuda)} GPUs, here are {torch.cuda.device_count()}: "
            "training continues, but not bit for bit as it would have",
            stacklevel=2,
        )
    name, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((name, keys.cpu().numpy().astype(np.uint32), position, has_gauss, cached))
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words.tolist()), gauss))


@contextlib.contextmanager
def undisturbed(*modules: torch.nn.Module) -> Iterator[None]:
    """Restore the global random streams and each module's train or eval mode afterwards."""
    state = rng_state()
    modes = [(part, part.training) for module in modules for part in module.modules()]
    try:
        yield
    finally:
        for part, mode in modes:
            part.training = mode  # one by one: frozen parts may be in eval mode inside a module that trains
        set_rng_state(state)


class ExactResume(Callback):
    """Save the random streams in every checkpoint and restore them when training continues.

    With a loader that saves its position (`TensorLoader`), a run that was stopped after any step and resumed
    in a new process ends with the same bits as one that never stopped, on a CPU.

    The streams are also put back after each validation. When a checkpoint was written at a step that is
    followed by a validation, Lightning leaves this validation out on resuming; so training must not depend
    on what validation draws.
    """

    def __init__(self) -> None:
        """Start without anything to restore."""
        self._states: list[dict[str, Any]] | None = None
        self._before_validation: dict[str, Any] | None = None

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the streams of every process to the checkpoint."""
        states: list[Any] = [rng_state()]
        if trainer.world_size > 1 and torch.distributed.is_initialized():
            states = [None] * trainer.world_size
            torch.distributed.all_gather_object(states, rng_state())
        checkpoint["rng"] = states

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Keep the streams until training starts: what runs before must not advance them.

        Raises:
            UserError: The checkpoint's counters count something else, see `SeveralUpdates`.
        """
        if trainer.state.fn == "fit":
            refuse_other_groups(trainer, checkpoint)
        self._states = checkpoint.get("rng")

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Restore the streams."""
        states, self._states = self._states, None
        if states is None:
            return
        if len(states) != trainer.world_size:
            warnings.warn(
                f"the checkpoint was made by {len(states)} processes, {trainer.world_size} resume it: "
                "training continues, but not bit for bit as it would have",
                stacklevel=2,
            )
            return
        set_rng_state(states[trainer.global_rank])

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the streams of the training."""
        self._before_validation = rng_state()

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Restore the streams of the training."""
        if self._before_validation is not None:
            set_rng_state(self._before_validation)
            self._before_validation = None
