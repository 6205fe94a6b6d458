"""`dds skill` and `dds policy`: Lightning's command line over our modules, with its traps closed.

- Dimensions come from the data (`data.observation_dim` -> `model.observation_dim`), never from the user.
- `--ckpt_path` continues a training. The settings of the model, of the data and the seed come from the checkpoint;
  naming another value for one of them is refused instead of being ignored.
- A mistake in the data is found before the first file is written.
"""

import logging
import shlex
import signal
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from jsonargparse import ArgumentError, Namespace
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import SIGTERMException

from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.configs import resolve_configs
from dds_lightning.console import interrupts
from dds_lightning.console.reports import Report, table
from dds_lightning.errors import UserError, is_out_of_memory, reason
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.saving.files import short
from dds_lightning.training.trainer import KeptSettings, trainer_settings

DESCRIPTION = {
    "skill": "Stage one: learn discrete skills from segments of trajectories.",
    "policy": "Stage two: learn from relabelled data when to use which skill.",
}
STEPS = {"skill": 500_000, "policy": 1_500_000}  # the paper's, as are the defaults of the modules
LINKS = {
    "skill": ("observation_dim", "action_dim", "horizon"),
    "policy": ("observation_dim", "num_skills", "skill_hash"),
}
PLACES = ("data", "skill", "relabelled", "cache", "device_resident")
"""Settings of the data that say where they are; a training may go on with them elsewhere."""


def modules(stage: str) -> tuple[type[pl.LightningModule], type[pl.LightningDataModule]]:
    """The model and the data of a stage."""
    if stage == "skill":
        from datamodules.segments import SegmentDataModule
        from dds_lightning.skill import SkillModule

        return SkillModule, SegmentDataModule
    from datamodules.relabelled import RelabeledDataModule
    from dds_lightning.policy import PolicyModule

    return PolicyModule, RelabeledDataModule


