"""`d4rl:FILE`: D4RL's HDF5 files, flat rows of steps that do not say which environment they are from.

Row t holds the state before step t, its action, and what the step gave. The state after it is in row t + 1,
unless the recording was cut there:

    row              0      1      2      3      4      5
    observations     s0     s1     s2     s3     s0'    s1'
    actions          a0     a1     a2    (a3)    a0'    a1'
    timeouts         -      -      -      1      -      -
    terminals        -      -      -      -      -      1

    episode 0: s0 a0 s1 a1 s2 a2 s3          truncated; where a3 led is unknown, so that step is left out
    episode 1: s0' a0' s1' a1' s1'           terminated; see below

A file with `next_observations` says where each last step led, so none is lost. Without them a *termination* is
kept nevertheless: it shows the learner where the task ends. The state after it repeats the last one, and since
nothing is bootstrapped from there, its value never counts.

An episode ends at a terminal, at a time-out, at the end of the file, in mazes where the position jumps farther
than the body can move in one step (old files lack some time-outs), and where `next_observations` differ from the
next row. Where a file has neither time-outs nor `next_observations` (the kitchen's), episodes are cut at the
task's cap, as D4RL does.

AntMaze is different. The recorded ant walks on through the evaluation goal, and rewards and terminals were
computed afterwards, each from the position in the *next row*, whatever was recorded there:

    row              0      1      2      3      4      5      6
    on the goal      -      -     yes    yes     -      -     yes
    rewards          0      1      1      0      0      1      0
    terminals        0      1      1      0      0      1      0
    timeouts         -      -      -      -      -      1      -

    episode 0: s0 a0 s1 a1 s2                terminated: the reward of a1 is paid for s2
               s3                            left out, like all that stands on the goal
    episode 1: s4 a4 s5                      truncated: row 6 is another recording, so terminals[5] speaks of its
                                             first state, which is left out

So `terminals[t]` says that row t + 1 stands on the goal. Only where a recording ends without a time-out does a
terminal mean what it means elsewhere: the episode was over then and there.

Rewards stay as recorded; in the kitchen's files they count the subtasks done in the row's state.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.sources.fetch import find_d4rl
from datamodules.sources.goal import cut_at_goal, ends_of
from datamodules.sources.hdf5 import array_in, check_array, member, open_hdf5, read_array, read_rows, row_slices
from datamodules.sources.plausibility import refuse_other_task
from datamodules.sources.source import FIT, Recording, Source, check_width
from datamodules.trajectories import Trajectories
from datamodules.validation import DataError, finite, in_box
from datamodules.windows import ranges
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


def load_d4rl(name: str, task: Task | None) -> Trajectories:
    """Read one of D4RL's files, or another file in the same layout; nothing in it is ever run.

    Args:
        name: Path of the file, or a name that `find_d4rl` knows.
        task: The task that the data must fit; None only checks that they are valid.

    Raises:
        DataError: For anything missing, damaged, dangerous or of another task.
    """
    path = find_d4rl(name)
    where = f"data set '{path.name}'"
    low, high = task.action_box() if task else (-1.0, 1.0)
    with open_hdf5(path, where) as file:
        rows = _read(file, where, task, low, high)
    if not (rows.last[:-1].any() or rows.terminals.any() or rows.timeouts.any()):
        raise DataError(
            f"{where}, terminals: none of the {len(rows.last)} rows is marked as an episode's last, there or in "
            "timeouts, so it has no complete episode"
        )
    return _episodes(rows, path.stem, where, low, high)


@dataclass(frozen=True, eq=False)
class _Rows:
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


# ---------------------------------------------------------------------- from rows to episodes


def _episodes(rows: _Rows, name: str, where: str, low: ArrayLike, high: ArrayLike) -> Trajectories:
    """Cut rows into episodes; see the pictures above.

    S states are laid out first: those of the rows, and after a `last` row one more where it is known or where the
    task ended there. `cut_at_goal` then ends episodes where a state stands on the goal, or is such an end.
    """
    terminals, timeouts, last = rows.terminals, rows.timeouts, rows.last
    over = terminals & last & ~(timeouts & rows.walks_on)  # the task ended in what follows this very row
    extra = last if rows.following is not None else over
    row_of = np.repeat(np.arange(len(last)), 1 + extra)  # (S,)
    end_of = np.cumsum(1 + extra) - 1  # (N,) the last state that a row has part in
    added = np.zeros(len(row_of), bool)
    added[end_of[extra]] = True
    ended = np.zeros(len(row_of), bool)
    if rows.walks_on:
        ended[1:] = (terminals & (~last | timeouts))[row_of - 1][1:]
        ended[added] = False
    ended[end_of[over]] = True

    first, final, reached = cut_at_goal(ended, np.diff(np.append(-1, end_of[last])))
    if not len(first):
        raise DataError(f"{where}, observations: no row leads to another one, so it has no complete episode")
    lengths = final - first
    steps, states = row_of[ranges(first, lengths)], ranges(first, lengths + 1)
    observations = rows.observations[row_of[states]]
    if rows.following is not None:
        known = added[states]
        observations[known] = rows.following[np.searchsorted(np.flatnonzero(added), states[known])]
    terminations, truncations = ends_of(lengths, reached)
    return Trajectories(
        name=name,
        observations=observations,
        actions=rows.actions[steps],
        rewards=rows.rewards[steps],
        terminations=terminations,
        truncations=truncations,
        lengths=lengths,
        steps_left_out=len(last) - len(steps),
        action_low=np.full(rows.actions.shape[1], low, np.float32),
        action_high=np.full(rows.actions.shape[1], high, np.float32),
    )


# ---------------------------------------------------------------------- reading rows


def _read(file: h5py.File, where: str, task: Task | None, low: ArrayLike, high: ArrayLike) -> _Rows:
    fields = _fields(file, where, task)
    rewards = read_array(fields["rewards"], f"{where}, rewards").reshape(-1)
    terminals = _flags(fields["terminals"], f"{where}, terminals")
    timeouts = _flags(fields["timeouts"], f"{where}, timeouts") if "timeouts" in fields else np.zeros_like(terminals)
    actions = _numbers(fields["actions"], f"{where}, actions", (low, high))
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
    return _Rows(
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


# ---------------------------------------------------------------------- single rows


@contextlib.contextmanager
def open_d4rl(name: str, task: Task, rng: np.random.Generator) -> Iterator[Recording]:
    """Open one of D4RL's files for reading single rows; see `Source.open_rows`."""
    path = find_d4rl(name)
    where = f"data set '{path.name}'"
    with open_hdf5(path, where) as file:
        yield _D4RLRows(file, where, task)


