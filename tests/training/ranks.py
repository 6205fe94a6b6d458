"""A callback that keeps what every process of a distributed training ends with."""

from pathlib import Path

import lightning.pytorch as pl
import torch


class KeepRank(pl.Callback):
    """Write the state of each process's module, at the start and at the end, to `rank-N.pt`."""

    def __init__(self) -> None:
        self.states: list[dict[str, torch.Tensor]] = []

    def _keep(self, module: pl.LightningModule) -> None:
        self.states.append({name: value.clone() for name, value in module.state_dict().items()})

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep what the training starts from: k-means, statistics."""
        self._keep(pl_module)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep what it ends with, and write both."""
        self._keep(pl_module)
        torch.save(self.states, Path(f"rank-{trainer.global_rank}.pt"))
