"""What `dds run` was asked to do, and what that means for its trainings: their arguments and their settings."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from jsonargparse import Namespace

from datamodules.relabelling import Relabelling
from dds_lightning.configs import RUN_DEFAULTS, known_as, run_defaults
from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError
from dds_lightning.pipeline.trial import refuse_settings
from dds_lightning.saving.files import expand
from dds_lightning.saving.places import refuse_no_checkpoint
from dds_lightning.saving.published import weights_hash
from dds_lightning.tasks import Task, get_task, is_own
from dds_lightning.training.alone import run_alone
from dds_lightning.training.monitors import refuse_late_validation
from dds_lightning.training.stage_cli import StageCLI, parsed
from dds_lightning.training.stages import STAGES, STARTS, preset_configs, run_stages

WATCH_EPISODES = 10
"""Episodes of each evaluation while the policy trains."""
_PLACES = ("default_root_dir", "logger", "enable_progress_bar", "enable_model_summary")


@dataclass(frozen=True)
class RunSettings:
    """What `dds run` was asked to do; see `dds run --help`."""

    task: str
    out: Path
    data: str | None = None
    seed: int = 0
    preset: str | None = None
    data_steps: int = RUN_DEFAULTS["data_steps"]
    clone_steps: int = RUN_DEFAULTS["clone_steps"]
    evaluate_every: int | None = None
    episodes: int | None = None
    episodes_per_skill: int = RUN_DEFAULTS["episodes_per_skill"]
    selection: str = RUN_DEFAULTS["selection"]
    temperature: float = RUN_DEFAULTS["temperature"]
    noise_scale: float | None = RUN_DEFAULTS["noise_scale"]
    workers: int | None = None
    until: str = "report"
    fresh: bool = False
    jobs: int | None = None
    stages: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Training stage -> arguments for its `fit`, as a user gave them."""

    @classmethod
    def with_preset(cls, task: str, out: Path, preset: str | None = None, **asked: Any) -> "RunSettings":
        """Settings in which the preset fills in what is None and `run_defaults` knows.

        Args:
            task: Name of a task.
            out: Folder of the run.
            preset: As in `dds run`; None takes the task family's.
            **asked: The other settings.

        Raises:
            UserError: There is no such task or preset, or the preset's `run.yaml` holds something else.
        """
        defaults = run_defaults(preset or get_task(task).family)
        missing = {name: value for name, value in defaults.items() if asked.get(name) is None}
        return cls(task=task, out=out, preset=preset, **{**asked, **missing})

    def asked(self) -> dict[str, Any]:
        """The settings that differ from the preset's, by name; `seed` always, arguments of stages aside."""
        usual = RunSettings.with_preset(self.task, self.out, self.preset)
        names = ("data", *RUN_DEFAULTS, "evaluate_every", "episodes")
        found = {name: getattr(self, name) for name in names if getattr(self, name) != getattr(usual, name)}
        return {"seed": self.seed, **({"preset": self.preset} if self.preset else {}), **found}

    def command(self) -> str:
        """The command line that makes the same run again, `--out` aside."""
        arguments = ["dds", "run", self.task, *(f"--{name}={value}" for name, value in self.asked().items())]
        arguments += [f"--{stage}.{one.removeprefix('--')}" for stage in STAGES for one in self.stages.get(stage, ())]
        return shlex.join(arguments)


