"""`dds run`: every stage of the method in order, in one directory, each done once.

```
 data ─► skill ─► relabel ─► policy ─┬─► evaluate ─► report
   └──────────► clone (baseline) ────┘
```

The two trainings are the very commands `dds skill fit` and `dds policy fit`, whose words are printed.
"""

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError
from dds_lightning.pipeline.settings import RunSettings as RunSettings
from dds_lightning.pipeline.settings import Trainings
from dds_lightning.saving.run_directory import Done, Stages, duration, locked
from dds_lightning.study import contestants, protocol
from dds_lightning.tasks import Task, get_task

STAGES = ("data", "skill", "relabel", "policy", "clone", "evaluate", "report")


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
        from dds_lightning.training.stage_cli import quieten

        quieten()
        self.wanted = settings
        self.task: Task = get_task(settings.task)
        self.out = settings.out
        for name, value in (
            ("data_steps", settings.data_steps),
            ("clone_steps", settings.clone_steps),
            ("episodes", self.episodes),
            ("episodes_per_skill", settings.episodes_per_skill),
        ):
            if value < 1:
                raise UserError(f"--{name} is {value}, expected at least 1")
        self.data_signature = self._look_at_data()
        self.trainings = Trainings(settings, self.task)
        self.console = Console(stderr=True)

    def _look_at_data(self) -> str | None:
        """Fingerprint of the files that were given, and the task in the variant in which they were recorded."""
        spec = self.wanted.data
        if spec is None:
            from datamodules.collect.collectors import refuse_uncollectable

            refuse_uncollectable(self.task)
            return None
        from datamodules.sources import resolve_task
        from datamodules.sources.stat_hash import signature

        found = signature(spec)
        self.task = resolve_task(spec, self.task)
        return found

    @property
    def episodes(self) -> int:
        """Evaluation episodes of each contestant."""
        return self.task.evaluation_episodes if self.wanted.episodes is None else self.wanted.episodes

    def everything(self) -> Report:
        """Do the stages up to the one asked for, and tell what they made."""
        with locked(self.out):
            if self.task.name != self.wanted.task:
                chosen = f"evaluating in {self.task.name} ({self.task.env_id})"
                told = f"the data were recorded in another physics than {self.wanted.task}'s: {chosen}"
                self.console.print(told, highlight=False, soft_wrap=True)
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
        model = self.trainings.settings["skill"]["model"]
        steps = self.trainings.settings["skill"]["trainer"]["max_steps"]
        title = f"skill: {model['num_skills']} codes, {steps:,} steps"
        self.skill = stages.do("skill", title, self.trainings.essence("skill"), [data], self._skill)
        if last < 2:
            return
        settings = {"task": self.task.name, **self.trainings.relabelling()}
        relabelled = stages.do("relabel", "relabel: segments to skills", settings, [data, self.skill], self._relabel)
        if last < 3:
            return
        self.relabelled = relabelled
        steps = self.trainings.settings["policy"]["trainer"]["max_steps"]
        title = f"policy: {steps:,} steps"
        reads = [data, self.skill, relabelled]
        self.policy = stages.do("policy", title, self.trainings.essence("policy"), reads, self._policy)
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
        if w.noise_scale is not None:
            settings["noise_scale"] = w.noise_scale
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
        from datamodules.inspection import describe
        from datamodules.sources import load_trajectories
        from dds_lightning.study.diagnosis import behaviour_scores

        made: dict[str, Any] = {}
        spec = self.wanted.data
        if spec is None:
            from datamodules.collect.collectors import collect

            w = self.wanted
            made["data"] = collect(
                self.task, w.data_steps, w.seed, folder, w.workers, dataset_id=self.task.name, overwrite=True
            )
            spec = f"local:{made['data']}"
        trajectories = load_trajectories(spec, self.task)
        facts, _ = describe(trajectories, task=self.task)
        return {**made, "facts": facts, "scores": behaviour_scores(trajectories, self.task)}

    def _fit(self, stage: str, folder: Path, resuming: bool) -> dict[str, Any]:
        """Run `dds STAGE fit`, from its last checkpoint if there is one."""
        from dds_lightning.training.stage_cli import StageCLI, command_line

        skill = self.skill.outputs["checkpoint"] if stage == "policy" else None
        words = self.trainings.words(stage, self.spec, skill)
        if resuming and (folder / "last.ckpt").is_file():
            words += [f"--ckpt_path={folder / 'last.ckpt'}", "--model.init_from=null"]
        self.console.print(command_line(stage, words), style="dim", highlight=False, soft_wrap=True)
        made = StageCLI(stage, words).execute().data
        metrics = {name: round(value, 6) for name, value in made["metrics"].items()}
        paths = {name: Path(made[name]) for name in ("checkpoint", "best") if made[name]}
        return {**paths, "steps": made["steps"], "metrics": metrics}

    def _skill(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """A best checkpoint is kept only on request, and then it is the one that was asked for."""
        made = self._fit("skill", folder, resuming)
        checkpoint = made.pop("best", made["checkpoint"])
        return {**made, "checkpoint": checkpoint}

    def _policy(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """The last checkpoint is what the run is about; the best is told beside it."""
        made = self._fit("policy", folder, resuming)
        chosen = {"chosen": protocol.best_facts(made["checkpoint"], made["best"])} if "best" in made else {}
        return {**made, **chosen}

    def _relabel(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Fill the cache that `dds policy fit` reads."""
        from datamodules.relabel import Relabelled
        from datamodules.relabelled import RelabeledDataModule

        module = RelabeledDataModule(
            self.task.name,
            self.spec,
            str(self.skill.outputs["checkpoint"]),
            cache=str(folder),
            **self.trainings.relabelling(),
        )
        module.prepare_data()
        summary = Relabelled.load(module.cache_file()).summary()
        summary.to_csv(folder / "codes.csv", index=False)
        return {"relabelled": module.cache_file(), "codes": folder / "codes.csv"}

    def _clone(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Train the baseline that has no skills."""
        from dds_lightning.baselines.behaviour_cloning import fit_clone

        w = self.wanted
        return {"checkpoint": fit_clone(self.task, self.spec, folder, seed=w.seed, steps=w.clone_steps)}

    def _evaluate(self, folder: Path, resuming: bool) -> dict[str, Any]:
        """Publish the agent and let everyone in the table play."""
        from dds_lightning.agent import DDSAgent
        from dds_lightning.baselines.behaviour_cloning import CloneActor
        from dds_lightning.console.reports import plain
        from dds_lightning.policy import PolicyModule
        from dds_lightning.rollout.play import rollout
        from dds_lightning.skill import SkillModule

        w = self.wanted
        chosen: dict[str, Any] = self.policy.facts.get("chosen", {})
        skill = SkillModule.load(self.skill.outputs["checkpoint"])

        def agent_of(checkpoint: str) -> DDSAgent:
            policy = PolicyModule.load(self.policy.outputs[checkpoint])
            return DDSAgent(skill, policy, w.selection, w.temperature, w.noise_scale, seed=w.seed)  # type: ignore[arg-type]

        agent = agent_of("checkpoint")
        best = agent_of("best") if chosen else None
        players = contestants.final_table(
            agent,
            self.task,
            self.episodes,
            w.episodes_per_skill,
            clone=CloneActor.load(self.clone.outputs["checkpoint"]),
            controller=contestants.behaviour_controller(self.task) if w.data is None else None,
            best=contestants.best_ways(best, self.episodes, chosen) if best else (),
        )
        result = rollout(self.task, players, seed=w.seed, workers=w.workers, record=True)
        result.save(folder)
        how = protocol.protocol(
            self.task, agent, episodes=self.episodes, seed=w.seed, temperature=w.temperature, best=chosen
        )
        made: dict[str, Any] = {"protocol": how}
        made["start_value"] = plain(protocol.start_value(self.task, agent, w.seed))
        results = _records(result.summary())
        metrics = {"episodes": self.episodes, "seed": w.seed, "results": results}
        card = self._card(result.episodes)
        made["agent"] = agent.save(self.out / "agent", metrics=metrics, card=card, task=self.task.name)
        if best:
            made["best"] = best.save(
                self.out / contestants.BEST_AGENT, metrics=metrics, task=self.task.name, checkpoint=chosen
            )
        return {"episodes": folder / "episodes.parquet", **made, "results": results}

    def _card(self, episodes: Any) -> str:
        """The README.md of the published agent."""
        from datamodules.collect.collectors import collection_command
        from dds_lightning.study.card import agent_card

        w = self.wanted
        command = f"dds data collect {self.task.name} --steps {w.data_steps} --seed {w.seed}"
        source = f"collected by `{command}`"
        if w.data is not None:
            known = collection_command(w.data.removeprefix("local:")) if w.data.startswith("local:") else None
            source = f"collected by `{known}` ({w.data})" if known else w.data
        return agent_card(
            self.task,
            episodes,
            seed=w.seed,
            data={"source": source, **self.data_facts},
            settings=self.trainings.settings,
            command=w.command(),
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
