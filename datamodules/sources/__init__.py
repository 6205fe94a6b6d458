"""Where trajectories come from: `d4rl:FILE`, `minari:ID`, `local:DIR`, `arrays:DIR`; a new source is one more entry."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from datamodules.sources.arrays import load_arrays
from datamodules.sources.d4rl import load_d4rl
from datamodules.sources.fetch import find_d4rl
from datamodules.sources.goal import cut_at_arrivals, relabel_to_goal
from datamodules.sources.minari import (
    load_local,
    load_minari_id,
    local_env_id,
    minari_env_id,
    minari_folder,
    minari_root,
)
from datamodules.sources.rows import Recording, open_array_rows, open_d4rl_rows, open_minari_rows
from datamodules.sources.subtasks import relabel_subtasks
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task, task_for_env


class Source(NamedTuple):
    """One kind of source. Every function takes what follows the colon of a spec.

    Attributes:
        load: Reads the data for a task that `resolve_task` has returned, or for none.
        locate: The file or folder; it need not exist.
        open_rows: Opens the data for reading single rows, see `open_rows`.
        recorded_in: Which environment the data say they were recorded in, without reading their arrays; None where
            the format does not say.
    """

    load: Callable[[str, Task | None], Trajectories]
    locate: Callable[[str], Path]
    open_rows: Callable[[str, Task, np.random.Generator], AbstractContextManager[Recording]]
    recorded_in: Callable[[str], str | None] = lambda rest: None


def _folder(directory: str) -> Path:
    return Path(directory).expanduser()


SOURCES: dict[str, Source] = {
    "local": Source(
        load_local, _folder, lambda rest, task, rng: open_minari_rows(_folder(rest), task, rng), local_env_id
    ),
    "minari": Source(
        load_minari_id,
        lambda rest: minari_root() / rest,
        lambda rest, task, rng: open_minari_rows(minari_folder(rest), task, rng),
        minari_env_id,
    ),
    "arrays": Source(load_arrays, _folder, open_array_rows),
    "d4rl": Source(load_d4rl, find_d4rl, open_d4rl_rows),
}
"""What stands before the colon of a spec -> its source; a new source is one more row."""


def resolve_task(spec: str, task: Task | str) -> Task:
    """The variant of a task in which the data were recorded.

    Scores are honest only in the physics that the data come from: a task whose name leaves the variant open
    takes that of the data, as far as the data say it. A name with its variant (`hopper-medium@v4`) stands.

    Raises:
        UserError: For an unknown source or task.
        DataError: For data of another task.
    """
    task = get_task(task) if isinstance(task, str) else task
    source, rest = _parse(spec)
    env_id = source.recorded_in(rest)
    if env_id is None:
        return task
    found = task_for_env(task, env_id)
    if found is None:
        fitting = [one.env_id for one in (task, *map(task.variant, () if task.is_pinned else task.variants))]
        raise DataError(
            f"data '{spec}' were recorded in {env_id}, but task '{task.name}' needs "
            f"{' or '.join(dict.fromkeys(fitting))}; choose the task that fits the data, or other data"
        )
    return found


def _parse(spec: str) -> tuple[Source, str]:
    name, colon, rest = spec.partition(":")
    if not colon or name not in SOURCES or not rest:
        raise UserError(f"data is '{spec}', expected one of {_known()}")
    return SOURCES[name], rest


def _known() -> str:
    return ", ".join(f"{name}:..." for name in SOURCES)


def locate(spec: str) -> Path:
    """The file or folder of a data set.

    Raises:
        UserError: An unknown source, or nothing is there.
    """
    source, rest = _parse(spec)
    place = source.locate(rest)
    if not place.exists():
        raise UserError(f"data is '{spec}', but there is nothing at {place}; expected one of {_known()}")
    return place


def stat_hash(spec: str) -> str:
    """Hash of the names, sizes and times of a data set's files: tells changed data without reading them.

    Raises:
        UserError: An unknown source, or nothing is there.
    """
    place = locate(spec)
    files = [place] if place.is_file() else sorted(entry for entry in place.rglob("*") if entry.is_file())
    facts = [(str(f.relative_to(place)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]


def open_rows(spec: str, task: Task, rng: np.random.Generator) -> AbstractContextManager[Recording]:
    """Open a data set for reading single rows, whatever its source, without loading the rest.

    Args:
        spec: As in `load_trajectories`.
        task: From `resolve_task`; the recording has its observations and actions.
        rng: Draws the episodes of a Minari set, which are read from `rows.EPISODES` at most.

    Raises:
        DataError: Data that are damaged or another task's, also while rows are read.
    """
    source, rest = _parse(spec)
    return source.open_rows(rest, task, rng)


def load_trajectories(
    spec: str,
    task: Task | str | None = None,
    *,
    reward: Literal["task", "recorded"] = "task",
) -> Trajectories:
    """Read and check a data set.

    Args:
        spec: `local:DIR`, a folder with one Minari data set; `minari:ID`, a data set under
            MINARI_DATASETS_PATH or ~/.minari/datasets; `d4rl:FILE`, a file of D4RL's, by path or by name;
            `arrays:DIR`, what `Trajectories.save` wrote.
        task: The task that the data must fit; None only checks that they are sound, and keeps recorded
            rewards.
        reward: "task" gives what the task's `data_reward` names: in mazes the reward of its one goal
            (`relabel_to_goal`) or of the recording's (`cut_at_arrivals`), in the kitchen the number of subtasks
            done (`relabel_subtasks`), elsewhere what was recorded. "recorded" keeps that everywhere.

    Raises:
        UserError: For an unknown source.
        DataError: For data that are damaged, incomplete or another task's.
    """
    if reward not in ("task", "recorded"):
        raise UserError(f"reward: found '{reward}', expected 'task' or 'recorded'")
    source, rest = _parse(spec)
    task = resolve_task(spec, task) if task is not None else None
    trajectories = source.load(rest, task)
    if task is None or reward == "recorded" or task.data_reward == "environment":
        return trajectories
    relabel = {"goal": relabel_to_goal, "arrival": cut_at_arrivals, "subtasks": relabel_subtasks}[task.data_reward]
    return relabel(trajectories, task)
