"""The arrays of one of D4RL's files, checked, and after which rows its recordings were cut.

`datamodules.sources.d4rl` shows what the rows mean, and makes episodes of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.sources.hdf5 import check_array, member, read_array, read_rows, row_slices
from datamodules.sources.plausibility import refuse_other_task
from datamodules.sources.source import FIT
from datamodules.validation import DataError, finite, in_box
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of

FIELDS = ("observations", "actions", "rewards", "terminals")
"""Arrays of every file."""

FASTEST = 10.0
"""Speed (m/s) that no body of the mazes reaches; a greater jump between two rows is a reset."""

SAME = 1e-4
"""Two records of one state differ by at most this, absolutely or relatively."""

Flags = NDArray[np.bool_]
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Rows:
    """The file's N rows.

    Attributes:
        observations: (N, O).
        actions: (N, A).
        rewards: (N,).
        terminals: (N,).
        timeouts: (N,), False where the file has none.
        last: (N,) whether the recording was cut after a row, so that the next one is of another episode.
        following: What follows the rows that are `last`, (their number, O), where the file says it.
        walks_on: Whether recordings run on through terminals (AntMaze).
    """

    observations: Floats
    actions: Floats
    rewards: Floats
    terminals: Flags
    timeouts: Flags
    last: Flags
    following: Floats | None
    walks_on: bool


def read_all(file: h5py.File, where: str, task: Task | None, box: tuple[ArrayLike, ArrayLike]) -> Rows:
    """Read and check every row of a file.

    Args:
        file: The open file.
        where: What to call it in messages.
        task: The task that the rows must fit; None only checks that they are valid.
        box: Lowest and highest action, (A,) or a number each.

    Raises:
        DataError: For anything missing, damaged, dangerous or of another task.
    """
    fields = _fields(file, where, task)
    rewards = read_array(fields["rewards"], f"{where}, rewards").reshape(-1)
    terminals = _flags(fields["terminals"], f"{where}, terminals")
    timeouts = _flags(fields["timeouts"], f"{where}, timeouts") if "timeouts" in fields else np.zeros_like(terminals)
    actions = _numbers(fields["actions"], f"{where}, actions", box)
    observations = _numbers(fields["observations"], f"{where}, observations")
    if task is not None:
        refuse_other_task(where, observations, task)
    # Without a task the widths decide: no other body of the table has them.
    walks_on = body_of(task).walks_on if task else (observations.shape[1], actions.shape[1]) == (29, 8)

    last = timeouts.copy() if walks_on else timeouts | terminals
    last[-1] = True
    if task is not None and task.maze_map is not None:
        last[:-1] |= _jumps(observations[:, :2], FASTEST * task.step_seconds)
    following = None
    if "next_observations" in fields:
        following = _following(fields["next_observations"], f"{where}, next_observations", observations, last)
    elif "timeouts" not in fields and task is not None:
        _cut_at_cap(last, task.max_episode_steps)
    return Rows(
        observations=observations,
        actions=actions,
        rewards=finite(f"{where}, rewards", rewards, unit="row"),
        terminals=terminals,
        timeouts=timeouts,
        last=last,
        following=following,
        walks_on=walks_on,
    )


def _fields(file: h5py.File, where: str, task: Task | None) -> dict[str, h5py.Dataset]:
    """The arrays that are read, checked for type, size and shape; `infos` and `metadata` are never touched."""
    found = list(map(str, file))
    if found and found[0].startswith("episode_"):
        raise DataError(f"{where}: it has the layout of Minari's files, one group per episode; read it with local:DIR")
    missing = [key for key in FIELDS if key not in found]
    if missing:
        raise DataError(f"{where}: '{missing[0]}' is missing; found {', '.join(found[:8]) or 'nothing'}")
    keys = (*FIELDS, *(key for key in ("timeouts", "next_observations") if key in found))
    fields = {key: check_array(member(file, key, where), f"{where}, {key}") for key in keys}
    widths = {"observations": task.observation_dim, "actions": task.action_dim} if task else {}
    widths["next_observations"] = fields["observations"].shape[-1]
    rows = len(fields["rewards"])
    for key, dataset in fields.items():
        shape = dataset.shape
        if key in ("rewards", "terminals", "timeouts"):
            fits, expected = shape in ((len(dataset),), (len(dataset), 1)), "(rows,)"
        else:
            fits = len(shape) == 2 and shape[1] == widths.get(key, shape[1]) > 0
            expected = f"(rows, {widths[key]})" if key in widths else "(rows, any)"
        if not fits:
            belongs = f" as task '{task.name}' has it" if task else ""
            remedy = f"; {FIT}" if task and len(shape) == 2 and key in ("observations", "actions") else ""
            raise DataError(f"{where}, {key}: got shape {shape}, expected {expected}{belongs}{remedy}")
        if len(dataset) != rows:
            raise DataError(f"{where}, {key}: got {len(dataset)} rows, but rewards has {rows}")
    if rows == 0:
        raise DataError(f"{where}, rewards: got 0 rows, expected at least 2")
    return fields


def _flags(dataset: h5py.Dataset, where: str) -> Flags:
    """Truth values; D4RL stores some as the numbers 0 and 1."""
    array = read_array(dataset, where).reshape(-1)
    odd = np.flatnonzero((array != 0) & (array != 1))
    if len(odd):
        raise DataError(f"{where}: got {array[odd[0]]} at row {odd[0]}, expected 0 or 1")
    return array.astype(bool)


def _numbers(dataset: h5py.Dataset, where: str, box: tuple[ArrayLike, ArrayLike] | None = None) -> Floats:
    """Finite float32 numbers, read and checked part by part directly into the result."""
    array = np.empty(dataset.shape, np.float32)
    low, high = (np.full(array.shape[1], bound, np.float32) for bound in box or (0, 0))
    for start, stop in row_slices(dataset):
        part = finite(where, read_rows(dataset, where, start, stop), first=start, unit="row")
        array[start:stop] = in_box(where, part, low, high, first=start, unit="row") if box else part
    return array


def _jumps(positions: NDArray[Any], farthest: float) -> Flags:
    """(N - 1,) whether a row's position is out of reach from the one before; positions (N, 2) in metres."""
    return np.hypot(*np.diff(positions, axis=0).T) > farthest


def _following(dataset: h5py.Dataset, where: str, observations: Floats, last: Flags) -> Floats:
    """What follows each `last` row; rows that the next one does not follow are marked as `last`, in place."""
    parts, strays = [], 0
    for start, stop in row_slices(dataset):
        part = finite(where, read_rows(dataset, where, start, stop), first=start, unit="row")
        joined = min(stop, len(observations) - 1)
        here, there = part[: joined - start], observations[start + 1 : joined + 1]
        stray = (np.abs(here - there) > SAME * (1 + np.abs(there))).any(axis=1) & ~last[start:joined]
        last[start:joined] |= stray
        strays += int(stray.sum())
        parts.append(part[last[start:stop]])
    if strays > len(observations) / 10:
        raise DataError(
            f"{where}: {strays} of {len(observations)} rows differ from the next row's observations, though no episode "
            "ends there: the file mixes up its rows"
        )
    return np.concatenate(parts)


def _cut_at_cap(last: Flags, cap: int) -> None:
    """Mark every `cap`-th row of an episode as `last`, in place."""
    ends = np.flatnonzero(last)
    starts = np.append(0, ends[:-1] + 1)
    within = np.arange(len(last)) - np.repeat(starts, ends - starts + 1)
    last |= within % cap == cap - 1