class StageCLI(LightningCLI):
    """The command line of one stage; `execute` runs the subcommand, so that parsing and work are apart.

    Args:
        stage: `skill` or `policy`.
        words: what follows `dds skill`.
        parse_only: stop after parsing; `config` holds the settings.
    """

    def __init__(self, stage: str, words: Sequence[str], parse_only: bool = False) -> None:
        self.stage = stage
        self.parse_only = parse_only
        self.words = resolve_configs(words)
        self.checkpoint: dict[str, Any] | None = None
        self.result: Report | None = None
        parser = {"exit_on_error": False}
        module, datamodule = modules(stage)
        super().__init__(
            module,
            datamodule,
            args=self.words,
            save_config_kwargs={"overwrite": True},
            seed_everything_default=0,
            trainer_defaults={
                "default_root_dir": f"runs/{stage}",
                "max_epochs": -1,
                "max_steps": STEPS[stage],
            },
            parser_kwargs={
                "prog": f"dds {stage}",
                "description": DESCRIPTION[stage],
                **parser,
                **dict.fromkeys(self.subcommands(), parser),
            },
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,  # our checkpoints name no class to import
        )

    # ---------------------------------------------------------------- the parser

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the checkpoints' settings, `--json`, and the links from data to model."""
        parser.add_lightning_class_args(RollingCheckpoint, "checkpoint")
        parser.add_lightning_class_args(BestCheckpoint, "best")
        parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
        for name in LINKS[self.stage]:
            parser.link_arguments(f"data.{name}", f"model.{name}", apply_on="instantiate")

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's, without `weights_only`: ours is always true, so that no checkpoint can run code."""
        return {name: {*skip, "weights_only"} for name, skip in LightningCLI.subcommands().items()}

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse the words given to us and never those of the process."""
        self.config = parser.parse_args(args)

    def _parse_ckpt_path(self) -> None:
        """Take what shaped the training from the checkpoint, and refuse to contradict it."""
        settings = self.config[self.config.subcommand]
        path = settings.get("ckpt_path")
        if path is None:
            if self.config.subcommand != "fit" and not self.parse_only:
                raise UserError(
                    f"--ckpt_path is missing: `dds {self.stage} {self.config.subcommand}` needs a checkpoint"
                )
            if settings.model.get("init_from") is not None and not self.parse_only:
                self._take_shape(settings.model)
            return
        if settings.model.get("init_from") is not None:
            if any(word.startswith("--model.init_from") for word in self.words):
                raise UserError(
                    f"--ckpt_path is {path} and --model.init_from is {settings.model.init_from}: the first continues "
                    "a training, the second starts a new one from weights; give one of them"
                )
            settings.model.init_from = None  # a file of settings says how the training began that goes on here
        self.checkpoint = load_checkpoint(path, self.stage)
        linked = {f"model.{name}" for name in LINKS[self.stage]}
        trained = {f"model.{name}": value for name, value in self.checkpoint["hyper_parameters"].items()}
        if self.config.subcommand == "fit":  # one may look at a model with other data
            trained |= self.checkpoint.get(KeptSettings.KEY, {})
        chosen = self._chosen()
        for name, value in trained.items():
            if name in chosen and chosen[name] != value:
                raise UserError(
                    f"--{name} is {chosen[name]!r}, but checkpoint {path} was trained with {value!r}, "
                    f"and --ckpt_path continues exactly that training: give --{name}={value}, or train "
                    "anew without --ckpt_path"
                )
            if name not in linked and name in settings:
                settings[name] = value

    def _take_shape(self, model: Namespace) -> None:
        """Take what shapes the network from the checkpoint to start from, save what the user wrote down."""
        from dds_lightning.finetune import read
        from dds_lightning.module import StageModule

        cls: Any = modules(self.stage)[0]
        assert issubclass(cls, StageModule)
        trained, chosen = read(cls, model.init_from).hparams, self._chosen()
        for name in cls.SHAPE:
            if f"model.{name}" not in chosen and name not in LINKS[self.stage]:
                model[name] = trained[name]

    def _chosen(self) -> Namespace:
        """Settings that the user wrote down, on the command line or in a file; no defaults."""
        given: Namespace = self.parser.parse_args(self.words, defaults=False)
        return given[self.config.subcommand]

    # ---------------------------------------------------------------- building

    def _set_seed(self) -> None:
        if not self.parse_only:
            super()._set_seed()

    def instantiate_classes(self) -> None:
        """Build data, model and trainer, unless only the settings were asked for."""
        if self.parse_only:
            return
        super().instantiate_classes()
        trained = (self.checkpoint or {}).get("hyper_parameters", {})
        path = self._get(self.config, "ckpt_path")
        for name in LINKS[self.stage]:
            if trained.get(name) in (None, self.model.hparams[name]):
                continue
            if name == "skill_hash":
                raise UserError(
                    f"checkpoint {path} was trained on the codes of skill model {short(trained[name])}, data.skill "
                    f"{self.datamodule.hparams.skill} is skill model {short(self.model.hparams[name])}: give the "
                    "skill checkpoint that this policy learnt with"
                )
            raise UserError(
                f"checkpoint {path} was trained with {name} {trained[name]}, the data have "
                f"{self.model.hparams[name]}: use a checkpoint and data of the same task"
            )

    def _instantiate_trainer(self, config: dict[str, Any], callbacks: list[pl.Callback]) -> pl.Trainer:
        callbacks = [*callbacks, KeptSettings(self._settings_to_keep())]
        return super()._instantiate_trainer(trainer_settings(dict(config), callbacks), [])

    def _settings_to_keep(self) -> dict[str, Any]:
        """Seed and settings of the data: with the model's own, what a training cannot change on its way."""
        settings = self.config[self.config.subcommand]
        data = {f"data.{name}": value for name, value in settings.data.as_dict().items() if name not in PLACES}
        return {"seed_everything": settings.seed_everything, **data}

    def _run_subcommand(self, subcommand: str) -> None:
        """Wait for `execute`."""

    # ---------------------------------------------------------------- working

    def execute(self) -> Report:
        """Run the subcommand that was parsed."""
        if self.trainer.world_size == 1:
            # Lightning makes its log folder first and looks at the data afterwards.
            self.datamodule.prepare_data()
            self.datamodule.setup(str(self.subcommand))
        if self.subcommand == "fit" and self.checkpoint is None:
            self.model.refuse_frozen_without_weights()
        work: Callable[..., Report] = getattr(self, f"_{self.subcommand}")
        try:
            return work(**self._prepare_subcommand_kwargs(str(self.subcommand)))
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            raise UserError(self._memory_advice(error)) from error

    def _memory_advice(self, error: Exception) -> str:
        """What to make smaller, and what is left."""
        batch = self._get(self.config, "data.batch_size")
        skill = self.stage == "skill"
        horizon = self.model.hparams["horizon"] if skill else self.datamodule.skill.horizon
        wider = "data.horizon or model.hidden_dim" if skill else "model.hidden_dims"
        told = f"out of memory at step {self.trainer.global_step} with data.batch_size {batch} and horizon {horizon}"
        saved = self._rolling.path if self._rolling else None
        left = f"; {saved} is whole, and --model.init_from={saved} starts from it" if saved and saved.is_file() else ""
        return f"{told} ({reason(error)}): lower data.batch_size first, then {wider}{left}"

    @property
    def _rolling(self) -> RollingCheckpoint | None:
        return next((c for c in self.trainer.checkpoint_callbacks if isinstance(c, RollingCheckpoint)), None)

    def _fit(self, **kwargs: Any) -> Report:
        kwargs["weights_only"] = True
        try:
            with interrupts.deferred():
                self.trainer.fit(**kwargs)
        except SIGTERMException:  # before the first step; Lightning would end with status 0
            raise interrupts.Interrupted(signal.SIGTERM) from None
        saved = {
            "checkpoint": self._rolling.path if self._rolling else None,
            "best": next(
                (c.best_model_path for c in self.trainer.checkpoint_callbacks if isinstance(c, BestCheckpoint)),
                None,
            )
            or None,
        }
        data = {
            **saved,
            "steps": self.trainer.global_step,
            "metrics": self._rolling.latest(self.trainer) if self._rolling else _numbers(self.trainer.callback_metrics),
            "logs": self.trainer.log_dir,
        }
        lines: list[Any] = [f"{self.trainer.global_step:,} steps; logs in {self.trainer.log_dir}"]
        lines += [f"{name}: {path}" for name, path in saved.items() if path]
        return Report(data, lines)

    def _validate(self, **kwargs: Any) -> Report:
        return self._look(self.trainer.validate, kwargs)

    def _test(self, **kwargs: Any) -> Report:
        return self._look(self.trainer.test, kwargs)

    def _look(self, method: Callable[..., Any], kwargs: dict[str, Any]) -> Report:
        import pandas as pd

        found = method(**{**kwargs, "verbose": False, "weights_only": True})
        metrics = {name: value for loader in found for name, value in loader.items()}
        rows = pd.DataFrame({"metric": list(metrics), "value": list(metrics.values())})
        return Report({"checkpoint": kwargs["ckpt_path"], "metrics": metrics}, [table(rows, digits=4)])

    def _predict(self, **kwargs: Any) -> Report:
        import pandas as pd

        kwargs |= {"return_predictions": True, "weights_only": True}
        batches: list[Any] = self.trainer.predict(**kwargs) or []
        codes = torch.cat([batch.reshape(-1) for batch in batches]).cpu().numpy()
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir)
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "predictions.parquet"
        pd.DataFrame({"code": codes}).to_parquet(path)
        counts = pd.Series(codes).value_counts().sort_index()
        usage = pd.DataFrame({"code": counts.index, "count": counts.to_numpy()})
        return Report({"file": path, "rows": len(codes), "codes": usage}, [table(usage), str(path)])


