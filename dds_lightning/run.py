"""`dds run`: every stage of the method in order, in one directory, each done once.

```
 data ─► skill ─► relabel ─► policy ─┬─► evaluate ─► report
   └──────────► clone (baseline) ────┘
```

The two trainings are the very commands `dds skill fit` and `dds policy fit`, whose words are printed.
"""

import hashlib
import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from dds_lightning.configs import find_preset
from dds_lightning.errors import UserError
from dds_lightning.reports import Report
from dds_lightning.stages import Done, Stages, duration, locked
from dds_lightning.study import contestants
from dds_lightning.tasks import Task, get_task

STAGES = ("data", "skill", "relabel", "policy", "clone", "evaluate", "report")
_PLACES = ("default_root_dir", "logger", "enable_progress_bar", "enable_model_summary")


@dataclass(frozen=True)
class RunSettings:
    """What `dds run` was asked to do; see `dds run --help`."""

    task: str
    out: Path
    data: str | None = None
    seed: int = 0
    preset: str | None = None
    data_steps: int = 200_000
    clone_steps: int = 4000
    episodes: int | None = None
    episodes_per_skill: int = 20
    selection: str = "sample"
    temperature: float = 1.0
    workers: int | None = None
    until: str = STAGES[-1]
    fresh: bool = False
    skill: tuple[str, ...] = ()
    policy: tuple[str, ...] = ()


def run_all(settings: RunSettings) -> Report:
    """Do every stage that is not done yet.

    Raises:
        UserError: a setting that cannot work, found before anything is written.
    """
    return Run(settings).everything()