class Trainings:
    """The commands `dds STAGE fit` of a run, each parsed once, so that a wrong setting is found before data are made.

    Args:
        wanted: What was asked for.
        task: In the variant that the data come from.

    Attributes:
        evaluate_every: Steps between two evaluations while the policy trains; 0 for none.

    Raises:
        UserError: A preset, an interval or arguments that cannot work.
    """

    def __init__(self, wanted: RunSettings, task: Task) -> None:
        self.wanted, self.task = wanted, task
        self.task_address = wanted.task if is_own(task) else task.name
        self.preset = preset_configs(wanted.preset or task.family)
        # How often the policy is evaluated follows from its steps, which only its parsed settings say.
        self.evaluate_every = self._asked_interval()
        spec = wanted.data or "local:."
        self._parsed: dict[str, StageCLI] = {}
        self._in_processes: set[str] = set()
        self._one_device: set[str] = set()
        for stage in run_stages():
            try:
                self._parse(stage, spec)
            except UserError as error:
                raise UserError(f"{stage}: {error}") from error
        refuse_settings(self._parsed, task)
        for stage in self._parsed:
            for name, path in self.starts(stage).items():
                if not self.is_own(path):
                    refuse_no_checkpoint(path, f"{stage}: model.{name}: ")
        self._settle_interval()
        if wanted.data is None:
            self.refuse_late_validations(wanted.data_steps + task.max_episode_steps)

    def _parse(self, stage: str, spec: str) -> None:
        """Parse a training's arguments and try its Trainer, on one device unless more are asked for."""
        cli = parsed(stage, self.arguments(stage, spec))
        given = self.wanted.stages.get(stage, ())
        if cli.settings.trainer.devices == "auto" and not any(one.startswith("--trainer.devices") for one in given):
            self._one_device.add(stage)
            cli.settings.trainer.devices = 1
        if cli.trial_trainer().strategy.launcher is not None:
            self._in_processes.add(stage)
        self._parsed[stage] = cli

    def refuse_late_validations(self, steps: int) -> None:
        """Refuse intervals between validations that are longer than an epoch of data with so many steps.

        Raises:
            UserError: Names the stage.
        """
        for stage, cli in self._parsed.items():
            try:
                if any(name.startswith("val/") for name in cli.stage.metrics):
                    refuse_late_validation(cli.settings, steps)
            except UserError as error:
                raise UserError(f"{stage}: {error}") from error

    # ---------------------------------------------------------------- evaluating while the policy trains

    def _asked_interval(self) -> int:
        """The interval that was asked for; by default 1 stands for one to be settled, and none on PointMaze."""
        every = self.wanted.evaluate_every
        if every is not None and every < 0:
            raise UserError(f"--evaluate_every is {every}, expected 0 (never) or more")
        return (0 if self.task.family == "pointmaze" else 1) if every is None else every

    def _settle_interval(self) -> None:
        """By default four evaluations; none on PointMaze, where the last checkpoint is as good as any."""
        settings = self._parsed["policy"].settings
        steps, every = settings.trainer.max_steps, self.evaluate_every
        if self.wanted.evaluate_every is None and every:
            every = max(1, steps // 4) if steps > 0 else 0
        elif 0 < steps < every:
            raise UserError(f"--evaluate_every is {every}, expected 0 (never) to {steps}, the steps of the policy")
        if every != self.evaluate_every:
            watching = self._watching_callback(settings)
            if every:
                watching.init_args.every_n_steps = settings.best.every_n_steps = every
            else:
                settings.trainer.callbacks.remove(watching)
                settings.best.monitor = settings.best.every_n_steps = None
        self.evaluate_every = every

    def _watching(self) -> list[str]:
        """The arguments that make the policy's training evaluate and keep its best checkpoint."""
        every, wanted = self.evaluate_every, self.wanted
        if not every:
            return []
        chosen: dict[str, Any] = {"episodes": WATCH_EPISODES, "every_n_steps": every}
        # Other starts than those of the final table: the best is not scored by the episodes that chose it.
        chosen |= {"seed": wanted.seed + 1, "workers": wanted.workers}
        chosen |= {"selections": [wanted.selection], "temperature": wanted.temperature}
        chosen |= {"noise_scale": wanted.noise_scale}
        callback = {"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": chosen}
        arguments = [f"--trainer.callbacks+={json.dumps(callback)}"]
        return [*arguments, "--best.monitor=rollout/score", f"--best.every_n_steps={every}"]

    def _watching_callback(self, settings: Namespace) -> Any:
        """The callback of `_watching` among those of the policy; the user's own come after it."""
        episodes_seed = (WATCH_EPISODES, self.wanted.seed + 1)
        return next(
            callback
            for callback in settings.trainer.callbacks
            if callback.class_path.endswith("RolloutEvaluation")
            and (callback.init_args.episodes, callback.init_args.seed) == episodes_seed
        )

    # ---------------------------------------------------------------- arguments and settings

    def arguments(self, stage: str, spec: str, skill: Path | None = None) -> list[str]:
        """The arguments of `dds STAGE fit`.

        Args:
            stage: Name of a training stage.
            spec: The data.
            skill: Checkpoint of the skills, for the policy; None stands for where it will be.
        """
        wanted, folder = self.wanted, self.wanted.out / stage
        config = self.preset[stage]
        arguments = ["fit", *(["--config", str(config)] if config else [])]
        arguments += [f"--seed_everything={wanted.seed}", f"--data.seed={wanted.seed}"]
        arguments += [f"--data.task={self.task_address}", f"--data.data={spec}"]
        if stage in ("policy", "online"):
            checkpoint = skill or wanted.out / "skill" / "last.ckpt"
            arguments += [f"--data.skill={checkpoint}", f"--data.cache={wanted.out / 'relabel'}"]
        if stage == "policy":
            arguments += self._watching()
        if stage == "clone":
            steps = wanted.clone_steps
            arguments += [f"--trainer.max_steps={steps}", f"--trainer.val_check_interval={min(1000, steps)}"]
        arguments += [f"--trainer.default_root_dir={folder}", f"--checkpoint.dirpath={folder}"]
        arguments += ["--trainer.devices=1"] if stage in self._one_device else []
        return [*arguments, "--trainer.enable_model_summary=false", *wanted.stages.get(stage, ())]

    def settings(self, stage: str) -> dict[str, Any]:
        """All settings of a training, defaults included."""
        return self._parsed[stage].dump()

    def cache_key_settings(self, stage: str) -> dict[str, Any]:
        """The settings that a training's result depends on: all of them but places of files and processes."""
        config = self.settings(stage)
        trainer = {key: value for key, value in config["trainer"].items() if key not in _PLACES}
        if stage in self._one_device:
            trainer["devices"] = "auto"  # as a run's markers always said it
        if isinstance(trainer.get("callbacks"), list):
            trainer["callbacks"] = [_without(callback, "workers") for callback in trainer["callbacks"]]
        data = {key: value for key, value in config["data"].items() if key not in ("data", "skill", "cache")}
        best = {key: value for key, value in config["best"].items() if key != "every_n_steps" or value is not None}
        chosen = {"trainer": trainer, "model": config["model"], "data": data, "best": best}
        if config["average"]["decay"] is not None:
            chosen["average"] = config["average"]
        if config["stop"]["when"] != "steps":
            chosen["stop"] = config["stop"]
        starts = {name: path for name, path in self.starts(stage).items() if not self.is_own(path)}
        if starts:
            chosen["starts"] = {name: weights_hash(path) for name, path in starts.items()}
        return {"seed": config["seed_everything"], **chosen}

    def starts(self, stage: str) -> dict[str, Path]:
        """The checkpoints from whose weights a training starts, by the setting that names them."""
        model = self._parsed[stage].settings.model
        return {name: expand(model[name]) for name in STARTS if model.get(name)}

    def is_own(self, path: Path) -> bool:
        """Whether this run makes a file: what holds it may not be there yet, or be made anew."""
        return path.resolve().is_relative_to(self.wanted.out.resolve())

    def former_settings(self, stage: str) -> dict[str, Any]:
        """`cache_key_settings` as version 0.1.0 wrote them, so that what it finished is still found done.

        It did not look into the checkpoints that a training starts from, trained the clone without a configuration, and
        chose the policy's best checkpoint by sampled codes with the decoder's own noise, however the run acts.
        """
        if stage == "clone":
            wanted = self.wanted
            asked = {"arguments": list(asked)} if (asked := wanted.stages.get(stage)) else {}
            return {"task": self.task.name, "seed": wanted.seed, "steps": wanted.clone_steps, **asked}
        settings = self.cache_key_settings(stage)
        settings.pop("starts", None)
        for callback in settings["trainer"]["callbacks"] or [] if stage == "policy" and self.evaluate_every else []:
            if callback["init_args"].get("seed") == self.wanted.seed + 1:
                callback["init_args"] |= {"selections": ["sample"], "temperature": 1.0, "noise_scale": None}
        return settings

    def relabelling(self) -> dict[str, Any]:
        """The settings of relabelling, which are the policy's data's."""
        data = self._parsed["policy"].settings.data
        return {one.name: data[one.name] for one in fields(Relabelling)}

    # ---------------------------------------------------------------- doing it

    def command(self, stage: str, spec: str, skill: Path | None, resume: Path | None) -> str:
        """The command line that `fit` with the same arguments is."""
        return shlex.join(["dds", stage, *map(known_as, self._words(stage, spec, skill, resume))])

    def _words(self, stage: str, spec: str, skill: Path | None, resume: Path | None) -> list[str]:
        arguments = self.arguments(stage, spec, skill)
        if resume is not None:
            starts = [f"--model.{name}=null" for name in STARTS if name in self._parsed[stage].settings.model]
            arguments += [f"--ckpt_path={resume}", *starts]
        return arguments

    def fit(self, stage: str, spec: str, skill: Path | None = None, resume: Path | None = None) -> Report:
        """Run `dds STAGE fit`.

        Args:
            stage: Name of a training stage.
            spec: The data.
            skill: Checkpoint of the skills, for the policy.
            resume: Checkpoint to go on from.
        """
        if stage in self._in_processes:
            return run_alone([stage, *self._words(stage, spec, skill, resume)])
        cli: StageCLI = self._parsed[stage]
        cli.settings.data.data = spec
        if skill is not None:
            cli.settings.data.skill = str(skill)
        if resume is not None:
            for name in STARTS:
                if name in cli.settings.model:
                    cli.settings.model[name] = None
            cli.resume(resume)
        return cli.build().execute()


def _without(callback: dict[str, Any], name: str) -> dict[str, Any]:
    chosen = {key: value for key, value in callback.get("init_args", {}).items() if key != name}
    return {**callback, "init_args": chosen}
