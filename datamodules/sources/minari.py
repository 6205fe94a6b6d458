"""`local:DIR` and `minari:ID`: Minari data sets, read without trusting them; nothing in a data set is ever run.

Minari's loader builds environments from `metadata.json`, and thereby runs whatever that file names. Here that file is
checked first (`datamodules.sources.metadata`), and HDF5 is read directly, episode by episode, and only as much of it as
the task's observations need.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from datamodules.sources.hdf5 import MAX_RATIO, SMALL, array_in, check_array, group_in, member, open_hdf5, read_rows
from datamodules.sources.metadata import action_box, check_task, observation_layout, one_line, read_metadata
from datamodules.sources.observations import Layout
from datamodules.sources.source import Recording, Source
from datamodules.trajectories import Trajectories
from datamodules.validation import FIELDS, DataError, validate_episode
from dds_lightning.errors import UserError
from dds_lightning.saving.files import expand, home, mend_folder
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import Part

Fields = dict[str, Any]


def local_env_id(directory: str | Path) -> str | None:
    """The environment that the data set in a folder was recorded in; None where it does not say."""
    spec = read_metadata(data_folder(directory))["env_spec"]
    return None if spec is None else str(spec["id"])


def check_minari_id(dataset_id: str) -> str:
    """The id itself.

    Raises:
        UserError: For anything that is not an id, such as a path out of the store.
    """
    if not re.fullmatch(r"[\w-]+(/[\w-]+)*", dataset_id):
        raise UserError(f"data: '{dataset_id}' is not a Minari id, expected one like pointmaze-large-diverse-v0")
    return dataset_id


def minari_folder(dataset_id: str) -> Path:
    """The folder of a data set in Minari's local store.

    Raises:
        UserError: For anything that is not an id.
        DataError: When the data set does not exist.
    """
    folder = minari_root() / check_minari_id(dataset_id)
    if not folder.is_dir():
        raise DataError(
            f"data set '{dataset_id}' is not in {minari_root()}; collect it with `dds data collect`, "
            "download it with `minari download`, or set MINARI_DATASETS_PATH"
        )
    return folder


def minari_root() -> Path:
    """Where Minari keeps its data sets: MINARI_DATASETS_PATH, else ~/.minari/datasets."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or home() / ".minari" / "datasets")


def load_local(directory: str | Path, task: Task | None) -> Trajectories:
    """Read the Minari data set in a folder (`DIR/data/main_data.hdf5` and `metadata.json`).

    Memory is needed for the result and one episode, whatever else the file stores.

    Args:
        directory: The folder.
        task: What the data must fit, from `resolve_task`; None accepts every known layout.

    Raises:
        DataError: For anything missing, damaged, dangerous or of another task.
    """
    data = data_folder(directory)
    metadata = read_metadata(data)
    if task is not None:
        check_task(metadata, task)
    layout, (low, high) = observation_layout(metadata, task), action_box(metadata, task)
    reader = _Reader(data / "main_data.hdf5", metadata["dataset_id"], layout, low, high)
    lengths, arrays = reader.read(metadata.get("total_episodes"), metadata.get("total_steps"))
    return Trajectories(name=reader.name, lengths=lengths, action_low=low, action_high=high, **arrays)


def data_folder(directory: str | Path) -> Path:
    """The folder with `main_data.hdf5` and `metadata.json`: `data` in a data set's folder, or that folder itself."""
    folder = expand(directory)
    with contextlib.suppress(OSError):
        mend_folder(folder)
    return folder / "data" if (folder / "data").is_dir() else folder