def _numbers(metrics: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def load_checkpoint(path: str, stage: str) -> dict[str, Any]:
    """Read a Lightning checkpoint without running code from it.

    Raises:
        UserError: no such file, unreadable, or of another kind of model.
    """
    try:
        checkpoint = load_ckpt(path)
    except UserError as error:
        raise UserError(f"--ckpt_path: {error}") from None
    trained = checkpoint.get("hyper_parameters") or {}
    marks = {"skill": "horizon", "policy": "tau"}
    if marks[stage] not in trained:
        other = next((name for name, mark in marks.items() if mark in trained), "other")
        raise UserError(f"--ckpt_path: {path} is a checkpoint of a {other} model, expected a {stage} model")
    return checkpoint


def quieten() -> None:
    """Silence what Lightning says at each start, and warnings about choices that were made on purpose."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for text in (
        ".*does not have many workers.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*You're resuming from a checkpoint that ended before the epoch ended.*",
        ".*`IterableDataset` has `__len__` defined.*",
        ".*The number of training batches .* is smaller than the logging interval.*",
        ".*isinstance.treespec, LeafSpec.*",
        ".*module.s. in eval mode at the start of training.*",  # the frozen parts of a fine-tuning
    ):
        warnings.filterwarnings("ignore", message=text)


def command(stage: str, words: Sequence[str]) -> Callable[[], Report]:
    """Parse the words after `dds skill` or `dds policy`; the result does the work."""
    quieten()
    if not words:
        words = ["--help"]
    return StageCLI(stage, words).execute


def settings_of(stage: str, words: Sequence[str]) -> dict[str, Any]:
    """All settings of a `fit`, defaults included, as plain values: what `--print_config` prints.

    Raises:
        UserError: words that `dds STAGE fit` does not understand.
    """
    import yaml

    try:
        cli = StageCLI(stage, words, parse_only=True)
    except ArgumentError as error:
        raise UserError(f"dds {stage} fit: {error.message}") from None
    parser = cli._parser(cli.config.subcommand)
    text = parser.dump(cli.config[cli.config.subcommand], skip_unset=False, skip_validation=True)
    return yaml.safe_load(text)


def command_line(stage: str, words: Sequence[str]) -> str:
    """The command a person would type for these words."""
    return shlex.join(["dds", stage, *words])
