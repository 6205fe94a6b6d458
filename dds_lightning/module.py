"""What every training stage's module shares: checked settings, parts that learn, and their optimiser."""

import hashlib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import lightning.pytorch as pl
import torch
from torch import nn

from dds_lightning.errors import UserError
from dds_lightning.finetune import read, start_from
from dds_lightning.nn.normaliser import Normaliser
from dds_lightning.saving.checkpoint import STAGE_KEY, load_module

Schedule = Literal["constant", "cosine"]


class StageModule(pl.LightningModule):
    """A training stage's module: checked settings, a start from weights, Adam by part.

    A subclass calls `save_hyperparameters(ignore=["init_from"])`, builds itself (its observations go through
    `normaliser`), then calls `_begin`. Its settings `lr` and `lr_schedule` are needed; `warmup_steps`, `init_from`,
    `trainable`, `lr_scale` and `refit_normaliser` are understood where it has them.
    """

    hparams: Any  # Lightning gives its settings as attributes, but types them as a mapping
    STAGE: ClassVar[str]
    """Name of its training stage, in every checkpoint, and of the module in a published directory."""
    PARTS: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """What can be frozen or slowed down, and the submodules that belong to it."""
    SHAPE: ClassVar[tuple[str, ...]] = ()
    """Settings in which a checkpoint to start from must agree."""
    PREDICTION: ClassVar[str] = "code"
    """What `predict_step` returns one of for each row."""
    OF_DATA: ClassVar[tuple[str, ...]] = ()
    """Buffers that always come from the data."""

    normaliser: Normaliser
    init_from: str | None = None  # the checkpoint this module started from, in this process

    def _refuse(self, rules: Sequence[tuple[str, bool, str]]) -> None:
        """Refuse settings: (name, whether it is fine, what is expected)."""
        h = self.hparams
        allowed = ", ".join(self.PARTS)
        named = self._named_parts
        parts = bool(named) and (named == ["all"] or set(named) <= set(self.PARTS))
        scales = h.get("lr_scale") or {}
        common = [
            ("trainable", parts, f"all or some of {allowed}"),
            ("lr_scale", set(scales) <= set(self.PARTS), f"factors for some of {allowed}"),
            ("lr_scale", all(x > 0 for x in scales.values()), "positive factors: freeze parts with trainable"),
        ]
        if parts:
            left = ", ".join(self.trained_parts)
            common.append(("lr_scale", set(scales) <= set(self.trained_parts), f"factors for what is trained: {left}"))
        for name, fine, expected in [*rules, *common]:
            if not fine:
                raise UserError(f"model.{name} is {h[name]}, expected {expected}")

    @property
    def trained_parts(self) -> tuple[str, ...]:
        """Names of the parts that learn."""
        named = self._named_parts
        return tuple(part for part in self.PARTS if named == ["all"] or part in named)

    @property
    def _named_parts(self) -> list[str]:
        trainable = self.hparams.get("trainable", "all")
        return [trainable] if isinstance(trainable, str) else list(trainable)

    @property
    def frozen_modules(self) -> tuple[str, ...]:
        """Names of the submodules that do not; a Gaussian bottleneck has nothing to freeze and goes on drawing."""
        names = (name for part in self.PARTS if part not in self.trained_parts for name in self.PARTS[part])
        return tuple(name for name in names if any(True for _ in getattr(self, name).parameters()))

    def _begin(self, init_from: str | os.PathLike[str] | None) -> None:
        """Freeze what is not trained and load the weights to start from."""
        for name in self.frozen_modules:
            getattr(self, name).requires_grad_(False)
        self.train(self.training)  # a Trainer leaves the modes as it finds them
        if init_from is not None:
            self.init_from = str(init_from)
            start_from(self, self.init_from)

    def train(self, mode: bool = True) -> Self:
        """Put frozen parts in evaluation mode always: dropout and running averages would move them."""
        super().train(mode)
        for name in self.frozen_modules:
            getattr(self, name).eval()
        return self

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """One optimiser step and what belongs to it.

        Not in `on_train_batch_end`: callbacks come before the module there, and a checkpoint that one of them
        writes would lack what follows the step.
        """
        super().optimizer_step(*args, **kwargs)
        self.after_step(self.global_step + 1)  # Lightning counts the step when this returns

    def after_step(self, step: int) -> None:
        """Follow up on optimiser step `step`, counted from 1."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say whose checkpoint it is."""
        checkpoint[STAGE_KEY] = self.STAGE

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """A training that goes on does not start from anything."""
        self.init_from = None

    def refuse_frozen_without_weights(self) -> None:
        """Refuse to train part of a model whose rest nobody ever trained."""
        if self.frozen_modules and self.init_from is None and not bool(self.normaliser.fitted):
            raise UserError(
                f"model.trainable is {self.hparams.trainable}, but the rest has only random weights: give "
                "--model.init_from=CHECKPOINT, or train all of it"
            )

    def configure_optimizers(self) -> Any:
        """Adam over everything that learns together, with a learning rate for each part where `lr_scale` says so."""
        h = self.hparams
        parameters: Any = self.parameters()
        if h.get("lr_scale"):
            parameters = [
                {"params": own, "lr": h.lr * h.lr_scale.get(part, 1.0), "name": part}
                for part in self.trained_parts
                if (own := [p for n in self.PARTS[part] for p in getattr(self, n).parameters() if p.requires_grad])
            ]
        return adam(parameters, h.lr, h.lr_schedule, h.get("warmup_steps", 0), self)

    def fingerprint(self) -> str:
        """SHA-256 of all weights and buffers with their names: the same for the same model, wherever it lies."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    @classmethod
    def starting_from(cls, path: str | Path, **settings: Any) -> Self:
        """A new training that starts from the weights of a checkpoint, with its settings where none are given.

        Args:
            path: `.ckpt` or published directory; the same as `init_from`.
            **settings: arguments of the constructor. `trainable`, `lr_scale` and `refit_normaliser` are never the
                checkpoint's: they say how that one was made.

        Raises:
            UserError: as from the constructor.
        """
        anew = ("trainable", "lr_scale", "refit_normaliser")
        trained = {name: value for name, value in read(cls, str(path)).hparams.items() if name not in anew}
        return cls(**{**trained, **settings, "init_from": str(path)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load from a Lightning ``.ckpt`` or a published directory, in evaluation mode on the CPU."""
        return load_module(cls, path, part=cls.STAGE)


