"""Single rows of one of D4RL's files, read without the rest, and the simulator's states where the file has them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from datamodules.sources.d4rl_rows import FIELDS
from datamodules.sources.fetch import find_d4rl
from datamodules.sources.hdf5 import array_in, member, open_hdf5, read_array, read_rows
from datamodules.sources.source import Recording, check_width
from datamodules.validation import DataError
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of


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
        ends_of_episodes = ["terminals", *(["timeouts"] if "timeouts" in list(file) else [])]
        self.fields = {key: array_in(file, key, where) for key in dict.fromkeys((*FIELDS, *ends_of_episodes))}
        count = len(self.fields["rewards"])
        for key, field in self.fields.items():
            if len(field) != count or field.ndim != (2 if key in ("observations", "actions") else field.ndim):
                raise DataError(f"{where}, {key}: got shape {field.shape}, but rewards has {count} rows")
        self.width = self.fields["observations"].shape[1]
        check_width(where, task, self.width, self.fields["actions"].shape[1])
        self.inner_state = self._inner_state(file, count)
        flags = {key: read_array(self.fields[key], f"{where}, {key}").reshape(-1) > 0 for key in ends_of_episodes}
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
