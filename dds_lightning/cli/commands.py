"""The commands of `dds`, one function each: the signature is the command line, the docstring the help.

Heavy imports stay inside the functions, so that `dds tasks` need not wait for torch.
"""

from pathlib import Path
from typing import Literal

from dds_lightning.errors import UserError
from dds_lightning.reports import Report, table


def run(
    task: str,
    out: str | None = None,
    data: str | None = None,
    seed: int = 0,
    preset: str | None = None,
    data_steps: int = 200_000,
    clone_steps: int = 4000,
    episodes: int | None = None,
    episodes_per_skill: int = 20,
    selection: Literal["sample", "greedy", "argmax_q"] = "sample",
    temperature: float = 1.0,
    workers: int | None = None,
    until: Literal["data", "skill", "relabel", "policy", "clone", "evaluate", "report"] = "report",
    fresh: bool = False,
    skill: list[str] = [],  # noqa: B006 - jsonargparse shows the default and nobody changes it
    policy: list[str] = [],  # noqa: B006
) -> Report:
    """Do everything for one task: data, skills, relabelling, policy, baseline, evaluation, report.

    What is done is not done twice: call it again after an interruption and it goes on where it stopped;
    change a setting and the stages that it touches are done again. Every setting of the two trainings can be
    given as --skill.KEY=VALUE and --policy.KEY=VALUE, for example --skill.trainer.max_steps=500
    --policy.model.alpha=5.

    Args:
        task: name of a task; `dds tasks` lists them
        out: folder of the run; without it runs/TASK
        data: your data, local:DIR or minari:ID; without it data are collected in the environment
        seed: of everything random: data, both trainings and the evaluation
        preset: packaged pair of configurations (pointmaze, paper), or a folder with skill.yaml and
            policy.yaml; without it the task family's
        data_steps: environment steps to collect
        clone_steps: optimiser steps of the behaviour-cloning baseline
        episodes: evaluation episodes of each contestant; without it the task's own number
        episodes_per_skill: evaluation episodes of each single skill alone
        selection: how the published agent chooses skills; the table shows every way
        temperature: of `sample`; below 1 is nearer to greedy
        workers: processes for environments; without it one for every core
        until: the last stage to do
        fresh: do every stage again
        skill: settings for `dds skill fit`, see above
        policy: settings for `dds policy fit`, see above
    """
    from dds_lightning.run import RunSettings, run_all

    return run_all(
        RunSettings(
            task=task,
            out=Path(out or f"runs/{task}"),
            data=_spec(data) if data else None,
            seed=seed,
            preset=preset,
            data_steps=data_steps,
            clone_steps=clone_steps,
            episodes=episodes,
            episodes_per_skill=episodes_per_skill,
            selection=selection,
            temperature=temperature,
            workers=workers,
            until=until,
            fresh=fresh,
            skill=tuple(skill),
            policy=tuple(policy),
        )
    )


def relabel(
    skill: str,
    data: str,
    task: str | None = None,
    out: str | None = None,
    gamma: float = 0.99,
    discount: Literal["per_skill", "per_step"] = "per_skill",
    stride: int = 1,
    reward_scale: float | None = None,
    reward_shift: float | None = None,
) -> Report:
    """Turn a data set into transitions between skills, and show how its codes are used.

    Args:
        skill: skill checkpoint, a .ckpt file or a published directory
        data: the data, local:DIR or minari:ID
        task: name of the task; it decides how rewards are read
        out: file to write; without it the cache beside the checkpoint, where `dds policy fit` looks
        gamma: discount a step inside a skill
        discount: bootstrap with gamma (per_skill, the paper) or with gamma^steps (per_step)
        stride: steps between the starts of two segments
        reward_scale: factor on the learning reward; without it the task's
        reward_shift: shift of the learning reward; without it the task's
    """
    from datamodules.relabel import relabel as relabel_data
    from datamodules.relabel import relabel_key
    from datamodules.relabeled import RelabeledDataModule

    module = RelabeledDataModule(
        task,
        _spec(data),
        skill,
        gamma=gamma,
        discount=discount,
        stride=stride,
        reward_scale=reward_scale,
        reward_shift=reward_shift,
    )
    path = Path(out) if out else module.cache_file()
    made = relabel_data(module.trajectories, module.skill, **module.settings, progress=True)
    made.save(path, relabel_key(module.trajectories, module.skill, **module.settings))
    summary = made.summary()
    used = int((summary["segments"] > 0).sum()) if "segments" in summary else None
    return Report(
        {"file": path, "segments": len(made), "settings": module.settings, "codes": summary},
        [table(summary, f"{len(made):,} segments, {used} codes in use"), str(path)],
    )


