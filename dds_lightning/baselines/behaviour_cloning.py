"""Behaviour cloning: the flat policy without skills that the method has to beat.

```
 s (B, O) ──► normaliser ──► MLP 2 x 256 ──► tanh ──► action box ──► a (B, A)        squared error
```
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self

import lightning.pytorch as pl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.module import adam
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import ActionBox, Normaliser
from dds_lightning.tasks import Task

LOG_EVERY = 50
"""Optimiser steps between two logged losses."""


class BehaviourCloning(pl.LightningModule):
    """Regress the data's actions on its observations.

    A training batch is ``{"observations": (B, H, O), "actions": (B, H, A)}`` in the environment's own units;
    each of the B x H steps is one sample.

    Args:
        observation_dim: O.
        action_dim: A.
        hidden_dims: widths of the hidden layers.
        lr: learning rate of Adam.
        lr_schedule: ``constant`` or ``cosine`` decay to zero at ``max_steps``.

    Raises:
        UserError: a setting outside its range; the message names it.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        lr: float = 1e-3,
        lr_schedule: Literal["constant", "cosine"] = "cosine",
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        if lr <= 0:
            raise UserError(f"model.lr is {lr}, expected a positive number")
        if any(width < 1 for width in hidden_dims):
            raise UserError(f"model.hidden_dims is {hidden_dims}, expected widths of at least 1")
        self.save_hyperparameters()
        self.normaliser = Normaliser(observation_dim)
        self.action_box = ActionBox(action_dim)
        self.net = MLP(observation_dim, action_dim, hidden_dims)

    def unit_actions(self, observations: Tensor) -> Tensor:
        """Actions (..., A) in [-1, 1] for observations (..., O)."""
        return torch.tanh(self.net(self.normaliser(observations)))

    def forward(self, observations: Tensor) -> Tensor:
        """Actions (..., A), in the environment's units and inside its box, for observations (..., O)."""
        return self.action_box.from_unit(self.unit_actions(observations))

    def loss(self, batch: dict[str, Tensor]) -> Tensor:
        """Mean squared error in units of half the action box, a scalar."""
        wanted = self.action_box.to_unit(batch["actions"])
        return (self.unit_actions(batch["observations"]) - wanted).square().mean()

    def on_fit_start(self) -> None:
        """Take the data's statistics, unless a checkpoint brought them."""
        if bool(self.normaliser.fitted):
            return
        datamodule = getattr(self.trainer, "datamodule", None)
        if datamodule is None or not hasattr(datamodule, "statistics"):
            raise UserError(
                "the clone has no observation statistics: fit it with a SegmentDataModule, or call "
                "normaliser.fit(mean, std) and action_box.fit(low, high) first"
            )
        statistics = datamodule.statistics()
        self.normaliser.fit(statistics["observation_mean"], statistics["observation_std"])
        self.action_box.fit(statistics["action_low"], statistics["action_high"])

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        loss = self.loss(batch)
        if self.global_step % LOG_EVERY == 0:
            self.log("train/loss", loss.detach())
        return loss

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """The same loss on episodes that were kept aside."""
        self.log("val/loss", self.loss(batch), prog_bar=True, batch_size=len(batch["actions"]))

    def configure_optimizers(self) -> Any:
        """Adam over the network."""
        settings = self.hparams
        return adam(self.parameters(), settings["lr"], settings["lr_schedule"], 0, self)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load from a Lightning ``.ckpt`` or a published directory, in evaluation mode on the CPU."""
        from dds_lightning.saving.checkpoint import load_module

        return load_module(cls, path, part="clone")


class CloneActor:
    """A clone as an `Actor`: no skills, no noise, no memory.

    Args:
        module: the trained policy; it is put in evaluation mode and used where it is.
    """

    def __init__(self, module: BehaviourCloning) -> None:
        self.module = module.eval()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """The actor of a checkpoint that `fit_clone` wrote.

        Raises:
            UserError: no such file, unreadable, or of another kind of model.
        """
        return cls(BehaviourCloning.load(path))

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Nothing to forget."""

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """Actions (n, A) for observations (n, O); see `dds_lightning.rollout.actors.Actor.act`."""
        x = torch.from_numpy(np.ascontiguousarray(observations, dtype=np.float32)).to(self.module.device)
        return self.module(x).float().cpu().numpy()


def fit_clone(
    task: Task,
    data: str,
    directory: str | Path,
    *,
    seed: int = 0,
    steps: int = 4000,
    batch_size: int = 512,
    lr: float = 1e-3,
    hidden_dims: Sequence[int] = (256, 256),
    progress: bool = True,
) -> Path:
    """Train the clone; goes on from `last.ckpt` if the directory holds one.

    Args:
        task: that the data belong to.
        data: as `SegmentDataModule` takes it, for example `local:DIR`.
        directory: where logs and checkpoint go.
        seed: of the weights, the split and the order of batches.
        steps: optimiser steps.
        batch_size: single steps of the data in a batch (segments of horizon 1).
        lr: learning rate at the start.
        hidden_dims: widths of the hidden layers.
        progress: show a progress bar.

    Returns:
        The checkpoint, which `CloneActor.load` reads.

    Raises:
        UserError: data that do not fit, or a setting outside its range.
    """
    from datamodules.segments import SegmentDataModule
    from dds_lightning.callbacks.rolling import RollingCheckpoint
    from dds_lightning.console import interrupts
    from dds_lightning.rollout.play import torch_threads
    from dds_lightning.training.stage_cli import quieten
    from dds_lightning.training.trainer import trainer_settings

    quieten()
    if steps < 1:
        raise UserError(f"steps is {steps}, expected at least 1")
    directory = Path(directory)
    module = SegmentDataModule(task.name, data, horizon=1, batch_size=batch_size, seed=seed)
    module.setup()  # a mistake in the data comes before the first file
    pl.seed_everything(seed, verbose=False)
    clone = BehaviourCloning(task.observation_dim, task.action_dim, hidden_dims, lr)
    settings: dict[str, Any] = {
        "default_root_dir": str(directory),
        "max_epochs": -1,
        "max_steps": steps,
        "devices": 1,
        "check_val_every_n_epoch": None,
        "val_check_interval": min(1000, steps),
        "limit_val_batches": 10,
        "num_sanity_val_steps": 0,
        "log_every_n_steps": LOG_EVERY,
        "enable_model_summary": False,
        "enable_progress_bar": progress,
    }
    saving = RollingCheckpoint(str(directory))
    trainer = pl.Trainer(**trainer_settings(settings, [saving]))
    last = directory / "last.ckpt"
    with interrupts.deferred(), torch_threads(1):
        trainer.fit(clone, module, ckpt_path=last if last.is_file() else None, weights_only=True)
    assert saving.path is not None
    return saving.path
