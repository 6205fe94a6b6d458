"""Fine-tuning: start from the weights of a checkpoint, train some parts of them, each at its own rate.

`init_from` starts a *new* training from weights; continuing an old one exactly is Lightning's `ckpt_path`, and the
two never mix. The starting checkpoint is read when the module is made and is no part of its settings: what the
training saves loads without it, and resumes without it.

- Settings that shape the network must be the checkpoint's (`SHAPE` of each module); the command line takes those that
  are not given from it. Observations and actions may have other dimensions: then only what fits is loaded, and a
  warning lists what was not.
- The statistics of observations and actions are the checkpoint's if all of them fit, otherwise the new data's. Ask for
  the new data's with `refit_normaliser`.
- Parts that are not `trainable` do not change by a bit: no gradient, no dropout, no running averages, no restart of
  dead codes. A frozen part that does not fit is refused: it would stay random.
- What a policy keeps of its data beside that, support of the codes and range of values, is always the new data's.
"""

import hashlib
import logging
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import lightning.pytorch as pl
import torch
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.files import short
from dds_lightning.nn.normaliser import Normaliser
from dds_lightning.optim import adam

log = logging.getLogger(__name__)

STATISTICS = ("normaliser.", "action_box.")
"""Buffers that hold statistics; loaded together or not at all."""


class StageModule(pl.LightningModule):
    """What the skill model and the policy share: checked settings, a start from weights, Adam by part.

    A subclass calls `save_hyperparameters(ignore=["init_from"])`, builds itself, then calls `_begin`.
    """

    hparams: Any  # Lightning gives its settings as attributes, but types them as a mapping
    STAGE: ClassVar[str]
    """Name of the module in a published directory."""
    PARTS: ClassVar[Mapping[str, tuple[str, ...]]]
    """What can be frozen or slowed down, and the submodules that belong to it."""
    SHAPE: ClassVar[tuple[str, ...]]
    """Settings in which a checkpoint to start from must agree."""
    OF_DATA: ClassVar[tuple[str, ...]] = ()
    """Buffers that always come from the data."""

    normaliser: Normaliser
    init_from: str | None = None  # the checkpoint this module started from, in this process

    def _refuse(self, rules: Sequence[tuple[str, bool, str]]) -> None:
        """Refuse settings: (name, whether it is fine, what is expected)."""
        h = self.hparams
        allowed = ", ".join(self.PARTS)
        named = [h.trainable] if isinstance(h.trainable, str) else list(h.trainable)
        parts = bool(named) and (named == ["all"] or set(named) <= set(self.PARTS))
        scales = h.lr_scale or {}
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
        trainable = self.hparams.trainable
        named = [trainable] if isinstance(trainable, str) else trainable
        return tuple(part for part in self.PARTS if named == ["all"] or part in named)

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
        if h.lr_scale:
            parameters = [
                {"params": own, "lr": h.lr * h.lr_scale.get(part, 1.0), "name": part}
                for part in self.trained_parts
                if (own := [p for n in self.PARTS[part] for p in getattr(self, n).parameters() if p.requires_grad])
            ]
        return adam(parameters, h.lr, h.lr_schedule, h.warmup_steps, self)

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
        from dds_lightning.checkpointing import load_module

        return load_module(cls, path, part=cls.STAGE)


def read(cls: type[StageModule], path: str) -> StageModule:
    """The module in a checkpoint, read without running anything; the random streams stay where they are.

    Raises:
        UserError: it is missing, damaged, or of another kind.
    """
    try:
        with torch.random.fork_rng(devices=[]):
            return cls.load(path)
    except UserError as error:
        expected = f"expected a .ckpt or a published directory of a {cls.STAGE} model"
        raise UserError(f"model.init_from is {path}, {expected}: {error}") from None