class _Reader:
    """Reads the episodes of one file.

    Args:
        path: main_data.hdf5.
        name: Of the data set, for messages.
        layout: How observations are flattened.
        low: (A,) lower bounds of actions.
        high: (A,) upper bounds.
    """

    def __init__(
        self, path: Path, name: str, layout: Layout, low: NDArray[np.float32], high: NDArray[np.float32]
    ) -> None:
        self.path, self.name, self.layout, self.low, self.high = path, name, layout, low, high
        self.width = layout.width
        self.bytes = 0

    def read(self, episodes: int | None, steps: int | None) -> tuple[NDArray[np.int64], Fields]:
        """Every episode, checked by `validate_episode`.

        Args:
            episodes: Number that the metadata promise; None if they do not.
            steps: Likewise, of all episodes.

        Returns:
            Lengths (E,), and the arrays of all episodes end to end, as in `Trajectories`.
        """
        with open_hdf5(self.path, f"data set '{self.name}'", self.path.parent) as file:
            names = set(map(str, file))  # asking the file for a single name would follow links
            labels = [f"episode_{number}" for number in range(len(names))]
            self._check_promise("episodes", episodes, len(labels))
            if not labels:
                raise DataError(f"data set '{self.name}' is empty: it has no episodes")
            missing = next((label for label in labels if label not in names), None)
            if missing is not None:
                raise DataError(f"data set '{self.name}': {self.path} has {len(labels)} episodes, but no {missing}")
            lengths = np.array([self._steps(file, label) for label in labels], np.int64)
            self._check_promise("steps", steps, int(lengths.sum()))
            return lengths, self._arrays(file, labels, lengths)

    def _check_promise(self, what: str, promised: int | None, found: int) -> None:
        if promised is not None and found != promised:
            raise DataError(
                f"data set '{self.name}': metadata.json promises {promised} {what}, but {self.path} has {found}"
            )

    def _steps(self, file: h5py.File, label: str) -> int:
        where = f"data set '{self.name}', {label}"
        rewards = check_array(member(self._group(file, label), "rewards", where), f"{where}, rewards")
        self._count(rewards.nbytes)
        return len(rewards)

    def _arrays(self, file: h5py.File, labels: list[str], lengths: NDArray[np.int64]) -> Fields:
        arrays: Fields = {}
        step = 0
        for number, label in enumerate(labels):
            fields = self._episode(file, label)
            if not arrays:
                self.width = fields["observations"].shape[1]  # without a task, all have the width of the first
                arrays = self._empty(fields, int(lengths.sum()), len(labels))
            for key, one in fields.items():
                first = step + (number if key == "observations" else 0)
                arrays[key][first : first + len(one)] = one
            step += int(lengths[number])
        return arrays

    def _empty(self, fields: Fields, steps: int, episodes: int) -> Fields:
        """Empty arrays for all episodes; `fields` are those of one."""
        rows = {key: steps + (episodes if key == "observations" else 0) for key in fields}
        self._check_total(sum(rows[key] * one[:1].nbytes for key, one in fields.items()))
        return {key: np.empty((rows[key], *one.shape[1:]), one.dtype) for key, one in fields.items()}

    def _episode(self, file: h5py.File, label: str) -> Fields:
        where, group = f"data set '{self.name}', {label}", self._group(file, label)
        fields = {}
        for key in FIELDS:
            read = self._observations if key == "observations" else self._array
            fields[key] = read(member(group, key, where), f"{where}, {key}")
        return validate_episode(
            self.name, label, fields, observation_dim=self.width, action_low=self.low, action_high=self.high
        )

    def _group(self, file: h5py.File, label: str) -> h5py.Group:
        where = f"data set '{self.name}', {label}"
        group = member(file, label, f"data set '{self.name}'")
        if not isinstance(group, h5py.Group):
            raise DataError(f"{where}: got an array, expected a group of {', '.join(FIELDS)}")
        found = list(map(str, group))
        missing = next((key for key in FIELDS if key not in found), None)
        if missing:
            raise DataError(f"{where}: '{missing}' is missing; found {one_line(', '.join(found)) or 'nothing'}")
        return group

    def _observations(self, node: Any, where: str) -> NDArray[Any]:
        if not self.layout.parts:
            return self._array(node, where)
        if not isinstance(node, h5py.Group):
            raise DataError(f"{where}: got an array, expected a group, for the observation space is {self.layout}")
        arrays = {key: self._part(node, key, part, where) for key, part in self.layout.parts.items()}
        rows = {key: len(array) for key, array in arrays.items()}
        if len(set(rows.values())) > 1:
            found = " and ".join(f"{count} rows of {key}" for key, count in rows.items())
            raise DataError(f"{where}: got {found}, expected the same number")
        return self.layout.flatten(arrays)

    def _part(self, group: h5py.Group, key: str, part: Part, where: str) -> NDArray[Any]:
        found = list(map(str, group))
        if key not in found:
            raise DataError(f"{where}: got the entries {one_line(', '.join(found)) or 'none'}, expected '{key}'")
        node, where = member(group, key, where), f"{where}/{key}"
        array = check_array(node, where)
        if len(array.shape) != 2 or array.shape[1] not in (part.widths or array.shape[1:]):
            expected = " or ".join(f"(steps, {width})" for width in part.widths) or "(steps, width)"
            raise DataError(f"{where}: got shape {array.shape}, expected {expected}")
        self._count(array.nbytes)
        return read_rows(array, where, 0, len(array), part.columns)

    def _array(self, node: Any, where: str) -> NDArray[Any]:
        array = check_array(node, where)
        self._count(array.nbytes)
        return read_rows(array, where, 0, len(array))

    def _count(self, size: int) -> None:
        """Add up what is read: many episodes may share one array, or each be highly compressed."""
        self.bytes += size
        self._check_total(self.bytes)

    def _check_total(self, size: int) -> None:
        if size > max(SMALL, MAX_RATIO * self.path.stat().st_size):
            raise DataError(
                f"data set '{self.name}': the arrays of {self.path} are more than {MAX_RATIO} times as large as the "
                "file, which is not plausible"
            )


