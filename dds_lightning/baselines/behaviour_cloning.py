"""Behaviour cloning: the flat policy without skills that the method has to beat.

```
 s (B, O) ──► normaliser ──► MLP 2 x 256 ──► tanh ──► action box ──► a (B, A)        squared error
```
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.module import StageModule, is_log_step
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import ActionBox
from dds_lightning.rollout.actors import Acted
from dds_lightning.tasks import Task


class BehaviourCloning(StageModule):
    """Regress the data's actions on its observations.

    A training batch is ``{"observations": (B, H, O), "actions": (B, H, A)}`` in the environment's units;
    each of the B x H steps is one sample.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of the hidden layers.
        lr: Adam's learning rate.
        lr_schedule: ``constant``, or ``cosine`` decay to zero at ``max_steps``.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "clone"
    PARTS: ClassVar = {"network": ("net",)}
    SHAPE = ("hidden_dims", *FOURIER)
    PREDICTION = "action"

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        lr: float = 1e-3,
        lr_schedule: Literal["constant", "cosine"] = "cosine",
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("lr", lr > 0, "a positive number"),
        ]
        self._refuse(rules)
        width = self._make_embedding(self.hparams)
        self.action_box = ActionBox(action_dim)
        self.net = MLP(width, action_dim, hidden_dims)
        self._begin(init_from)

    def unit_actions(self, observations: Tensor) -> Tensor:
        """Return actions (..., A) in [-1, 1] for observations (..., O)."""
        return torch.tanh(self.net(self.embed(observations)))

    def forward(self, observations: Tensor) -> Tensor:
        """Return actions (..., A), in the environment's units and inside its box, for observations (..., O)."""
        return self.action_box.from_unit(self.unit_actions(observations))

    def loss(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the mean squared error in units of half the action box, a scalar."""
        wanted = self.action_box.to_unit(batch["actions"])
        return (self.unit_actions(batch["observations"]) - wanted).square().mean()

    def on_fit_start(self) -> None:
        """Use the data's statistics, unless a checkpoint provided them."""
        self.fit_units()

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Return the loss of one optimiser step."""
        loss = self.loss(batch)
        if is_log_step(self):
            self.log("train/loss", loss.detach())
        return loss

    def evaluate(self, batch: dict[str, Tensor], stage: str) -> None:
        """Log the same loss on held-out episodes."""
        loss = self.loss(batch)
        self.log(f"{stage}/loss", loss, prog_bar=stage == "val", batch_size=len(batch["actions"]), sync_dist=True)

    def predict_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Return actions (B H, A) for the steps of a batch."""
        return self(batch["observations"]).flatten(0, 1)


class CloneActor:
    """A clone as an `Actor`: no skills, no noise, no memory.

    Args:
        module: The trained policy; it is put in evaluation mode and stays on its device.
    """

    def __init__(self, module: BehaviourCloning) -> None:
        self.module = module.eval()

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load the actor of a checkpoint that `fit_clone` wrote.

        Raises:
            UserError: The file is missing, unreadable, or of another kind of model.
        """
        return cls(BehaviourCloning.load(path))

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Does nothing: the actor has no memory."""

    @torch.inference_mode()
    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> Acted:
        """Return actions (n, A) for observations (n, O); see `dds_lightning.rollout.actors.Actor.act`."""
        x = torch.from_numpy(np.ascontiguousarray(observations, dtype=np.float32)).to(self.module.device)
        return Acted(self.module(x).float().cpu().numpy())


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
    """Train the clone as `dds clone fit` does; continues from `last.ckpt` if the directory holds one.

    Args:
        task: The task that the data belong to.
        data: Where the data are, for example `local:DIR`, see `SegmentDataModule`.
        directory: Directory for logs and checkpoint.
        seed: Seed of the weights, the split and the order of batches.
        steps: Number of optimiser steps.
        batch_size: Number of single steps of the data in a batch.
        lr: Initial learning rate.
        hidden_dims: Widths of the hidden layers.
        progress: Whether to show a progress bar.

    Returns:
        The checkpoint, which `CloneActor.load` reads.

    Raises:
        UserError: The data do not fit, or a setting is outside its range.
    """
    from dds_lightning.training.stage_cli import command

    if steps < 1:
        raise UserError(f"steps is {steps}, expected at least 1")
    arguments = ["fit", "--config", "clone.yaml", f"--seed_everything={seed}", f"--data.task={task.name}"]
    arguments += [f"--data.data={data}", f"--data.batch_size={batch_size}", f"--trainer.max_steps={steps}"]
    arguments += [f"--trainer.val_check_interval={min(1000, steps)}", f"--trainer.enable_progress_bar={progress}"]
    arguments += [
        f"--model.lr={lr}",
        f"--model.hidden_dims={list(hidden_dims)}",
        "--trainer.enable_model_summary=false",
    ]
    arguments += [f"--trainer.default_root_dir={directory}", f"--checkpoint.dirpath={directory}"]
    last = Path(directory) / "last.ckpt"
    if last.is_file():
        arguments.append(f"--ckpt_path={last}")
    return Path(command("clone", arguments)().data["checkpoint"])
