"""The commands `dds data ...`, one function each: the signature is the command line, the docstring the help."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dds_lightning.cli.arguments import data_spec
from dds_lightning.console.reports import Report, pairs, table
from dds_lightning.errors import UserError

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType

    from datamodules.trajectories import Trajectories
    from dds_lightning.tasks import Task

FIGURES = (".png", ".pdf", ".svg")


def list_(
    directory: list[str] = [],  # noqa: B006 - jsonargparse shows the default
    root: list[str] = ["data"],  # noqa: B006
) -> Report:
    """List data sets and the tasks that they fit: in Minari's folder, in D4RL's and in your own folders.

    Args:
        directory: Folders to search besides MINARI_DATASETS_PATH (or ~/.minari/datasets) and D4RL_DATASET_DIR (or
            ~/.d4rl/datasets).
        root: The folders to search where none are given.
    """
    from datamodules.listing import find_datasets

    root = directory or root
    if missing := [folder for folder in directory if not Path(folder).is_dir()]:
        raise UserError(f"there is no folder {missing[0]}: give folders with data sets")
    found = find_datasets(root)
    if found.empty:
        where = ", ".join(["Minari's folder", "D4RL's folder", *root])
        advice = "collect one with `dds data collect TASK`, or fetch one with `dds data fetch TASK`"
        return Report(found, [f"no data sets in {where}; {advice}"])
    shown = found.assign(tasks=[", ".join(names) or "none" for names in found["tasks"]])
    return Report(found, [table(shown[["data", "tasks", "episodes", "steps", "problem"]])])


def show(
    data: str,
    task: str | None = None,
    episodes: int = 10,
    out: str | None = None,
    no_figure: bool = False,
) -> Report:
    """Show what is in a data set: facts, dimensions, longest episodes, and a figure.

    The figure shows the lengths of the episodes, their returns, the actions and, with a maze task, the places
    that were visited.

    Args:
        data: Where the data are: local:DIR, minari:ID, d4rl:FILE, arrays:DIR, or just a folder or file.
        task: Name of the task; with it dimensions have names, mazes have walls, and rewards are those of its goal.
        episodes: Number of rows in the table of episodes.
        out: File of the figure (.png, .pdf or .svg); without it show/NAME.png in the current folder.
        no_figure: Print the tables only.
    """
    from datamodules.inspection import describe, episode_table
    from datamodules.sources import load_trajectories

    spec = data_spec(data)
    if episodes < 0:
        raise UserError(f"--episodes is {episodes}, expected at least 0")
    if out is not None and Path(out).suffix not in FIGURES:
        raise UserError(f"--out is {out}, expected a name that ends in {', '.join(FIGURES)}")
    trajectories = load_trajectories(spec, task or None)
    chosen = trajectories.task
    facts, dimensions = describe(trajectories, task=chosen)
    rows = episode_table(trajectories).sort_values("steps", ascending=False, kind="stable").head(episodes)
    report = Report(
        {
            "data": spec,
            "task": chosen.name if chosen else None,
            "facts": facts,
            "dimensions": dimensions,
            "episodes": rows,
            "figure": None,
        },
        [pairs(facts.items()), *_moving(dimensions)],
    )
    if len(rows):
        report.text.append(table(rows, "longest episodes"))
    if chosen is None:
        report.text.append(_advice(trajectories))
    if not no_figure:
        name = re.sub(r"[^\w.-]+", "-", trajectories.name)
        path = Path(out or f"show/{name}.png")
        _draw(trajectories, chosen, path)
        report.data["figure"] = path
        report.text.append(f"the figure is {path}")
    return report


def fetch(task: str, source: Literal["d4rl", "minari"] = "d4rl", out: str | None = None) -> Report:
    """Download a task's published data set; repeat the command after an interruption to continue.

    Args:
        task: Name of a task; `dds tasks NAME` says which data each source has for it.
        source: Either d4rl (the data behind the paper's scores) or minari.
        out: Folder for it; without it the source's default folder.
    """
    from datamodules.sources.fetch import fetch as fetch_data

    path = fetch_data(task, source, out)
    spec = data_spec(str(path))
    return Report(
        {"task": task, "source": source, "path": path, "data": spec},
        [f"{path} is there; look at it with `dds data show {path} --task {task}`, use it as {spec}"],
    )


def collect(
    task: str,
    steps: int = 200_000,
    seed: int = 0,
    out: str = "data",
    workers: int | None = None,
    overwrite: bool = False,
    recipe: dict[str, bool | int | float] | None = None,
) -> Report:
    """Collect a data set in the task's environment, on all cores.

    Repeat the command after an interruption to continue where it stopped.

    Args:
        task: Name of a task; `dds tasks` lists them.
        steps: Environment steps.
        seed: The same seed gives the same bytes of every array, whatever the number of workers.
        out: Folder of data sets; the new one is a folder in it.
        workers: Number of processes; without it one per core.
        overwrite: Replace a data set of the same name.
        recipe: What the behaviour does, one flag per setting, such as --recipe.action_noise=0.1 or, for AntMaze,
            --recipe.end_when_flipped=true; the error for an unknown name lists the known ones.
    """
    from datamodules.collect.collectors import collect as collect_data

    path = collect_data(task, steps, seed, out, workers, recipe=recipe, overwrite=overwrite)
    return Report(
        {"task": task, "data": f"local:{path}", "path": path, "steps": steps, "seed": seed},
        [f"{steps:,} steps of {task} in {path}; use them as local:{path}"],
    )


# ---------------------------------------------------------------------- parts of `show`


def _moving(dimensions: pd.DataFrame) -> list[RenderableType]:
    """The table of dimensions without constant ones (the kitchen has thirty), which are counted."""
    constant = dimensions["lowest"] == dimensions["highest"]
    shown = dimensions[~constant]
    if not dimensions["name"].any():
        shown = shown.drop(columns="name")
    lines: list[RenderableType] = [table(shown)] if len(shown) else []
    if constant.any():
        lines.append(f"{constant.sum()} of the {len(dimensions)} dimensions never change; --json lists them too")
    return lines


def _advice(trajectories: Trajectories) -> str:
    from datamodules.listing import fitting_tasks

    found = fitting_tasks(trajectories.name, widths=(trajectories.observation_dim, trajectories.action_dim))
    which = f"it may be {' or '.join(found)}" if found else "but no task of the table has these widths"
    return f"--task NAME adds names, scores and, in mazes, the visited places; {which}"


def _draw(trajectories: Trajectories, task: Task | None, path: Path) -> None:
    from dds_lightning.interpret.draw.dataset import plot_dataset
    from dds_lightning.saving.files import written_whole

    figure = plot_dataset(trajectories, task)
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as part:
        figure.savefig(part, dpi=150, format=path.suffix[1:])