class Run:
    """One run directory and what was asked of it."""

    def __init__(self, settings: RunSettings) -> None:
        """Check everything that can be checked before the first file."""
        from dds_lightning.training.fitting import quieten, settings_of

        quieten()
        self.wanted = settings
        self.task: Task = get_task(settings.task)
        self.out = settings.out
        self.preset = find_preset(settings.preset or self.task.family)
        for name, value in (
            ("data_steps", settings.data_steps),
            ("clone_steps", settings.clone_steps),
            ("episodes", self.episodes),
            ("episodes_per_skill", settings.episodes_per_skill),
        ):
            if value < 1:
                raise UserError(f"--{name} is {value}, expected at least 1")
        self.data_signature = _signature(settings.data)
        # Parsing both commands now finds a wrong setting before the data are collected.
        self.settings = {
            stage: settings_of(stage, self._words(stage, settings.data or "local:.")) for stage in ("skill", "policy")
        }
        self.console = Console(stderr=True)

    @property
    def episodes(self) -> int:
        """Evaluation episodes of each contestant."""
        return self.task.evaluation_episodes if self.wanted.episodes is None else self.wanted.episodes

    def everything(self) -> Report:
        """Do the stages up to the one asked for, and tell what they made."""
        with locked(self.out):
            stages = Stages(self.out, self.console, self.wanted.fresh)
            self._stages(stages, STAGES.index(self.wanted.until))
        return self._report(stages.done)

    def _stages(self, stages: Stages, last: int) -> None:
        w = self.wanted
        origin: dict[str, Any] = {"task": self.task.name, "data": w.data}
        if w.data is None:
            origin |= {"steps": w.data_steps, "seed": w.seed}
        else:
            origin |= {"files": self.data_signature}
        title = f"data: {w.data_steps:,} steps of {self.task.name}" if w.data is None else f"data: {w.data}"
        data = stages.do("data", title, origin, [], self._data)
        self.spec = w.data or f"local:{data.outputs['data']}"
        self.data_facts = data.facts["facts"]
        if last < 1:
            return
        model = self.settings["skill"]["model"]
        steps = self.settings["skill"]["trainer"]["max_steps"]
        title = f"skill: {model['num_skills']} codes, {steps:,} steps"
        self.skill = stages.do("skill", title, self._essence("skill"), [data], self._skill)
        if last < 2:
            return
        settings = {"task": self.task.name, **self._relabelling()}
        relabelled = stages.do("relabel", "relabel: segments to skills", settings, [data, self.skill], self._relabel)
        if last < 3:
            return
        self.relabelled = relabelled
        steps = self.settings["policy"]["trainer"]["max_steps"]
        title = f"policy: {steps:,} steps"
        reads = [data, self.skill, relabelled]
        self.policy = stages.do("policy", title, self._essence("policy"), reads, self._policy)
        if last < 4:
            return
        title = f"clone: behaviour cloning, the baseline, {w.clone_steps:,} steps"
        settings = {"task": self.task.name, "seed": w.seed, "steps": w.clone_steps}
        self.clone = stages.do("clone", title, settings, [data], self._clone)
        if last < 5:
            return
        settings = {
            "task": self.task.name,
            "seed": w.seed,
            "episodes": self.episodes,
            "episodes_per_skill": w.episodes_per_skill,
            "selection": w.selection,
            "temperature": w.temperature,
        }
        title = f"evaluate: {self.episodes} episodes each, in the real environment"
        reads = [self.skill, self.policy, self.clone]
        self.evaluated = stages.do("evaluate", title, settings, reads, self._evaluate)
        if last < 6:
            return
        everything = [relabelled, self.skill, self.policy, self.evaluated]
        stages.do("report", "report: table, figures, clip", {"task": self.task.name}, everything, self._write_report)

    # ---------------------------------------------------------------- the stages

    def _data(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Collect data, or look at what was given."""
        from datamodules.inspection import check_dataset

        made: dict[str, Any] = {}
        spec = self.wanted.data
        if spec is None:
            from datamodules.collect.pointmaze import collect_pointmaze

            w = self.wanted
            made["data"] = collect_pointmaze(
                self.task, w.data_steps, w.seed, folder, w.workers, dataset_id=self.task.name, overwrite=True
            )
            spec = f"local:{made['data']}"
        facts = check_dataset(spec, self.task)
        return {**made, "facts": facts}

    def _words(self, stage: str, spec: str) -> list[str]:
        """The words of `dds STAGE fit` for this run."""
        w, folder = self.wanted, self.out / stage
        words = ["fit", "--config", str(self.preset[stage])]
        words += [f"--seed_everything={w.seed}", f"--data.seed={w.seed}"]
        words += [f"--data.task={self.task.name}", f"--data.data={spec}"]
        if stage == "policy":
            skill = getattr(self, "skill", None)
            checkpoint = skill.outputs["checkpoint"] if skill else self.out / "skill" / "last.ckpt"
            words += [f"--data.skill={checkpoint}", f"--data.cache={self.out / 'relabel'}"]
        words += [f"--trainer.default_root_dir={folder}", f"--checkpoint.dirpath={folder}"]
        return [*words, "--trainer.enable_model_summary=false", *getattr(w, stage)]

    def _essence(self, stage: str) -> dict[str, Any]:
        """The settings that a training's result depends on: all of them but the places of files."""
        config = self.settings[stage]
        trainer = {key: value for key, value in config["trainer"].items() if key not in _PLACES}
        data = {key: value for key, value in config["data"].items() if key not in ("data", "skill", "cache")}
        chosen = {"trainer": trainer, "model": config["model"], "data": data, "best": config["best"]}
        return {"seed": config["seed_everything"], **chosen}

    def _fit(self, stage: str, folder: Path, resuming: bool) -> dict[str, Any]:
        """Run `dds STAGE fit`, from its last checkpoint if there is one."""
        from dds_lightning.training.fitting import StageCLI, command_line

        words = self._words(stage, self.spec)
        if resuming and (folder / "last.ckpt").is_file():
            words += [f"--ckpt_path={folder / 'last.ckpt'}", "--model.init_from=null"]
        self.console.print(command_line(stage, words), style="dim", highlight=False, soft_wrap=True)
        made = StageCLI(stage, words).execute().data
        metrics = {name: round(value, 6) for name, value in made["metrics"].items()}
        return {
            "checkpoint": Path(made["best"] or made["checkpoint"]),
            "steps": made["steps"],
            "metrics": metrics,
        }

    def _skill(self, folder: Path, resuming: bool) -> dict[str, Any]:
        return self._fit("skill", folder, resuming)

    def _policy(self, folder: Path, resuming: bool) -> dict[str, Any]:
        return self._fit("policy", folder, resuming)

    def _relabelling(self) -> dict[str, Any]:
        names = ("gamma", "discount", "stride", "reward_scale", "reward_shift")
        return {name: self.settings["policy"]["data"][name] for name in names}

    def _relabel(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Fill the cache that `dds policy fit` reads."""
        from datamodules.relabel import Relabelled
        from datamodules.relabeled import RelabeledDataModule

        module = RelabeledDataModule(
            self.task.name,
            self.spec,
            str(self.skill.outputs["checkpoint"]),
            cache=str(folder),
            **self._relabelling(),
        )
        module.prepare_data()
        summary = Relabelled.load(module.cache_file()).summary()
        summary.to_csv(folder / "codes.csv", index=False)
        return {"relabelled": module.cache_file(), "codes": folder / "codes.csv"}

    def _clone(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Train the baseline that has no skills."""
        from dds_lightning.study.baselines import fit_clone

        w = self.wanted
        return {"checkpoint": fit_clone(self.task, self.spec, folder, seed=w.seed, steps=w.clone_steps)}

    def _evaluate(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Publish the agent and let everyone in the table play."""
        from dds_lightning.agent import DDSAgent
        from dds_lightning.policy import PolicyModule
        from dds_lightning.rollout import rollout
        from dds_lightning.skill import SkillModule
        from dds_lightning.study.baselines import CloneActor

        w = self.wanted
        agent = DDSAgent(
            SkillModule.load(self.skill.outputs["checkpoint"]),
            PolicyModule.load(self.policy.outputs["checkpoint"]),
            selection=w.selection,  # type: ignore[arg-type]
            temperature=w.temperature,
            seed=w.seed,
        )
        players = contestants.final_table(
            agent,
            self.task,
            self.episodes,
            w.episodes_per_skill,
            clone=CloneActor.load(self.clone.outputs["checkpoint"]),
            controller=contestants.behaviour_controller(self.task) if w.data is None else None,
        )
        result = rollout(self.task, players, seed=w.seed, workers=w.workers, record=True)
        result.save(folder)
        summary = result.summary()
        published = agent.save(
            self.out / "agent",
            metrics={"episodes": self.episodes, "seed": w.seed, "results": _records(summary)},
            card=self._card(result.episodes),
            task=self.task.name,
        )
        return {"episodes": folder / "episodes.parquet", "agent": published, "results": _records(summary)}

    def _card(self, episodes: Any) -> str:
        """The README.md of the published agent."""
        from dds_lightning.study.card import agent_card

        w = self.wanted
        made = f"collected by `dds data collect {self.task.name} --steps {w.data_steps} --seed {w.seed}`"
        words = ["dds", "run", self.task.name, f"--seed={w.seed}", *(["--data", w.data] if w.data else [])]
        words += [f"--{stage}.{word.removeprefix('--')}" for stage in ("skill", "policy") for word in getattr(w, stage)]
        return agent_card(
            self.task,
            episodes,
            seed=w.seed,
            data={"source": w.data or made, **self.data_facts},
            settings=self.settings,
            command=shlex.join(words),
        )

    def _write_report(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Draw what a person looks at."""
        from dds_lightning.study.report import write_report

        return dict(write_report(self.out))

    # ---------------------------------------------------------------- what is told at the end

    def _report(self, done: list[Done]) -> Report:
        """The table, where failures ended, and where everything lies."""
        total = sum(stage.seconds for stage in done)
        data: dict[str, Any] = {
            "task": self.task.name,
            "out": self.out,
            "seed": self.wanted.seed,
            "seconds": {stage.name: stage.seconds for stage in done},
            "done_before": [stage.name for stage in done if stage.skipped],
            "outputs": {stage.name: stage.outputs for stage in done},
        }
        by_name = {stage.name: stage for stage in done}
        text: list[Any] = []
        shown = done
        if "report" in by_name:
            from dds_lightning.study.report import told

            data |= by_name["report"].facts
            text += told(by_name["report"].facts)
            shown = [by_name["report"]]
            text.append(f"agent: {by_name['evaluate'].outputs['agent']}")
        text += [f"{name}: {path}" for stage in shown for name, path in stage.outputs.items()]
        text.append(f"{duration(total)} in all; everything is in {self.out}")
        return Report(data, text)


def _records(frame: Any) -> list[dict[str, Any]]:
    """Rows as plain numbers, rounded so that a marker is readable; NaN becomes None."""
    return json.loads(frame.round(4).to_json(orient="records"))


def _signature(spec: str | None) -> str | None:
    """Tell given data from changed ones without reading them: names, sizes and times of the files.

    Raises:
        UserError: there is no such folder.
    """
    if spec is None:
        return None
    source, _, rest = spec.partition(":")
    folder = Path(rest)
    if source == "minari":
        from datamodules.sources.minari import minari_root

        folder = minari_root() / rest
    if not rest or not folder.exists():
        raise UserError(f"data: there is nothing at {folder} (from {spec!r}); expected local:DIR or minari:ID")
    files = sorted(entry for entry in folder.rglob("*") if entry.is_file())
    facts = [(str(f.relative_to(folder)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
