"""The commands of `dds`, one function each: the signature is the command line, the docstring the help.

Heavy imports stay inside the functions, so that `dds tasks` does not wait for torch.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from datamodules.relabelling import Relabelling
from dds_lightning.cli.arguments import data_spec
from dds_lightning.console.reports import Report, pairs, table
from dds_lightning.errors import UserError
from dds_lightning.saving.places import refuse_no_folder, refuse_unwritable

if TYPE_CHECKING:
    from rich.console import RenderableType


def run(
    task: str,
    out: str | None = None,
    data: str | None = None,
    seed: int | None = None,
    preset: str | None = None,
    data_steps: int | None = None,
    clone_steps: int | None = None,
    evaluate_every: int | None = None,
    episodes: int | None = None,
    episodes_per_skill: int | None = None,
    selection: Literal["sample", "greedy", "argmax_q"] | None = None,
    temperature: float | None = None,
    noise_scale: float | None = None,
    workers: int | None = None,
    until: Literal["data", "skill", "relabel", "policy", "clone", "examine", "evaluate", "report", "online"] = "report",
    fresh: bool = False,
    jobs: int | None = None,
    seeds: int | None = None,
    **stages: list[str],
) -> Report:
    """Do everything for one task: data, skills, relabelling, policy, baseline, evaluation, report.

    Finished stages are not repeated: call it again after an interruption and it continues where it stopped;
    change a setting and the stages that depend on it are done again; settings left out are those of the earlier call.
    Every setting of a training stage can be given as --STAGE.KEY=VALUE, for example --skill.trainer.max_steps=500
    --policy.model.alpha=5.

    A task with several physics variants (`dds tasks NAME`) is played in the one in which the data were recorded.

    With --json: `task` (with the variant of the data), `out`, `seed`, `seconds` and `outputs` of each stage,
    `done_before`; after the report also `main` (the contestant that the run is about), `protocol` (as `dds evaluate
    --json` has it), `table` (a row each: contestant, kind, episodes, success with success_low and success_high in per
    cent, score, score_error, return, steps, length: median of the successful), `failures` (where the main
    contestant's ended) and `diagnosis` (scores from the data to the policy, measures of the trainings). What is not
    measured is null.

    Args:
        task: Name of a task (`dds tasks` lists them), a task file of your own (.yaml), or package.module:NAME; in mazes
            `NAME?goal=ROW,COLUMN`, `?start=ROW,COLUMN` or both, joined by &.
        out: Folder of the run; without it runs/TASK.
        data: Your data, local:DIR, minari:ID, d4rl:FILE or arrays:DIR; without it data are collected in the
            environment.
        seed: Seed of everything random: data, both trainings and the evaluation; without it 0.
        preset: Packaged configurations (antmaze, kitchen, locomotion, pointmaze, paper), or a folder with skill.yaml,
            policy.yaml and, if you like, run.yaml (data_steps, clone_steps, episodes_per_skill, selection, temperature,
            noise_scale); without it the task family's.
        data_steps: Environment steps to collect; without it the preset's, as for the other settings of run.yaml.
        clone_steps: Optimiser steps of the behaviour-cloning baseline.
        evaluate_every: Steps between two evaluations of 10 episodes while the policy trains; the best checkpoint by
            their score is reported beside the last; 0 for none; without it a quarter of the training, on PointMaze
            none.
        episodes: Evaluation episodes of each contestant; without it the task's default.
        episodes_per_skill: Evaluation episodes of each single skill alone.
        selection: How the published agent chooses skills; the table shows every way.
        temperature: Temperature of `sample`; below 1 is nearer to greedy.
        noise_scale: Factor on the decoder's noise when acting; without it the preset's or the skill model's.
        workers: Number of processes for the environments; without it one per core.
        until: The last stage to do; online, after the report, goes on in the environment itself.
        fresh: Do every stage again.
        jobs: How many stages (with --seeds, runs) are done at the same time; 1: one after the other; without it one
            per core. The clone trains, and those who need no policy play, while the policy trains.
        seeds: Do the whole run with this many seeds, `seed` and those that follow, one thread each, in folders
            seed-N of `out`; the table has mean, standard deviation and interquartile mean over the seeds.
        **stages: Settings for `dds STAGE fit` of each training stage, see above.
    """
    from dds_lightning.configs import run_defaults
    from dds_lightning.tasks import get_task

    run_defaults(preset or get_task(task).family)  # what is misspelt is told before anything heavy is imported
    from dds_lightning.pipeline.record import recall
    from dds_lightning.pipeline.run import run_all
    from dds_lightning.pipeline.seeds import run_seeds
    from dds_lightning.pipeline.settings import RunSettings

    folder = Path(out or f"runs/{get_task(task).file_name}")
    typed = {
        "data": data_spec(data) if data else None,
        "seed": seed,
        "preset": preset,
        "data_steps": data_steps,
        "clone_steps": clone_steps,
        "evaluate_every": evaluate_every,
        "episodes": episodes,
        "episodes_per_skill": episodes_per_skill,
        "selection": selection,
        "temperature": temperature,
        "noise_scale": noise_scale,
        "seeds": seeds,
    }
    asked, words = recall(folder, task, typed, stages)
    seeds, asked["seed"] = asked.pop("seeds"), asked["seed"] or 0
    settings = RunSettings.with_preset(
        task=task,
        out=folder,
        workers=workers,
        until=until,
        fresh=fresh,
        jobs=jobs,
        stages={name: tuple(arguments) for name, arguments in words.items()},
        **asked,
    )
    return run_all(settings) if seeds is None else run_seeds(settings, seeds)


def relabel(
    skill: str,
    data: str,
    task: str | None = None,
    out: str | None = None,
    **relabelling: Any,
) -> Report:
    """Turn a data set into transitions between skills, and show how the codes are used.

    Args:
        skill: Skill checkpoint, a .ckpt file or a published directory.
        data: Where the data are: local:DIR, minari:ID, d4rl:FILE, arrays:DIR, or just a folder or file.
        task: Name of the task; it decides how rewards are read.
        out: File to write; without it the cache beside the checkpoint, where `dds policy fit` looks.
        **relabelling: Fields of `datamodules.relabelling.Relabelling`.
    """
    from datamodules.relabelled import RelabeledDataModule
    from datamodules.semi_mdp import Relabelled

    settings = Relabelling(**relabelling).settings()
    module = RelabeledDataModule(task, data_spec(data), skill, **settings)
    path = Path(out) if out else module.cache_file()
    try:
        made = Relabelled.load(path, module.key)  # done before
    except UserError:
        made = module.relabel_into(path)
    summary = made.summary()
    used = int((summary["segments"] > 0).sum()) if "segments" in summary else None
    return Report(
        {"file": path, "segments": len(made), "settings": module.settings, "codes": summary},
        [table(summary, f"{len(made):,} segments, {used} codes in use"), str(path)],
    )


def evaluate(
    directory: str | None = None,
    skill: str | None = None,
    policy: str | None = None,
    task: str | None = None,
    episodes: int | None = None,
    selection: list[str] = ["greedy", "sample"],  # noqa: B006
    temperature: float = 1.0,
    noise_scale: float | None = None,
    hold: int | None = None,
    checkpoint: Literal["last", "best", "both"] = "both",
    seed: int = 0,
    workers: int | None = None,
    out: str | None = None,
) -> Report:
    """Roll out a trained agent in its environment and print its scores.

    The best checkpoint of a run was chosen by playing in the environment while it trained, so its figures are
    optimistic; compare published scores with the last one.

    With --json: `agent` and `best` (directories of the last and the best checkpoint, null if they do not play),
    `task`, `seed`, `protocol` (task with variant, environment, episodes, seed, checkpoint, noise_scale and sampler
    of the decoder, temperature, horizon of a skill, max_episode_steps, score_min and score_max: the returns that
    score 0 and 100, paper_score, best: how that checkpoint was chosen), `results` (a row each: actor, checkpoint,
    episodes, success in per cent, score, score_error, return, length, length_success) and, with --out, `episodes`.
    What is not measured is null.

    Args:
        directory: A run of `dds run`, or a published checkpoint; left out with --skill.
        skill: Skill checkpoint (.ckpt) of `dds skill fit` instead of a run.
        policy: Policy checkpoint (.ckpt) of `dds policy fit` to go with it; or a baseline's, with --skill where it has
            skills.
        task: Name of the task; without it the one the agent was made for.
        episodes: Episodes for each way of choosing skills; without it the task's default.
        selection: How skills are chosen: greedy, sample, argmax_q, random; several give one row each.
        temperature: Temperature of `sample`; below 1 is nearer to greedy.
        noise_scale: Factor on the decoder's noise; without it the agent's.
        hold: Steps for which a skill is held before the next is chosen; without it the agent's, H for most.
        checkpoint: Which of a run's checkpoints; both means the last and, where the run kept one, the best.
        seed: Seed of the environments and of sampling.
        workers: Number of processes for the environments; without it one per core.
        out: Parquet (or .csv) file for the table of episodes.
    """
    refuse_unwritable(out)
    if directory not in (None, "-") and skill is None and policy is None:
        refuse_no_folder(str(directory))
    from dds_lightning.cli.methods import baseline_at, evaluate_baseline
    from dds_lightning.study.evaluate import evaluate as play

    if directory in (None, "-") and policy is not None and (method := baseline_at(policy)):
        acting = {"noise_scale": noise_scale, "temperature": None if temperature == 1.0 else temperature, "hold": hold}
        chosen = {**acting, "selection": selection[0] if len(selection) == 1 else None}
        return evaluate_baseline(method, policy, skill, task, episodes, seed, workers, out, **chosen)
    return play(
        None if directory in (None, "-") else Path(str(directory)),
        skill=skill,
        policy=policy,
        task=task,
        episodes=episodes,
        selection=selection,
        temperature=temperature,
        noise_scale=noise_scale,
        hold=hold,
        checkpoint=checkpoint,
        seed=seed,
        workers=workers,
        out=out,
    )


def report(directory: str, task: str | None = None) -> Report:
    """Draw the report of a finished run once more: table, figures, clip.

    Args:
        directory: A run of `dds run`.
        task: File of the run's task, where its environment is in a module of your own.
    """
    from dds_lightning.study.report import report as draw

    return draw(directory, task)


def data_check(data: str, task: str | None = None, horizon: int | None = None, replay: int = 0) -> Report:
    """Read a data set from end to end and say what is wrong with it, if anything.

    With --replay the simulator is put into recorded states and takes the recorded actions: if it ends up elsewhere
    than the recording, or pays other rewards, the data come from another environment, and the exit status is 1.

    With --json: `data`, `task`, `sound`, `facts`, `replay` (null without it): `steps`, `verdict` (fit or misfit),
    `physics` (one for every variant of the task, with its error, limit, verdict, rewards and table of dimensions) and
    `notes`.

    Args:
        data: Where the data are: local:DIR, minari:ID, d4rl:FILE, arrays:DIR, or just a folder or file.
        task: Name of the task that the data should fit.
        horizon: Also count segments of this many steps, and refuse data without one.
        replay: Number of steps to replay in the task's environment, for example 200; 0 for none.
    """
    from datamodules.inspection import check_dataset

    spec = data_spec(data)
    if replay < 0:
        raise UserError(f"--replay is {replay}, expected a number of steps, or 0 for none")
    if not replay:
        facts = check_dataset(spec, task, horizon=horizon)
        return Report(
            {"data": spec, "task": task, "sound": True, "facts": facts, "replay": None},
            [_facts(facts), *_notes(facts), f"{spec} is sound" + (f" and fits {task}" if task else "")],
        )
    if task is None:
        raise UserError("--replay needs an environment: give --task NAME; `dds tasks` lists them")
    from datamodules.physics.check import replay_check

    found = replay_check(spec, task, replay)
    # What does not fit the task may well be sound; loading it for the task would refuse other coordinates first.
    facts = check_dataset(spec, found.task if found.fit else None, horizon=horizon)
    return Report(
        {"data": spec, "task": found.task.name, "sound": True, "facts": facts, "replay": found.facts()},
        [
            _facts(facts),
            *_notes(facts),
            table(found.table().head(12), f"{found.steps} steps in {found.task.name}"),
            *found.lines(),
        ],
        status=0 if found.fit else 1,
    )


def tasks(name: str | None = None) -> Report:
    """List the tasks, or show everything about one: environment, episodes, maze, rewards, scores, data.

    Args:
        name: Name of one task or of one of its variants, for example antmaze-umaze@robotics, or a maze with another
            goal, for example 'antmaze-umaze?goal=1,3'.
    """
    from dds_lightning.tasks import get_task, task_names, task_table
    from dds_lightning.tasks.facts import draw_maze, task_facts, task_lines

    if name is not None:
        task = get_task(name)
        return Report(task_facts(task), [pairs(task_lines(task), task.name), "\n".join(draw_maze(task))])
    shown: list[RenderableType] = []
    for (family, variants), rows in task_table().groupby(["family", "variants"], sort=False):
        title = f"{family}, each also as NAME{variants}" if variants else family
        shown.append(table(rows.drop(columns=["family", "variants"]), title, digits=4))
    return Report(
        [task_facts(get_task(known)) for known in task_names()],
        [
            *shown,
            "O/A: widths of observations and actions. score range: the returns that count as 0 and as 100.",
            "paper: its scores, with D4RL's data in D4RL's physics; not to be compared with those of other data.",
            "`dds tasks NAME` shows everything about one task, including its maze and its data.",
        ],
    )


def _notes(facts: dict[str, object]) -> list[str]:
    """A line about everything that is allowed and seldom meant."""
    notes = {
        "steps left out": "{} steps of the file are left out: the last of an episode that was cut off, where the file "
        "does not say where it led (an array next_observations would), or what lies beyond a maze's goal",
        "constant observation columns": "observation columns that never change: {}; fine for a goal, useless otherwise",
        "every reward": "every step pays {}: a critic learns nothing from that; put rewards into the data",
        "repeated episodes": "{} of the {episodes} episodes repeat an earlier one to the bit: training and validation "
        "would share them, and held-out losses mean little; leave the repeats out",
    }
    return [told.format(facts[name], **facts) for name, told in notes.items() if name in facts]


def _facts(facts: dict[str, object]) -> str:
    width = max(map(len, facts), default=0)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in facts.items())
