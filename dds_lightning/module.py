"""What the modules of all training stages share: checked settings, trainable parts, and their optimiser."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from dds_lightning.errors import UserError
from dds_lightning.finetune import read, refuse_other_box, start_from
from dds_lightning.nn.embedding import EmbeddingMixin
from dds_lightning.nn.normaliser import ActionBox
from dds_lightning.nn.optimiser import Schedule as Schedule
from dds_lightning.nn.optimiser import adam as adam
from dds_lightning.nn.optimiser import learning_rate_factor as learning_rate_factor
from dds_lightning.nn.optimiser import planned_steps as planned_steps
from dds_lightning.nn.ranges import Rule, network_rules
from dds_lightning.saving.checkpoint import STAGE_KEY, load_module
from dds_lightning.saving.fingerprint import digest


class StageModule(EmbeddingMixin, pl.LightningModule):
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
    OF_DECODER: ClassVar[bool] = False
    """Whether it learnt by acting, so that it belongs to the skills' decoder and not only to their codes."""
    OPTIONAL: ClassVar[tuple[str, ...]] = ()
    """Submodules that a checkpoint to start from may lack: then they begin as the data say."""

    action_box: ActionBox  # of modules that see actions
    init_from: str | None = None  # the checkpoint this module started from, in this process
    _held: Mapping[str, Sequence[nn.Parameter]] = MappingProxyType({})  # submodules that stand still, and their weights
    learning: tuple[str, ...] = ()  # what `learning_at` said of the present step
    terms: Mapping[str, Tensor] = MappingProxyType({})  # of the last training step; `FiniteGuard` names the bad ones

    def _refuse(self, rules: Sequence[Rule]) -> None:
        """Refuse settings outside their range; `rules` are (name, whether the value is allowed, what is expected).

        The rules that all stages share come after those.

        Raises:
            UserError: Names the first setting that is not allowed.
        """
        h = self.hparams
        allowed = ", ".join(self.PARTS)
        named = self._named_parts
        parts = bool(named) and (named == ["all"] or set(named) <= set(self.PARTS))
        scales = h.get("lr_scale") or {}
        common = [
            ("lr", h.lr > 0, "positive"),
            ("trainable", parts, f"all or some of {allowed}; several as [A,B]"),
            ("lr_scale", set(scales) <= set(self.PARTS), f"factors for some of {allowed}"),
            ("lr_scale", all(x > 0 for x in scales.values()), "positive factors: freeze parts with trainable"),
        ]
        if parts:
            left = ", ".join(self.trained_parts)
            common.append(("lr_scale", set(scales) <= set(self.trained_parts), f"factors for what is trained: {left}"))
        for name, fine, expected in [*rules, *network_rules(h), *common]:
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
    def skill_hash(self) -> str | None:
        """Fingerprint of the skill model whose codes it chooses; None if it is unknown, or it chooses none."""
        known: str | None = self.hparams.get("skill_hash")
        return known

    @property
    def frozen_modules(self) -> tuple[str, ...]:
        """Names of the submodules that do not learn; a Gaussian bottleneck has no weights and keeps drawing."""
        names = (name for part in self.PARTS if part not in self.trained_parts for name in self.PARTS[part])
        return tuple(dict.fromkeys((*self._with_weights(names), *self._held)))

    def _with_weights(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if any(True for _ in getattr(self, name).parameters())]

    def learning_at(self, step: int) -> tuple[str, ...]:
        """Names of the parts that learn at an optimiser step, in the loss of one whose parts take turns."""
        return self.trained_parts

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Note what learns in this step: a loss that asked for the step itself would be compiled anew for every one."""
        self.learning = self.learning_at(self.global_step)

    def hold(self, names: Sequence[str]) -> None:
        """Let submodules stand still from now on; the others go on learning.

        Args:
            names: All that are held; what was held before and is not named learns again.
        """
        names = self._with_weights(names)
        if names == list(self._held):
            return
        for parameter in (p for held in self._held.values() for p in held):
            parameter.requires_grad_(True)
        self._held = {name: [p for p in getattr(self, name).parameters() if p.requires_grad] for name in names}
        for parameter in (p for held in self._held.values() for p in held):
            parameter.requires_grad_(False)
        self.train(self.training)

    def _begin(self, init_from: str | os.PathLike[str] | None) -> None:
        """Freeze what is not trained and load the weights to start from."""
        self.learning = self.learning_at(0)
        for name in self.frozen_modules:
            getattr(self, name).requires_grad_(False)
        self.train(self.training)  # a Trainer does not change modes
        if init_from is not None:
            self.init_from = str(init_from)
            start_from(self, self.init_from)

    def train(self, mode: bool = True) -> Self:
        """Keep frozen parts in evaluation mode: dropout and running averages would change them."""
        super().train(mode)
        for name in self.frozen_modules:
            getattr(self, name).eval()
        return self

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Take one optimiser step and what belongs to it.

        Not in `on_train_batch_end`, where callbacks run before the module: a checkpoint written by one of them would
        lack what follows the step.
        """
        super().optimizer_step(*args, **kwargs)
        self.after_step(self.global_step + 1)  # Lightning counts the step when this returns

    def after_step(self, step: int) -> None:
        """Update what depends on optimiser step `step`, counted from 1."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say whose checkpoint it is."""
        checkpoint[STAGE_KEY] = self.STAGE

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Forget `init_from`: a training that continues does not start from weights."""
        self.init_from = None

    def refuse_frozen_without_weights(self) -> None:
        """Refuse to train part of a model whose other parts were never trained."""
        if self.frozen_modules and self.init_from is None and not bool(self.normaliser.fitted):
            raise UserError(
                f"model.trainable is {self.hparams.trainable}, but the other parts have random weights: give "
                "--model.init_from=CHECKPOINT, or train all parts"
            )

    def data_statistics(self, names: Sequence[str], remedy: str) -> dict[str, Any]:
        """Statistics of the training data, as the data module computes them.

        Args:
            names: Those that are needed; others are left out.
            remedy: What to do where there are none, for the message.

        Returns:
            Name to value.

        Raises:
            UserError: The data module has no statistics, or lacks one of them.
        """
        datamodule: Any = getattr(self.trainer, "datamodule", None)
        if not hasattr(datamodule, "statistics"):
            raise UserError(f"the {self.STAGE} model has no observation statistics: {remedy} first")
        statistics = datamodule.statistics()
        if missing := [name for name in names if name not in statistics]:
            raise UserError(f"{type(datamodule).__name__}.statistics() lacks {', '.join(missing)}: return these too")
        return {name: statistics[name] for name in names}

    def training_batches(self) -> Iterator[Any]:
        """The training's first batches, from a loader of their own: reading them moves nothing in the training."""
        datamodule: Any = getattr(self.trainer, "datamodule", None)
        if datamodule is None:
            self.trainer.fit_loop.setup_data()  # Lightning would make the loaders later
        loader: Any = datamodule.train_dataloader() if datamodule else self.trainer.train_dataloader
        return iter(loader)

    def fit_units(self) -> None:
        """Take the statistics of observations and actions from the data, unless a checkpoint brought them.

        Raises:
            UserError: There are none, or the data's actions have other bounds than those of the checkpoint.
        """
        if bool(self.normaliser.fitted):
            refuse_other_box(self, getattr(self.trainer, "datamodule", None))
            return
        names = ("observation_mean", "observation_std", "action_low", "action_high")
        remedy = "fit it with a SegmentDataModule, or call normaliser.fit(mean, std) and action_box.fit(low, high)"
        mean, std, low, high = self.data_statistics(names, remedy).values()
        self.normaliser.fit(mean, std)
        self.action_box.fit(low, high)

    def agree(self, part: nn.Module, more: Any = None) -> Any:
        """Give every process of a distributed training the first one's `part`, and what it says beside it."""
        if self.trainer.world_size == 1:
            return more
        state, more = self.trainer.strategy.broadcast((part.state_dict(), more))
        part.load_state_dict(state)
        return more

    def term_of_all(self, name: str) -> Tensor:
        """A term of the last training step; in a distributed training its mean over the processes."""
        if getattr(self.trainer, "world_size", 1) == 1:
            return self.terms[name]
        mean: Tensor = self.trainer.strategy.reduce(self.terms[name].clone(), reduce_op="mean")
        return mean

    def log_training(self, total: Tensor, more: Callable[[], Mapping[str, Tensor]] = dict) -> None:
        """Log a training step's loss and terms, at the steps of `is_log_step`.

        Args:
            total: The loss.
            more: Computes what else to log; not called at other steps.
        """
        if is_log_step(self):
            log = {"loss": total.detach(), **self.terms, **more()}
            self.log_dict({f"train/{name}": value for name, value in log.items()})

    def evaluate(self, batch: dict[str, Tensor], stage: str) -> None:
        """Log how the model does on a held-out batch; `stage` is the prefix of the names, ``val`` or ``test``."""
        raise NotImplementedError(f"{type(self).__name__} has no `evaluate`: write one to validate or test it")

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Log how the model does on a held-out batch."""
        with torch.random.fork_rng():  # the same noise every time: losses differ only by what was learnt
            torch.manual_seed(batch_idx)
            self.evaluate(batch, "val")

    def test_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """As `validation_step`."""
        self.evaluate(batch, "test")

    def configure_optimizers(self) -> Any:
        """Adam over everything that learns together, with a learning rate for each part where `lr_scale` says so."""
        h = self.hparams
        self.hold(())  # since a former training
        parameters: Any = self.parameters()
        if h.get("lr_scale"):
            parameters = [
                {"params": learning, "lr": h.lr * h.lr_scale.get(part, 1.0), "name": part}
                for part in self.trained_parts
                if (learning := [p for n in self.PARTS[part] for p in getattr(self, n).parameters() if p.requires_grad])
            ]
        return adam(parameters, h.lr, h.lr_schedule, h.get("warmup_steps", 0), self)

    def fingerprint(self) -> str:
        """SHA-256 of all weights and buffers with their names: the same for the same model, wherever it is stored."""
        return digest(self.state_dict())

    @classmethod
    def starting_from(cls, path: str | Path, **settings: Any) -> Self:
        """Start a new training from the weights of a checkpoint, with its settings where none are given.

        Args:
            path: `.ckpt` or published directory; the same as `init_from`.
            **settings: Arguments of the constructor. `trainable`, `lr_scale` and `refit_normaliser` are never the
                checkpoint's: they describe how that one was trained.

        Raises:
            UserError: A setting or the checkpoint is not valid.
        """
        fresh = ("trainable", "lr_scale", "refit_normaliser")
        trained = {name: value for name, value in read(cls, str(path)).hparams.items() if name not in fresh}
        return cls(**{**trained, **settings, "init_from": str(path)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load from a Lightning ``.ckpt`` or a published directory, in evaluation mode on the CPU."""
        return load_module(cls, path, part=cls.STAGE)


def is_log_step(module: pl.LightningModule) -> bool:
    """Whether this step is logged, which costs as much as a small step: the first, and those Lightning writes after."""
    every = getattr(module.trainer, "log_every_n_steps", 50)
    return every > 0 and (module.global_step == 0 or (module.global_step + 1) % every == 0)
