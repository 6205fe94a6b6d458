"""Lists the data sets on this machine; what `dds data list` prints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from datamodules.sources.fetch import d4rl_root
from datamodules.sources.hdf5 import check_array, member, open_hdf5, read_array, read_rows
from datamodules.sources.metadata import read_metadata
from datamodules.sources.minari import minari_root
from datamodules.sources.plausibility import refuse_other_task
from datamodules.storage import read_arrays
from datamodules.trajectories import DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task, task_for_env, task_names

HEAD = 10_000
"""Rows of a D4RL file that are inspected."""

COLUMNS = ["data set", "data", "environment", "tasks", "episodes", "steps", "problem"]


def find_datasets(roots: Iterable[str | Path] = ()) -> pd.DataFrame:
    """The data sets in Minari's folder, in D4RL's and in others, reading only their outlines.

    Args:
        roots: Folders to search besides MINARI_DATASETS_PATH (or ~/.minari/datasets) and D4RL_DATASET_DIR (or
            ~/.d4rl/datasets). Minari data sets and folders of arrays are found at any depth, D4RL's files in
            the folder itself.

    Returns:
        One row a data set: `data set`, `data` (what to pass on as --data), `environment` ("" where the format
        does not say), `tasks` (names of those it fits, one where its name says which), `episodes`, `steps` and
        `problem`, which is empty when its outline is sound.
    """
    rows: dict[Path, dict[str, Any]] = {}
    for root in (minari_root(), d4rl_root(), *map(Path, roots)):
        for path, row in (*_minari(root), *_arrays(root), *_d4rl(root)):
            rows.setdefault(path.resolve(), row)
    return pd.DataFrame(list(rows.values()), columns=COLUMNS)


def fitting_tasks(name: str, env_id: str = "", widths: tuple[int, int] | None = None) -> tuple[str, ...]:
    """The tasks that a data set fits, judged by its outline; `env_id` or `widths` must be known.

    Args:
        name: Name of the data set or file; a name from the task table decides between tasks that all fit.
        env_id: Environment in which it was recorded; empty if unknown.
        widths: Widths of its observations and actions; None if unknown.
    """
    possible = [
        task
        for task in map(get_task, task_names())
        if (not env_id or task_for_env(task, env_id) is not None)
        and (widths is None or widths == (task.observation_dim, task.action_dim))
    ]
    stem = name.removesuffix(".hdf5")
    named = [task for task in possible if stem in {known.removesuffix(".hdf5") for known in task.data_ids.values()}]
    return tuple(task.name for task in named or possible if env_id or widths)


def _minari(root: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for path in _visible(root, "**/data/metadata.json"):
        home = path.parent.parent
        row = {"data set": home.relative_to(root).as_posix(), "data": f"local:{home}"}
        try:
            metadata = read_metadata(home / "data")
            env_id = (metadata["env_spec"] or {}).get("id", "")
            tasks = fitting_tasks(str(metadata.get("dataset_id", row["data set"])), env_id)
            counts = metadata.get("total_episodes", 0), metadata.get("total_steps", 0)
            yield home, {**row, **_outline(env_id, tasks, *counts)}
        except UserError as error:
            yield home, {**row, **_outline(problem=str(error))}


def _arrays(root: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for path in _visible(root, "**/trajectories.json"):
        home = path.parent
        row = {"data set": home.relative_to(root).as_posix(), "data": f"arrays:{home}"}
        types = {"lengths": np.int64, "observations": np.float32, "actions": np.float32}
        try:
            facts, arrays = read_arrays(home, types, mmap=True)
            widths = _width(arrays["observations"], "observations"), _width(arrays["actions"], "actions")
            tasks = fitting_tasks(str(facts["name"]), widths=widths)
            lengths = arrays["lengths"]
            if lengths.ndim != 1:
                raise DataError(f"lengths: got shape {lengths.shape}, expected (episodes,)")
            yield home, {**row, **_outline("", tasks, len(lengths), int(lengths.sum()))}
        except UserError as error:
            yield home, {**row, **_outline(problem=str(error))}


def _d4rl(root: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for path in _visible(root, "*.hdf5"):
        row = {"data set": path.name, "data": f"d4rl:{path}"}
        try:
            yield path, {**row, **_d4rl_outline(path)}
        except UserError as error:
            yield path, {**row, **_outline(problem=str(error))}


def _d4rl_outline(path: Path) -> dict[str, Any]:
    where = f"data set '{path.name}'"
    with open_hdf5(path, where) as file:
        fields = {
            key: check_array(member(file, key, where), f"{where}, {key}")
            for key in ("observations", "actions", "terminals", "timeouts")
            if key in file
        }
        if missing := {"observations", "actions", "terminals"} - fields.keys():
            raise DataError(f"{where}: '{min(missing)}' is missing; found {', '.join(map(str, file)) or 'nothing'}")
        widths = _width(fields["observations"], where), _width(fields["actions"], where)
        first = read_rows(fields["observations"], where, 0, HEAD)
        ends = np.zeros(len(fields["terminals"]), bool)
        for key in fields.keys() - {"observations", "actions"}:
            flags = read_array(fields[key], where).reshape(-1)
            if len(flags) != len(ends):
                raise DataError(f"{where}, {key}: got {len(flags)} rows, but terminals has {len(ends)}")
            ends |= flags.astype(bool)
    names = tuple(name for name in fitting_tasks(path.name, widths=widths) if _may_hold(where, first, name))
    return _outline("", names, int(ends.sum()) + int(not ends[-1:].all()), len(ends))


def _may_hold(where: str, observations: NDArray[Any], name: str) -> bool:
    try:
        refuse_other_task(where, observations, get_task(name))
    except DataError:
        return False
    return True


def _visible(root: Path, pattern: str) -> list[Path]:
    """Matches below a folder that are not hidden, as half-written data sets are."""
    return [
        path
        for path in sorted(root.glob(pattern))
        if not any(part.startswith(".") for part in path.relative_to(root).parts)
    ]


def _width(array: Any, name: str) -> int:
    if len(array.shape) != 2:
        raise DataError(f"{name}: got shape {tuple(array.shape)}, expected (steps, width)")
    return int(array.shape[1])


def _outline(
    env_id: str = "", tasks: tuple[str, ...] = (), episodes: int = 0, steps: int = 0, problem: str = ""
) -> dict[str, Any]:
    return {"environment": env_id, "tasks": tasks, "episodes": episodes, "steps": steps, "problem": problem}
