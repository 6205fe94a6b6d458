"""The table of steps of `dds run`: what each reads, what its result depends on, and its work.

```
 data ─► skill ─► relabel ─► policy ─┬─► evaluate ─► report
   └──────────► clone (baseline) ────┴─► examine ──┘ └─► online, with `--until online`
```

A new step is one more row of `STEPS`. A step may run as soon as those that it reads are done: while the policy trains
on one core, others train the clone and let everyone play who needs no policy (`pipeline.beside`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from dds_lightning.pipeline.context import Run, Settings
from dds_lightning.pipeline.evaluating import evaluate, evaluation_settings, play_baselines
from dds_lightning.study import protocol
from dds_lightning.tasks import facts_to_keep
from dds_lightning.training.stages import get_stage


@dataclass(frozen=True)
class Step:
    """One step of a run.

    Attributes:
        name: Of the step and of its folder.
        reads: Steps whose outputs it uses.
        title: What a person reads while it runs.
        settings: Everything that its result depends on beside `reads`; JSON values.
        work: Does it: (run, folder, whether an interrupted one goes on) to outputs (paths) and facts.
        former: `settings` as an earlier version wrote them; None where they are the same.
        one_core: Whether the work uses one core only, so that others can be done beside it.
        beside: Whether it may be done in a process of its own beside a step with `one_core`.
        ahead: The part of the work that reads less and can be done earlier; not needed where this step is done.
    """

    name: str
    reads: tuple[str, ...]
    title: Callable[[Run], str]
    settings: Callable[[Run], Settings]
    work: Callable[[Run, Path, bool], Mapping[str, Any]]
    former: Callable[[Run], Settings] | None = None
    one_core: bool = False
    beside: bool = False
    ahead: Step | None = None


# ---------------------------------------------------------------------- data


def _data_title(run: Run) -> str:
    wanted = run.wanted
    if wanted.data is None:
        return f"data: {wanted.data_steps:,} steps of {run.task.name}"
    return f"data: {wanted.data}"


def _data_settings(run: Run) -> Settings:
    wanted = run.wanted
    settings: Settings = {**facts_to_keep(run.task), "data": wanted.data}
    if wanted.data is None:
        return {**settings, "steps": wanted.data_steps, "seed": wanted.seed}
    return {**settings, "files": run.data_hash}


def _data(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Collect data, or look at what was given."""
    from datamodules.inspection import describe
    from datamodules.sources import load_trajectories
    from dds_lightning.study.diagnosis import behaviour_scores

    outputs: dict[str, Any] = {}
    wanted, spec = run.wanted, run.wanted.data
    if spec is None:
        from datamodules.collect.collectors import collect

        outputs["data"] = collect(
            run.task,
            wanted.data_steps,
            wanted.seed,
            folder,
            wanted.workers,
            dataset_id=run.task.file_name,
            overwrite=True,
        )
        spec = f"local:{outputs['data']}"
    trajectories = load_trajectories(spec, run.task)
    facts, _ = describe(trajectories, task=run.task)
    return {**outputs, "facts": facts, "scores": behaviour_scores(trajectories, run.task)}


# ---------------------------------------------------------------------- trainings


def training_step(
    stage: str,
    reads: tuple[str, ...],
    title: Callable[[Run, Settings], str],
    best: str = "",
    publish: bool = False,
    one_core: bool = False,
    beside: bool = False,
) -> Step:
    """The step that trains a stage.

    Args:
        stage: Name of a registered training stage.
        reads: As of a `Step`.
        title: From the run and the training's settings.
        best: What a best checkpoint is, where one was kept: "replaces" the last one for the steps that follow, or is
            told "beside" it.
        publish: Whether the trained policy and its skills become an agent of their own in the step's folder.
        one_core: As of a `Step`.
        beside: As of a `Step`.
    """
    return Step(
        stage,
        reads,
        lambda run: title(run, run.trainings.settings(stage)),
        lambda run: run.trainings.cache_key_settings(stage),
        partial(_fit, stage, best, publish),
        lambda run: run.trainings.former_settings(stage),
        one_core,
        beside,
    )


