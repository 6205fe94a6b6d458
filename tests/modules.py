"""Modules trained for a few steps in this process, and what that did to their weights."""

import warnings

import lightning.pytorch as pl
import torch

from dds_lightning.saving.checkpoint import AtomicCheckpointIO


def fit(module, data, steps, ckpt_path=None, callbacks=()) -> pl.Trainer:
    """Train for some steps without anything that writes or prints; `ckpt_path` resumes."""
    trainer = pl.Trainer(
        max_steps=steps,
        logger=False,
        accelerator="cpu",
        plugins=[AtomicCheckpointIO()],
        callbacks=list(callbacks),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning, module="lightning")
        trainer.fit(module, data, ckpt_path=ckpt_path, weights_only=True)
    return trainer


def state(module) -> dict[str, torch.Tensor]:
    """A copy of the weights."""
    return {name: value.clone() for name, value in module.state_dict().items()}


def changed(before, after, prefix: str = "") -> set[str]:
    """Names of the weights that differ between two states."""
    return {name for name in before if name.startswith(prefix) and not torch.equal(before[name], after[name])}