class _D4RLRows:
    """One of D4RL's files; no file says what follows an episode's last row."""

    def __init__(self, file: h5py.File, where: str, task: Task) -> None:
        self.where = where
        keys = ["observations", "actions", "rewards", "terminals", *(["timeouts"] if "timeouts" in list(file) else [])]
        self.fields = {key: array_in(file, key, where) for key in keys}
        count = len(self.fields["rewards"])
        for key, field in self.fields.items():
            if len(field) != count or field.ndim != (2 if key in ("observations", "actions") else field.ndim):
                raise DataError(f"{where}, {key}: got shape {field.shape}, but rewards has {count} rows")
        self.width = self.fields["observations"].shape[1]
        check_width(where, task, self.width, self.fields["actions"].shape[1])
        self.inner_state = self._inner_state(file, count)
        flags = {key: read_array(self.fields[key], f"{where}, {key}").reshape(-1) > 0 for key in keys[3:]}
        # D4RL's ants walk on through the goal, where rewards and terminals were computed afterwards.
        last = flags.get("timeouts", np.zeros(count, bool)) | (flags["terminals"] & (not body_of(task).walks_on))
        last[-1:] = True
        ends = np.flatnonzero(last)
        self.first = np.append(0, ends[:-1] + 1)
        self.steps = ends - self.first + 1
        self.known = self.steps - 1
        self.ended = flags["terminals"][ends]

    def _inner_state(self, file: h5py.File, count: int) -> list[h5py.Dataset]:
        """`infos/qpos` and `infos/qvel`, where the file has both."""
        infos = member(file, "infos", self.where) if "infos" in list(file) else None
        if not isinstance(infos, h5py.Group) or not {"qpos", "qvel"} <= set(infos):
            return []
        found = [array_in(infos, key, f"{self.where}, infos") for key in ("qpos", "qvel")]
        return found if all(field.ndim == 2 and len(field) == count for field in found) else []

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        return self._rows("observations", episode, start, stop)

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        return self._rows("actions", episode, start, stop), self._rows("rewards", episode, start, stop).reshape(-1)

    def _rows(self, key: str, episode: int, start: int, stop: int) -> NDArray[Any]:
        first = int(self.first[episode])
        return read_rows(self.fields[key], f"{self.where}, {key}", first + start, first + stop)

    def inner(self, episode: int, step: int) -> Any:
        row = int(self.first[episode]) + step
        return tuple(read_rows(field, f"{self.where}, infos", row, row + 1)[0] for field in self.inner_state) or None


D4RL = Source("FILE", "an HDF5 file in D4RL's layout", load_d4rl, find_d4rl, open_d4rl, "get or write the file anew")