def _fit(stage: str, best: str, publish: bool, run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Run `dds STAGE fit`, from its last checkpoint if there is one."""
    skill = run.output("skill", "checkpoint") if "skill" in get_stage(stage).reads else None
    last = folder / "last.ckpt"
    resume = last if resuming and last.is_file() else None
    run.say(run.trainings.command(stage, run.data_spec, skill, resume), style="dim")
    fitted = run.trainings.fit(stage, run.data_spec, skill, resume).data
    made = protocol.trained(fitted, takes_best=best == "replaces")
    if publish:
        from dds_lightning.agent import DDSAgent
        from dds_lightning.online.parts import checkpoint_parts
        from dds_lightning.pipeline.evaluating import publish_played

        seed, workers = run.wanted.seed, run.wanted.workers
        agent = DDSAgent(*checkpoint_parts(str(skill), str(made["checkpoint"])), seed=seed)
        made |= publish_played(agent, stage, run.task, folder / "agent", run.episodes, seed, workers)
    return made


def _relabel(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Fill the cache that `dds policy fit` reads."""
    from datamodules.relabelled import RelabeledDataModule
    from datamodules.semi_mdp import Relabelled

    skill = str(run.output("skill", "checkpoint"))
    options = run.trainings.relabelling()
    module = RelabeledDataModule(run.task.name, run.data_spec, skill, cache=str(folder), **options)
    module.prepare_data()
    summary = Relabelled.load(module.cache_file()).summary()
    summary.to_csv(folder / "codes.csv", index=False)
    return {"relabelled": module.cache_file(), "codes": folder / "codes.csv"}


# ---------------------------------------------------------------------- evidence, evaluation and report


def _examine(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Measure what each stage is worth by itself, for the verdict."""
    from datamodules.relabelled import RelabeledDataModule
    from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
    from dds_lightning.policy import PolicyModule
    from dds_lightning.study import evidence

    skill, wanted = run.output("skill", "checkpoint"), run.wanted
    held_out = {"validation_fraction": run.trainings.settings("policy")["data"]["validation_fraction"]}
    data = RelabeledDataModule(
        run.task.name,
        run.data_spec,
        str(skill),
        cache=str(run.output("relabel", "relabelled").parent),
        seed=wanted.seed,
        **held_out,
        **run.trainings.relabelling(),
    )
    data.prepare_data()
    data.setup()
    clone = BehaviourCloning.load(run.output("clone", "checkpoint"))
    noise, recorded = wanted.noise_scale, data.trajectories
    return {
        **evidence.data_evidence(recorded, run.task),
        **evidence.skill_evidence(data.skill, skill),
        **evidence.fidelity_evidence(recorded, data.skill, clone, noise, wanted.seed),
        **evidence.policy_evidence(data, PolicyModule.load(run.output("policy", "checkpoint"))),
    }


def _write_report(run: Run, folder: Path, resuming: bool) -> Mapping[str, Any]:
    """Draw what a person looks at."""
    from dds_lightning.study.report import write_report

    return dict(write_report(run.out))


# ---------------------------------------------------------------------- the table


def _skill_title(run: Run, settings: Settings) -> str:
    return f"skill: {settings['model']['num_skills']} codes, {settings['trainer']['max_steps']:,} steps"


STEPS: dict[str, Step] = {
    step.name: step
    for step in (
        Step("data", (), _data_title, _data_settings, _data),
        training_step("skill", ("data",), _skill_title, best="replaces"),
        Step(
            "relabel",
            ("data", "skill"),
            lambda run: "relabel: segments to skills",
            lambda run: {"task": run.task.name, **run.trainings.relabelling()},
            _relabel,
        ),
        training_step(
            "policy",
            ("data", "skill", "relabel"),
            lambda run, settings: f"policy: {settings['trainer']['max_steps']:,} steps",
            best="beside",
            one_core=True,
        ),
        training_step(
            "clone",
            ("data",),
            lambda run, settings: f"clone: behaviour cloning, the baseline, {run.wanted.clone_steps:,} steps",
            beside=True,
        ),
        Step(
            "examine",
            ("data", "skill", "relabel", "policy", "clone"),
            lambda run: "examine: what each stage is worth",
            lambda run: {"seed": run.wanted.seed, "noise_scale": run.wanted.noise_scale},
            _examine,
        ),
        Step(
            "evaluate",
            ("skill", "policy", "clone"),
            lambda run: f"evaluate: {run.episodes} episodes each, in the real environment",
            evaluation_settings,
            evaluate,
            ahead=Step(
                "baselines",
                ("skill", "clone"),
                lambda run: f"evaluate: those that need no policy, {run.episodes} episodes each",
                evaluation_settings,
                play_baselines,
                beside=True,
            ),
        ),
        Step(
            "report",
            ("relabel", "skill", "policy", "examine", "evaluate"),
            lambda run: "report: table, figures, clip",
            lambda run: {"task": run.task.name},
            _write_report,
        ),
        training_step(
            "online",
            ("data", "skill", "relabel"),
            lambda run, settings: f"online: SAC over the skills, {settings['trainer']['max_steps']:,} steps",
            publish=True,
            beside=True,
        ),
    )
}
"""Name -> step, each after those that it reads."""


def reading_starts(step: Step, run: Run) -> Step:
    """The step as it is in a run: learning online also reads the step that makes the policy from which it starts."""
    policy = run.trainings.starts("online").get("offline") if step.name == "online" else None
    if policy is None or not run.trainings.is_own(policy):
        return step
    of_policy = policy.resolve().is_relative_to((run.out / "policy").resolve())
    return replace(step, reads=(*step.reads, "policy" if of_policy else "evaluate"))  # which publishes the agent


def every_step() -> Iterator[Step]:
    """The steps, and before each its part that can be done ahead."""
    for step in STEPS.values():
        if step.ahead is not None:
            yield step.ahead
        yield step