def evaluate(
    directory: str,
    task: str | None = None,
    episodes: int | None = None,
    selection: list[str] = ["greedy", "sample"],  # noqa: B006
    temperature: float = 1.0,
    seed: int = 0,
    workers: int | None = None,
    out: str | None = None,
) -> Report:
    """Roll out a trained agent in its environment and print its scores.

    Args:
        directory: a run of `dds run`, or a published checkpoint
        task: name of the task; without it the one the agent was made for
        episodes: episodes for each way of choosing skills; without it the task's own number
        selection: how skills are chosen: greedy, sample, argmax_q, random; several give one row each
        temperature: of `sample`; below 1 is nearer to greedy
        seed: of the environments and of sampling
        workers: processes for environments; without it one for every core
        out: Parquet file for the table of episodes
    """
    from dds_lightning.agent import DDSAgent
    from dds_lightning.checkpointing import load_published
    from dds_lightning.rollout import rollout
    from dds_lightning.study.contestants import agent_directory, way
    from dds_lightning.tasks import get_task

    path = agent_directory(Path(directory))
    name = task or load_published(path).config.get("task")
    if name is None:
        raise UserError(f"{path} does not say which task it is for: give --task")
    wanted = get_task(name)
    count = wanted.evaluation_episodes if episodes is None else episodes
    if count < 1:
        raise UserError(f"--episodes is {count}, expected at least 1")
    agent = DDSAgent.load(path, seed=seed)
    found, expected = (agent.observation_dim, agent.action_dim), (wanted.observation_dim, wanted.action_dim)
    if found != expected:
        raise UserError(
            f"the agent in {path} has (observation_dim, action_dim) {found}, task {name} has {expected}:  "
            "it was trained for another task"
        )
    ways = [
        way(agent, choice, count, temperature if choice == "sample" else 1.0) for choice in dict.fromkeys(selection)
    ]
    result = rollout(wanted, ways, seed=seed, workers=workers)
    summary = result.summary()
    report = Report(
        {"agent": path, "task": name, "seed": seed, "results": summary},
        [table(summary, f"{name}: {count} episodes each, seed {seed}")],
    )
    if out is not None:
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        result.episodes.to_parquet(out, index=False)
        report.data["episodes"] = out
        report.text.append(out)
    return report


def report(directory: str) -> Report:
    """Draw the report of a finished run once more: table, figures, clip.

    Args:
        directory: a run of `dds run`
    """
    from dds_lightning.study.report import report as draw

    return draw(directory)


def data_collect(
    task: str,
    steps: int = 200_000,
    seed: int = 0,
    out: str = "data",
    workers: int | None = None,
    overwrite: bool = False,
) -> Report:
    """Make a data set by driving the task's environment, on all cores.

    Args:
        task: name of a task; `dds tasks` lists them
        steps: environment steps
        seed: the same seed gives the same bytes of every array, whatever the number of workers
        out: folder of data sets; the new one is a folder in it
        workers: processes; without it one for every core
        overwrite: replace a data set of the same name
    """
    from datamodules.collect.pointmaze import collect_pointmaze

    path = collect_pointmaze(task, steps, seed, out, workers, overwrite=overwrite)
    return Report(
        {"task": task, "data": f"local:{path}", "path": path, "steps": steps, "seed": seed},
        [f"{steps:,} steps of {task} in {path}; use them as local:{path}"],
    )


def data_check(data: str, task: str | None = None, horizon: int | None = None) -> Report:
    """Read a data set from end to end and say what is wrong with it, if anything.

    Args:
        data: local:DIR, minari:ID or a folder
        task: name of the task that the data should fit
        horizon: also count segments of this many steps, and refuse data without one
    """
    from datamodules.inspection import check_dataset

    facts = check_dataset(_spec(data), task, horizon=horizon)
    return Report(
        {"data": _spec(data), "task": task, "sound": True, "facts": facts},
        [_facts(facts), f"{_spec(data)} is sound" + (f" and fits {task}" if task else "")],
    )


def data_show(data: str, task: str | None = None, episodes: int = 10) -> Report:
    """Show what is in a data set: the range of every dimension, and its longest episodes.

    Args:
        data: local:DIR, minari:ID or a folder
        task: name of the task; with it mazes get the reward of the task's goal
        episodes: rows of the table of episodes
    """
    from datamodules import load_trajectories
    from datamodules.inspection import describe, episode_table
    from dds_lightning.tasks import get_task

    chosen = get_task(task) if task else None
    trajectories = load_trajectories(_spec(data), chosen)
    facts, dimensions = describe(trajectories, task=chosen)
    rows = episode_table(trajectories).sort_values("steps", ascending=False, kind="stable").head(episodes)
    return Report(
        {"data": _spec(data), "task": task, "facts": facts, "dimensions": dimensions, "episodes": rows},
        [_facts(facts), table(dimensions), table(rows, f"the {len(rows)} longest episodes")],
    )


def data_list(root: list[str] = ["data"]) -> Report:  # noqa: B006
    """List the data sets in Minari's folder and in folders of your own.

    Args:
        root: folders to look in beside MINARI_DATASETS_PATH (or ~/.minari/datasets)
    """
    from datamodules.inspection import find_datasets

    found = find_datasets(root)
    if found.empty:
        where = ", ".join(["Minari's folder", *root])
        return Report(found, [f"no data sets in {where}; make one with `dds data collect TASK`"])
    return Report(found, [table(found)])


def tasks() -> Report:
    """List the tasks: environment, start, goal, episode cap, reference scores and data sets."""
    from dds_lightning.tasks import task_table

    found = task_table()
    return Report(found, [table(found)])


def _spec(data: str) -> str:
    """Accept a plain folder for `local:FOLDER`."""
    if ":" not in data and Path(data).is_dir():
        return f"local:{data}"
    if ":" not in data:
        raise UserError(f"data: there is no folder {data!r}; give local:DIR or minari:ID")
    return data


def _facts(facts: dict[str, object]) -> str:
    width = max(map(len, facts), default=0)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in facts.items())