def start_from(module: StageModule, path: str) -> None:
    """Load everything that fits from the checkpoint at `path`, and warn of what does not.

    Raises:
        UserError: the checkpoint is missing, damaged, of another kind or of another shape, or a frozen part of
            `module` does not fit it.
    """
    source = read(type(module), path)
    if not bool(source.normaliser.fitted):
        raise UserError(f"model.init_from: {path} was saved before its training began: give a trained checkpoint")
    refuse_other_shape(module, source, path)
    refuse_other_skills(module, source, path)
    own, theirs = module.state_dict(), source.state_dict()
    if "bottleneck.ema_sum" in own and "bottleneck.ema_sum" not in theirs:
        # Running averages begin at the vectors, or the first step would throw them back to random ones.
        theirs["bottleneck.ema_sum"] = theirs["bottleneck.vectors"].clone()
        theirs["bottleneck.ema_count"] = torch.ones_like(own["bottleneck.ema_count"])
    misfits = [name for name, value in own.items() if name not in theirs or theirs[name].shape != value.shape]
    left = {name for name in own if name in module.OF_DATA}
    if module.hparams.refit_normaliser or any(name.startswith(STATISTICS) for name in misfits):
        left |= {name for name in own if name.startswith(STATISTICS)}
    frozen = tuple(f"{name}." for name in module.frozen_modules)
    _refuse_random(module, [name for name in misfits if name.startswith(frozen)], path)
    used = [name for name in module.frozen_modules if name != "bottleneck"]  # codes are no observations
    if used and module.hparams.refit_normaliser:
        raise UserError(
            f"model.refit_normaliser is True, but what is frozen ({', '.join(used)}) expects the statistics it was "
            "trained with: leave it false, or train all of it"
        )
    loaded = {name: theirs[name] for name in own if name not in left and name not in misfits}
    for name, value in loaded.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise UserError(f"model.init_from: {path} holds numbers in {name} that are not finite: take an earlier one")
    module.load_state_dict(loaded, strict=False)
    log.info("started from %s: %d of %d tensors", path, len(loaded), len(own))
    if misfits:
        listed = "; ".join(f"{name} {_shapes(theirs.get(name), own[name])}" for name in misfits)
        warnings.warn(
            f"model.init_from: {path} fits in {len(loaded)} of {len(own)} tensors; these start anew (shape there, "
            f"here): {listed}",
            stacklevel=2,
        )


def refuse_other_shape(module: StageModule, source: StageModule, path: str) -> None:
    """Name every setting that shapes the network and differs between the two."""
    there, here = dict(source.hparams), dict(module.hparams)
    other = [name for name in module.SHAPE if _plain(there[name]) != _plain(here[name])]
    if other:
        found = ", ".join(f"model.{name} is {_plain(here[name])}" for name in other)
        was = ", ".join(f"{_plain(there[name])}" for name in other)
        remedy = " ".join(
            f"--{'data' if name == 'horizon' else 'model'}.{name}={_plain(there[name])}" for name in other
        )
        if "num_skills" in other and module.STAGE == "policy":
            remedy = "relabel with the skill model of that policy (data.skill)"
        raise UserError(f"{found}, but model.init_from {path} was trained with {was}: give {remedy}, or start anew")


def refuse_other_skills(module: StageModule, source: StageModule, path: str) -> None:
    """Refuse a policy that chose among the codes of another skill model: the same numbers mean other skills there."""
    there, here = (one.hparams.get("skill_hash") for one in (source, module))
    if there and here and there != here:
        raise UserError(
            f"data.skill is skill model {short(here)}, but model.init_from {path} was trained on the codes of skill "
            f"model {short(there)}: give that one as data.skill, or start anew"
        )


def refuse_other_box(module: Any, datamodule: Any) -> None:
    """After a start from a checkpoint, refuse data whose actions have other bounds than those that were kept."""
    if module.init_from is None or not hasattr(datamodule, "statistics"):
        return
    box, statistics = module.action_box, datamodule.statistics()
    for name, kept in (("low", box.low), ("high", box.high)):
        found = statistics[f"action_{name}"].to(kept)
        if not torch.equal(found, kept):
            raise UserError(
                f"the data's actions have {name} bounds {found.tolist()}, those of model.init_from "
                f"{module.init_from} have {kept.tolist()}: give --model.refit_normaliser=true, or data of that robot"
            )


def _refuse_random(module: StageModule, names: Sequence[str], path: str) -> None:
    if names:
        parts = [p for p, modules in module.PARTS.items() if {n.split(".")[0] for n in names} & set(modules)]
        raise UserError(
            f"model.trainable is {module.hparams.trainable}, but {', '.join(names)} of {path} does not fit, and frozen "
            f"it would stay random: train {' and '.join(parts)} too"
        )


def _shapes(there: Tensor | None, here: Tensor) -> str:
    return f"{'none' if there is None else tuple(there.shape)}, {tuple(here.shape)}"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, (list, tuple)) else value
