"""Reads single rows of a recording's episodes, whatever its source, without loading the rest."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
from numpy.typing import NDArray

from datamodules.sources.fetch import find_d4rl
from datamodules.sources.hdf5 import check_array, member, open_hdf5, read_array, read_rows
from datamodules.sources.metadata import check_task, observation_layout, read_metadata
from datamodules.sources.minari import minari_root
from datamodules.trajectories import Trajectories
from datamodules.validation import DataError
from dds_lightning.tasks import Task

EPISODES = 100
"""Episodes of a Minari set that steps are drawn from: each costs a few look-ups in the file."""


class Recording(Protocol):
    """Episodes whose rows can be read one by one.

    Attributes:
        where: The data set, as messages begin.
        width: W.
        steps: (E,) steps of each episode.
        known: (E,) how many of them lead to a recorded state.
        ended: (E,) whether the last step terminated the episode.
    """

    where: str
    width: int
    steps: NDArray[np.int64]
    known: NDArray[np.int64]
    ended: NDArray[np.bool_]

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        """Rows of observations, (stop - start, W)."""
        ...

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Actions (stop - start, A) and rewards (stop - start,)."""
        ...

    def inner(self, episode: int, step: int) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """The simulator's own qpos and qvel, if they are recorded."""
        ...


@contextlib.contextmanager
def open_recording(spec: str, task: Task, rng: np.random.Generator) -> Iterator[Recording]:
    """Open a data set for reading single rows.

    Args:
        spec: As in `load_trajectories`.
        task: From `resolve_task`, whose observations and actions the recording has.
        rng: Draws the episodes of a Minari set, which are read from `EPISODES` at most.

    Raises:
        DataError: For data that are damaged or another task's, also while rows are read.
    """
    source, _, rest = spec.partition(":")
    if source == "arrays":
        yield _Arrays(rest, task)
        return
    if source == "d4rl":
        path = find_d4rl(rest)
        with open_hdf5(path, f"data set '{path.name}'") as file:
            yield _D4RL(file, f"data set '{path.name}'", task)
        return
    folder = minari_root() / rest if source == "minari" else Path(rest).expanduser()
    data = folder / "data" if (folder / "data").is_dir() else folder
    metadata = read_metadata(data)
    check_task(metadata, task)
    with open_hdf5(data / "main_data.hdf5", f"data set '{metadata['dataset_id']}'") as file:
        yield _Minari(file, metadata, task, rng)


class _Arrays:
    """What `Trajectories.save` wrote."""

    def __init__(self, directory: str, task: Task) -> None:
        self.data = Trajectories.load(directory, mmap=True)
        self.where, self.width = f"data set '{self.data.name}'", self.data.observation_dim
        _check_width(self.where, task, self.width, self.data.action_dim)
        self.steps = self.known = self.data.lengths
        self.ended = self.data.terminations[self.data.step_offsets[1:] - 1]

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        first = self.data.observation_offsets[episode]
        return self.data.observations[first + start : first + stop]

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        rows = slice(self.data.step_offsets[episode] + start, self.data.step_offsets[episode] + stop)
        return self.data.actions[rows], self.data.rewards[rows]

    def inner(self, episode: int, step: int) -> None:
        return None


class _D4RL:
    """One of D4RL's files; what follows an episode's last row is in none."""

    def __init__(self, file: h5py.File, where: str, task: Task) -> None:
        self.where = where
        keys = ["observations", "actions", "rewards", "terminals", *(["timeouts"] if "timeouts" in list(file) else [])]
        self.fields = {key: _field(file, key, where) for key in keys}
        count = len(self.fields["rewards"])
        for key, field in self.fields.items():
            if len(field) != count or field.ndim != (2 if key in ("observations", "actions") else field.ndim):
                raise DataError(f"{where}, {key}: found shape {field.shape}, but rewards has {count} rows")
        self.width = self.fields["observations"].shape[1]
        _check_width(where, task, self.width, self.fields["actions"].shape[1])
        self.own = self._own(file, count)
        flags = {key: read_array(self.fields[key], f"{where}, {key}").reshape(-1) > 0 for key in keys[3:]}
        # D4RL's ants walk on through the goal, where rewards and terminals were computed afterwards.
        last = flags.get("timeouts", np.zeros(count, bool)) | (flags["terminals"] & (task.family != "antmaze"))
        last[-1:] = True
        ends = np.flatnonzero(last)
        self.first = np.append(0, ends[:-1] + 1)
        self.steps = ends - self.first + 1
        self.known = self.steps - 1
        self.ended = flags["terminals"][ends]

    def _own(self, file: h5py.File, count: int) -> list[h5py.Dataset]:
        """`infos/qpos` and `infos/qvel`, where the file has both."""
        infos = member(file, "infos", self.where) if "infos" in list(file) else None
        if not isinstance(infos, h5py.Group) or not {"qpos", "qvel"} <= set(infos):
            return []
        own = [_field(infos, key, f"{self.where}, infos") for key in ("qpos", "qvel")]
        return own if all(field.ndim == 2 and len(field) == count for field in own) else []

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        return self._rows("observations", episode, start, stop)

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        rewards = self._rows("rewards", episode, start, stop)
        return self._rows("actions", episode, start, stop), rewards.reshape(-1)

    def _rows(self, key: str, episode: int, start: int, stop: int) -> NDArray[Any]:
        first = int(self.first[episode])
        return read_rows(self.fields[key], f"{self.where}, {key}", first + start, first + stop)

    def inner(self, episode: int, step: int) -> Any:
        row = int(self.first[episode]) + step
        return tuple(read_rows(field, f"{self.where}, infos", row, row + 1)[0] for field in self.own) or None