# ---------------------------------------------------------------------- single rows

EPISODES = 100
"""Episodes from which single rows are read: each costs a few look-ups in the file."""


@contextlib.contextmanager
def open_local(directory: str | Path, task: Task, rng: np.random.Generator) -> Iterator[Recording]:
    """Open the Minari data set in a folder for reading single rows; see `Source.open_rows`."""
    data = data_folder(directory)
    metadata = read_metadata(data)
    check_task(metadata, task)
    with open_hdf5(data / "main_data.hdf5", f"data set '{metadata['dataset_id']}'", data) as file:
        yield _MinariRows(file, metadata, task, rng)


class _MinariRows:
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
        group = group_in(file, label, self.where)
        fields = {key: array_in(group, key, where) for key in ("actions", "rewards", "terminations")}
        steps = len(fields["rewards"])
        if not self.layout.parts:
            fields["observations"] = array_in(group, "observations", where)
        else:
            inner = group_in(group, "observations", where)
            seen = f"{where}, observations"
            fields |= {f"observations/{key}": array_in(inner, key, seen) for key in self.layout.parts}
        for key, field in fields.items():
            is_state = key.startswith("observations")
            if len(field) != steps + is_state or field.ndim != (2 if is_state or key == "actions" else 1) or not steps:
                expected = f"{steps + is_state} rows, for rewards has {steps}"
                raise DataError(f"{where}, {key}: got shape {field.shape}, expected {expected}")
        return fields

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        fields = self.episodes[episode]
        keys = [key for key in fields if key.startswith("observations")]
        widths: list[int | None] = [part.columns for part in self.layout.parts.values()] or [None]
        # Here the kitchen keeps its velocities, which `Layout.flatten` leaves out.
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


LOCAL = Source(
    rest="DIR",
    about="a folder with a Minari data set",
    load=load_local,
    locate=lambda directory: expand(directory),
    open_rows=open_local,
    again="collect or download the data set again",
    recorded_in=local_env_id,
)

MINARI = Source(
    rest="ID",
    about="a data set in Minari's local store",
    load=lambda dataset_id, task: load_local(minari_folder(dataset_id), task),
    locate=lambda dataset_id: minari_root() / check_minari_id(dataset_id),
    open_rows=lambda dataset_id, task, rng: open_local(minari_folder(dataset_id), task, rng),
    again=LOCAL.again,
    recorded_in=lambda dataset_id: local_env_id(minari_folder(dataset_id)),
)
"""`local` under a folder that the id names."""