def learning_rate_factor(step: int, schedule: Schedule, warmup_steps: int, max_steps: int) -> float:
    """Factor on the learning rate at ``step``: linear warm-up, then 1 or half a cosine down to 0 at ``max_steps``."""
    if step < warmup_steps:
        return (step + 1) / warmup_steps
    if schedule == "constant" or max_steps <= warmup_steps:
        return 1.0
    progress = min(1.0, (step - warmup_steps) / (max_steps - warmup_steps))
    return 0.5 * (1.0 + math.cos(math.pi * progress))


def adam(
    parameters: Iterable[nn.Parameter | dict[str, Any]],
    lr: float,
    schedule: Schedule,
    warmup_steps: int,
    module: pl.LightningModule,
) -> Any:
    """Build Adam in the form Lightning expects, over parameters or over groups of them with rates of their own.

    Reads ``trainer.max_steps`` only: ``estimated_stepping_batches`` builds the loaders early and breaks resuming.
    """
    learning: list[Any] = [p for p in parameters if isinstance(p, dict) or p.requires_grad]
    # One fused kernel instead of ten small operations a tensor: 12.4 ms a policy step instead of 14.5 on two CPU cores.
    tensors = [p for group in learning for p in (group["params"] if isinstance(group, dict) else [group])]
    fused = all(p.device.type in ("cpu", "cuda") for p in tensors)
    optimizer = torch.optim.Adam(learning, lr=lr, fused=fused)
    if schedule == "constant" and warmup_steps == 0:
        return optimizer
    max_steps = module.trainer.max_steps

    def factor(step: int) -> float:
        return learning_rate_factor(step, schedule, warmup_steps, max_steps)

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def is_log_step(module: pl.LightningModule) -> bool:
    """Whether this step is logged: `log_dict` at every step of a small network costs as much as the step."""
    every = getattr(module.trainer, "log_every_n_steps", 50)
    return module.global_step % max(every, 1) == 0