class _Minari:
    """Some episodes, spread over the set, of a Minari data set."""

    def __init__(self, file: h5py.File, metadata: dict[str, Any], task: Task, rng: np.random.Generator) -> None:
        self.where = f"data set '{metadata['dataset_id']}'"
        self.layout = observation_layout(metadata, task)
        labels = sorted(file, key=lambda label: (len(label), label))
        if not labels:
            raise DataError(f"{self.where} is empty: it has no episodes")
        chosen = np.sort(rng.choice(len(labels), min(EPISODES, len(labels)), replace=False))
        self.episodes = [self._episode(file, labels[number]) for number in chosen]
        self.steps = self.known = np.array([len(episode["rewards"]) for episode in self.episodes])
        self.ended = np.array(
            [
                bool(read_rows(episode["terminations"], self.where, count - 1, count)[0])
                for episode, count in zip(self.episodes, self.steps.tolist(), strict=True)
            ]
        )
        self.width = self.states(0, 0, 1).shape[1]

    def _episode(self, file: h5py.File, label: str) -> dict[str, h5py.Dataset]:
        where = f"{self.where}, {label}"
        group = _group(member(file, label, self.where), where)
        fields = {key: _field(group, key, where) for key in ("actions", "rewards", "terminations")}
        steps = len(fields["rewards"])
        if not self.layout.parts:
            fields["observations"] = _field(group, "observations", where)
        else:
            inner = _group(member(group, "observations", where), f"{where}, observations")
            fields |= {f"observations/{key}": _field(inner, key, f"{where}, observations") for key in self.layout.parts}
        for key, field in fields.items():
            seen = key.startswith("observations")
            if len(field) != steps + seen or field.ndim != (2 if seen or key == "actions" else 1) or not steps:
                expected = f"{steps + seen} rows, for rewards has {steps}"
                raise DataError(f"{where}, {key}: found shape {field.shape}, expected {expected}")
        return fields

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        fields = self.episodes[episode]
        keys = [key for key in fields if key.startswith("observations")]
        widths: list[int | None] = [part.columns for part in self.layout.parts.values()] or [None]
        # The kitchen's velocities are kept here, which `Layout.flatten` leaves out.
        parts = [
            read_rows(fields[key], f"{self.where}, {key}", start, stop, width)
            for key, width in zip(keys, widths, strict=True)
        ]
        return np.concatenate(parts, axis=1)

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        fields = self.episodes[episode]
        actions, rewards = (
            read_rows(fields[key], f"{self.where}, {key}", start, stop) for key in ("actions", "rewards")
        )
        return actions, rewards

    def inner(self, episode: int, step: int) -> None:
        return None


def _group(node: Any, where: str) -> h5py.Group:
    if not isinstance(node, h5py.Group):
        raise DataError(f"{where}: found an array, expected a group")
    return node


def _field(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    found = list(group)
    if key not in found:
        raise DataError(f"{where}: '{key}' is missing; found {', '.join(found[:8]) or 'nothing'}")
    return check_array(member(group, key, where), f"{where}, {key}")


def _check_width(where: str, task: Task, observations: int, actions: int) -> None:
    for name, found, expected in (
        ("observations", observations, task.observation_dim),
        ("actions", actions, task.action_dim),
    ):
        if found != expected:
            raise DataError(f"{where}, {name}: found {found} columns, task '{task.name}' needs {expected}")
