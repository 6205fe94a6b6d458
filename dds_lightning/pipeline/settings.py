"""What `dds run` was asked to do, and what that means for its two trainings: their words and their settings."""

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dds_lightning.configs import RUN_DEFAULTS, find_preset, run_defaults
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

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
    episodes_per_skill: int = 20
    selection: str = RUN_DEFAULTS["selection"]
    temperature: float = RUN_DEFAULTS["temperature"]
    noise_scale: float | None = RUN_DEFAULTS["noise_scale"]
    workers: int | None = None
    until: str = "report"
    fresh: bool = False
    skill: tuple[str, ...] = ()
    policy: tuple[str, ...] = ()

    @classmethod
    def with_preset(cls, task: str, out: Path, preset: str | None = None, **asked: Any) -> "RunSettings":
        """Settings in which the preset fills in what is None and `run_defaults` knows.

        Args:
            task: name of a task.
            out: folder of the run.
            preset: as in `dds run`; None takes the task family's.
            **asked: the other settings.

        Raises:
            UserError: there is no such task or preset, or the preset's `run.yaml` holds something else.
        """
        defaults = run_defaults(preset or get_task(task).family)
        missing = {name: value for name, value in defaults.items() if asked.get(name) is None}
        return cls(task=task, out=out, preset=preset, **{**asked, **missing})

    def command(self) -> str:
        """The command line that makes the same run again, `--out` aside."""
        usual = RunSettings.with_preset(self.task, self.out, self.preset)
        words = ["dds", "run", self.task, f"--seed={self.seed}"]
        for name in ("data", "preset", *RUN_DEFAULTS, "evaluate_every", "episodes", "episodes_per_skill"):
            value = getattr(self, name)
            if value != getattr(usual, name) or (name == "preset" and value):
                words.append(f"--{name}={value}")
        words += [
            f"--{stage}.{word.removeprefix('--')}" for stage in ("skill", "policy") for word in getattr(self, stage)
        ]
        return shlex.join(words)


class Trainings:
    """The commands `dds skill fit` and `dds policy fit` of a run.

    Making one parses both commands, so that a wrong setting is found before data are collected.

    Args:
        wanted: what was asked for.
        task: in the variant that the data come from.

    Attributes:
        settings: stage -> all settings, defaults included.
        evaluate_every: steps between two evaluations while the policy trains; 0 for none.

    Raises:
        UserError: a preset, an interval or words that cannot work.
    """

    def __init__(self, wanted: RunSettings, task: Task) -> None:
        from dds_lightning.training.stage_cli import settings_of

        self.wanted, self.task = wanted, task
        self.preset = find_preset(wanted.preset or task.family)
        self.evaluate_every = 0
        spec = wanted.data or "local:."
        self.settings = {stage: settings_of(stage, self.words(stage, spec)) for stage in ("skill", "policy")}
        self.evaluate_every = self._interval(self.settings["policy"]["trainer"]["max_steps"])
        if self.evaluate_every:
            self.settings["policy"] = settings_of("policy", self.words("policy", spec))

    def _interval(self, steps: int) -> int:
        """By default four evaluations; none on PointMaze, where the last checkpoint is as good as any."""
        every = self.wanted.evaluate_every
        if every is None:
            wanted = self.task.family != "pointmaze" and steps > 0
            return max(1, steps // 4) if wanted else 0
        if every < 0 or 0 < steps < every:
            raise UserError(f"--evaluate_every is {every}, expected 0 (never) to {steps}, the steps of the policy")
        return every

    def words(self, stage: str, spec: str, skill: Path | None = None) -> list[str]:
        """The words of `dds STAGE fit`.

        Args:
            stage: "skill" or "policy".
            spec: the data.
            skill: checkpoint of the skills, for the policy; without it where it will be.
        """
        w, folder = self.wanted, self.wanted.out / stage
        words = ["fit", "--config", str(self.preset[stage])]
        words += [f"--seed_everything={w.seed}", f"--data.seed={w.seed}"]
        words += [f"--data.task={self.task.name}", f"--data.data={spec}"]
        if stage == "policy":
            checkpoint = skill or w.out / "skill" / "last.ckpt"
            words += [f"--data.skill={checkpoint}", f"--data.cache={w.out / 'relabel'}", *self._watching()]
        words += [f"--trainer.default_root_dir={folder}", f"--checkpoint.dirpath={folder}"]
        return [*words, "--trainer.enable_model_summary=false", *getattr(w, stage)]

    def _watching(self) -> list[str]:
        """The words that make the policy's training evaluate and keep its best checkpoint."""
        every = self.evaluate_every
        if not every:
            return []
        # Other starts than those of the final table: the best is not scored by the episodes that chose it.
        chosen: dict[str, Any] = {"episodes": WATCH_EPISODES, "every_n_steps": every, "seed": self.wanted.seed + 1}
        chosen["workers"] = self.wanted.workers
        callback = {"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": chosen}
        words = [f"--trainer.callbacks+={json.dumps(callback)}"]
        return [*words, "--best.monitor=rollout/score", f"--best.every_n_steps={every}"]

    def essence(self, stage: str) -> dict[str, Any]:
        """The settings that a training's result depends on: all of them but places of files and processes."""
        config = self.settings[stage]
        trainer = {key: value for key, value in config["trainer"].items() if key not in _PLACES}
        if isinstance(trainer.get("callbacks"), list):
            trainer["callbacks"] = [_without_workers(callback) for callback in trainer["callbacks"]]
        data = {key: value for key, value in config["data"].items() if key not in ("data", "skill", "cache")}
        best = {key: value for key, value in config["best"].items() if key != "every_n_steps" or value is not None}
        chosen = {"trainer": trainer, "model": config["model"], "data": data, "best": best}
        return {"seed": config["seed_everything"], **chosen}

    def relabelling(self) -> dict[str, Any]:
        """The settings of relabelling, which are the policy's data's."""
        names = ("gamma", "discount", "stride", "reward_scale", "reward_shift")
        return {name: self.settings["policy"]["data"][name] for name in names}


def _without_workers(callback: dict[str, Any]) -> dict[str, Any]:
    chosen = {key: value for key, value in callback.get("init_args", {}).items() if key != "workers"}
    return {**callback, "init_args": chosen}
