"""`dds STAGE`: Lightning's command line over a stage's module and data, with its traps closed.

- Dimensions come from the data (`data.observation_dim` -> `model.observation_dim`), never from the user.
- `--ckpt_path` continues a training. The settings of the model, of the data and the seed come from the checkpoint;
  giving another value for one of them is refused instead of being ignored.
- `data.seed` follows `--seed_everything` unless it is given.
- A mistake in the data is found before the first file is written.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from jsonargparse import ArgumentError, Namespace
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.strategies import DDPStrategy

from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.convergence import Convergence
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.configs import resolve_configs
from dds_lightning.console.arguments import as_lists, list_options, without_files
from dds_lightning.console.refusals import as_user_errors, sentence
from dds_lightning.console.reports import Report, table
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.saving.fingerprint import same, told_apart
from dds_lightning.saving.untrusted import mapping, parse_yaml
from dds_lightning.tasks.own import is_address
from dds_lightning.training.fit import advice_on_memory, fit, quieten
from dds_lightning.training.monitors import refuse_unlogged
from dds_lightning.training.precision import OVERRULED, settle_precision
from dds_lightning.training.resuming import (
    expand_paths,
    load_checkpoint,
    named_checkpoint,
    refuse_conflicts,
    requeued_checkpoint,
    take_shape,
)
from dds_lightning.training.stages import STARTS, get_stage
from dds_lightning.training.threads import HELP, refuse_threads
from dds_lightning.training.trainer import THREADS, TrainingSettings, log_places, trainer_settings, trial_trainer

PLACES = ("data", "skill", "relabelled", "cache", "device_resident")
"""Settings of the data that say where they are; a training may go on with them elsewhere."""


class StageCLI(LightningCLI):
    """The command line of one stage. Making one parses; `build` makes the objects; `execute` runs the subcommand.

    Args:
        stage: Name of a registered stage.
        arguments: What follows `dds STAGE`.
        parse_only: Only the settings are wanted: no checkpoint is read to complete them.
    """

    def __init__(self, stage: str, arguments: Sequence[str], parse_only: bool = False) -> None:
        self.stage = get_stage(stage)
        self.parse_only = parse_only
        lists = list_options(self.stage.module_class(), "model.") | list_options(self.stage.data_class(), "data.")
        self.arguments = as_lists(resolve_configs(arguments), lists)
        self.checkpoint: dict[str, Any] | None = None
        self.measured_precision: str | None = None
        try:
            self._parse({"exit_on_error": False})
        except ArgumentError as error:
            told, command = sentence(error.message), f"dds {stage} {next(iter(arguments), 'fit')} --help"
            raise UserError(f"{told} (see `{command}{' trainer' * told.startswith('trainer')}`)") from None

    def _parse(self, parser: dict[str, Any]) -> None:
        """Let Lightning make its parser and parse."""
        super().__init__(
            self.stage.module_class(),
            self.stage.data_class(),
            args=self.arguments,
            save_config_kwargs={"overwrite": True},
            seed_everything_default=0,
            trainer_defaults={
                "default_root_dir": f"runs/{self.stage.name}",
                "max_epochs": -1,
                "max_steps": self.stage.steps,
            },
            parser_kwargs={
                "prog": f"dds {self.stage.name}",
                "description": self.stage.description,
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
        parser.add_lightning_class_args(AverageWeights, "average")
        parser.add_lightning_class_args(Convergence, "stop")
        parser.add_argument("--precision", type=Literal["auto"] | None, default=None, help=OVERRULED)
        parser.add_argument("--threads", type=int | None, default=None, help=HELP)
        parser.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
        for name in self.stage.links:
            parser.link_arguments(f"data.{name}", f"model.{name}", apply_on="instantiate")

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's, without `weights_only`: ours is always true, so that no checkpoint can run code."""
        return {name: {*skip, "weights_only"} for name, skip in LightningCLI.subcommands().items()}

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse the arguments given to us and never those of the process."""
        self.config = parser.parse_args(args)
        expand_paths(self.settings)
        data = self.settings.data
        refuse_threads(self.settings.threads)
        refuse_seed("--seed_everything", int(self.settings.seed_everything))
        if "seed" in data:
            data.seed = int(self.settings.seed_everything) if data.seed is None else data.seed
            refuse_seed("data.seed", data.seed)

    @property
    def settings(self) -> Namespace:
        """The settings of the subcommand; what is changed here before `build` counts."""
        chosen: Namespace = self.config[self.config.subcommand]
        return chosen

    def dump(self) -> dict[str, Any]:
        """All settings, defaults included, as plain values: what `--print_config` prints."""
        parser = self._parser(self.config.subcommand)
        return mapping(parse_yaml(parser.dump(self.settings, skip_unset=False, skip_validation=True), "dump"), "dump")

    def _parse_ckpt_path(self) -> None:
        """Complete the settings from the checkpoint that is named, if one is."""
        settings = self.settings
        if settings.get("ckpt_path") is not None:
            self.resume(named_checkpoint(str(settings.ckpt_path), settings))
        elif self.config.subcommand != "fit" and not self.parse_only:
            raise UserError(
                f"--ckpt_path is missing: `dds {self.stage.name} {self.config.subcommand}` needs a checkpoint"
            )
        elif settings.model.get("init_from") is not None and not self.parse_only:
            take_shape(self.stage, settings.model, self._chosen(typed=True))

    def resume(self, path: str | Path) -> None:
        """Go on from a checkpoint: what shaped its training comes from it, and contradictions are refused.

        Raises:
            UserError: It cannot be read, is another stage's, or was trained with settings other than those given.
        """
        settings = self.settings
        for name in (name for name in STARTS if settings.model.get(name) is not None):
            if any(argument.startswith(f"--model.{name}") for argument in self.arguments):
                raise UserError(
                    f"--ckpt_path is {path} and --model.{name} is {settings.model[name]}: the first continues a "
                    "training, the second starts a new one from weights; give one of them"
                )
            settings.model[name] = None  # a file of settings says how the training began that goes on here
        settings.ckpt_path = str(path)
        self.checkpoint = load_checkpoint(str(path), self.stage.name)
        trained = {f"model.{name}": value for name, value in self.checkpoint["hyper_parameters"].items()}
        if self.config.subcommand == "fit":  # one may look at a model with other data
            trained |= self.checkpoint.get(TrainingSettings.KEY, {})
        chosen = self._chosen()
        if (threads := trained.pop(THREADS, None)) is not None and THREADS not in chosen:
            settings[THREADS] = min(int(threads), torch.get_num_threads())
        task = trained.get("data.task")
        if task and is_address(task) and "data.task" not in chosen:  # a file decides neither what is opened nor run
            raise UserError(f"checkpoint {path} was trained for task {task}: give --data.task={task} again")
        refuse_conflicts(trained, chosen, path)
        for name, value in trained.items():
            if name.removeprefix("model.") not in self.stage.links and name in settings:
                settings[name] = value

    def _chosen(self, typed: bool = False) -> Namespace:
        """Settings that the user gave, on the command line or, unless only what was typed counts, in a file."""
        words = without_files(self.arguments) if typed else self.arguments
        given: Namespace = self.parser.parse_args(words, defaults=False)
        return given[self.config.subcommand]

    # ---------------------------------------------------------------- building

    def _set_seed(self) -> None:
        """Wait for `build`."""

    def instantiate_classes(self) -> None:
        """Wait for `build`."""

    def _run_subcommand(self, subcommand: str) -> None:
        """Wait for `execute`."""

    def build(self) -> "StageCLI":
        """Seed everything, then make data, model and trainer.

        Raises:
            UserError: They do not fit each other, or the checkpoint.
        """
        if self.config.subcommand == "fit":
            refuse_unlogged(self.stage, self.settings)
            if requeued := requeued_checkpoint(self.settings):
                self.resume(requeued)
        self.measured_precision = settle_precision(self.settings)
        with as_user_errors(self.arguments):
            super()._set_seed()
            super().instantiate_classes()
        trained = (self.checkpoint or {}).get("hyper_parameters", {})
        path = self.settings.get("ckpt_path")
        for name in self.stage.links:
            was, found = trained.get(name), self.model.hparams[name]
            if was in (None, found):
                continue
            if name == "skill_hash" and found is not None:
                if same(was, found, self.model.OF_DECODER):
                    continue
                there, here = told_apart(was, found)
                raise UserError(
                    f"checkpoint {path} was trained on the codes of skill model {there}, data.skill "
                    f"{self.datamodule.hparams.skill} is skill model {here}: give the skill checkpoint that this "
                    "policy learnt with"
                )
            raise UserError(
                f"checkpoint {path} was trained with {name} {was}, the data have {found}: use a checkpoint and data of "
                "the same task"
            )
        return self

    def trial_trainer(self) -> pl.Trainer:
        """Make the Trainer alone: what it refuses is found before data and skills are made.

        Raises:
            UserError: Settings of the Trainer, a logger or a callback that cannot work.
        """
        refuse_unlogged(self.stage, self.settings)
        with as_user_errors(self.arguments):
            return trial_trainer(self.settings.trainer)

    def _instantiate_trainer(self, config: dict[str, Any], callbacks: list[pl.Callback]) -> pl.Trainer:
        callbacks = [*callbacks, TrainingSettings(self._settings_to_keep())]
        trainer: pl.Trainer = super()._instantiate_trainer(trainer_settings(dict(config), callbacks), [])
        h = self.model.hparams  # first the critic, then the actor; the prior, then the critic; all, then the decoder
        alternates = h.get("extraction") == "after" or bool(h.get("prior_steps") or h.get("freeze_codes_after"))
        if alternates and isinstance(trainer.strategy, DDPStrategy):
            trainer.strategy._ddp_kwargs.setdefault("find_unused_parameters", True)
        return trainer

    def _settings_to_keep(self) -> dict[str, Any]:
        """Seed and settings of the data: with the model's own, what a training cannot change on its way."""
        data = {f"data.{name}": value for name, value in self.settings.data.as_dict().items() if name not in PLACES}
        chosen = {"trainer.precision": self.measured_precision} if self.measured_precision else {}
        return {"seed_everything": self.settings.seed_everything, **data, **chosen}

    # ---------------------------------------------------------------- working

    def execute(self) -> Report:
        """Run the subcommand that was parsed.

        Raises:
            UserError: Something that Lightning, the data or the checkpoint refuse.
        """
        with as_user_errors(self.arguments):
            report = self._execute()
        # Of several processes the first one speaks for all.
        return report if self.trainer.is_global_zero else Report(None, silent=True)

    def _execute(self) -> Report:
        if self.trainer.world_size == 1:
            # Lightning makes its log folder first and looks at the data afterwards.
            self.datamodule.trainer = self.trainer
            self.datamodule.prepare_data()
            self.datamodule.setup(str(self.subcommand))
        if self.subcommand == "fit":
            return self._fit()
        work: Callable[..., Report] = getattr(self, f"_{self.subcommand}")
        with advice_on_memory(self.trainer, self.model, self.datamodule):
            return work(**self._prepare_subcommand_kwargs(str(self.subcommand)))

    def _fit(self) -> Report:
        made = fit(self.trainer, self.model, self.datamodule, self.settings.get("ckpt_path"), self.settings.threads)
        saved = {"checkpoint": made.checkpoint, "best": made.best}
        lines: list[Any] = [f"{made.steps:,} steps; logs in {log_places(self.trainer)}"]
        if self.checkpoint is not None and 0 <= self.trainer.max_steps <= self.checkpoint["global_step"]:
            given = f"trainer.max_steps is {self.trainer.max_steps}: give a greater one to train on"
            lines = [f"the checkpoint was trained for {made.steps:,} steps already, and {given}"]
        lines += [f"{name}: {path}" for name, path in saved.items() if path]
        stops = [one for one in self.trainer.callbacks if isinstance(one, Convergence)]  # type: ignore[attr-defined]
        lines += [remark for callback in stops if (remark := callback.remark())]
        return Report({**saved, "steps": made.steps, "metrics": made.metrics, "logs": made.logs}, lines)

    def _validate(self, **kwargs: Any) -> Report:
        return self._look(self.trainer.validate, kwargs)

    def _test(self, **kwargs: Any) -> Report:
        return self._look(self.trainer.test, kwargs)

    def _look(self, method: Callable[..., Any], kwargs: dict[str, Any]) -> Report:
        import pandas as pd

        logged = method(**{**kwargs, "verbose": False, "weights_only": True})
        metrics = {name: value for loader in logged for name, value in loader.items()}
        rows = pd.DataFrame({"metric": list(metrics), "value": list(metrics.values())})
        return Report({"checkpoint": kwargs["ckpt_path"], "metrics": metrics}, [table(rows, digits=4)])

    def _predict(self, **kwargs: Any) -> Report:
        import pandas as pd

        kwargs |= {"return_predictions": True, "weights_only": True}
        batches: list[Any] = self.trainer.predict(**kwargs) or []
        values = torch.cat(batches).cpu().numpy()  # (N,) or (N, columns)
        folder = Path(self.trainer.log_dir or self.trainer.default_root_dir)
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "predictions.parquet"
        name = self.model.PREDICTION
        columns = [name] if values.ndim == 1 else [f"{name} {j}" for j in range(values.shape[1])]
        pd.DataFrame(values, columns=columns).to_parquet(path)
        if name != "code":
            return Report({"file": path, "rows": len(values)}, [str(path)])
        counts = pd.Series(values).value_counts().sort_index()
        usage = pd.DataFrame({"code": counts.index, "count": counts.to_numpy()})
        return Report({"file": path, "rows": len(values), "codes": usage}, [table(usage), str(path)])


def command(stage: str, arguments: Sequence[str]) -> Callable[[], Report]:
    """Parse the arguments after `dds STAGE` and build what they ask for; the result does the work."""
    quieten()
    return StageCLI(stage, arguments or ["--help"]).build().execute


def settings_of(stage: str, arguments: Sequence[str]) -> dict[str, Any]:
    """All settings of a `fit`, defaults included, as plain values: what `--print_config` prints.

    Raises:
        UserError: Arguments that `dds STAGE fit` does not understand.
    """
    return parsed(stage, arguments).dump()


def parsed(stage: str, arguments: Sequence[str]) -> StageCLI:
    """A stage's command line, parsed and not built.

    Raises:
        UserError: Arguments that `dds STAGE fit` does not understand.
    """
    return StageCLI(stage, arguments, parse_only=True)
