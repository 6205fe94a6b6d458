"""Reads Minari data sets without trusting them: nothing in a data set is ever run.

Minari's own loader builds environments from `metadata.json`, and with them whatever that file names. Here the
JSON is read first, both spaces must be there, the environment must be one of the task table, and HDF5 is read
directly.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from datamodules.trajectories import Trajectories
from datamodules.validation import FIELDS, DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, known_env_ids

_TRUSTED_PACKAGES = ("gymnasium", "gymnasium_robotics")


def load_minari_id(dataset_id: str, task: Task | None) -> Trajectories:
    """Read a data set of Minari's local store, by its id."""
    return load_local(str(_minari_folder(dataset_id)), task)


def minari_env_id(dataset_id: str) -> str | None:
    """The environment that a data set of Minari's local store was recorded in; None where it does not say."""
    return local_env_id(str(_minari_folder(dataset_id)))


def local_env_id(directory: str) -> str | None:
    """The same for a folder."""
    spec = read_metadata(_data_folder(directory))["env_spec"]
    return None if spec is None else str(spec["id"])


def _minari_folder(dataset_id: str) -> Path:
    if not re.fullmatch(r"[\w-]+(/[\w-]+)*", dataset_id):
        raise UserError(f"data: '{dataset_id}' is no Minari id; one is pointmaze-large-diverse-v0")
    folder = minari_root() / dataset_id
    if not folder.is_dir():
        raise DataError(
            f"data set '{dataset_id}' is not in {minari_root()}; collect it with `dds data collect`, "
            "download it with `minari download`, or set MINARI_DATASETS_PATH"
        )
    return folder


def minari_root() -> Path:
    """Where Minari keeps its data sets: MINARI_DATASETS_PATH, else ~/.minari/datasets."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


def load_local(directory: str, task: Task | None) -> Trajectories:
    """Read the Minari data set in a folder (`DIR/data/main_data.hdf5` and `metadata.json`).

    Raises:
        DataError: For anything missing, damaged, dangerous or of another task.
    """
    data = _data_folder(directory)
    metadata = read_metadata(data)
    name = str(metadata.get("dataset_id", Path(directory).name))
    if task is not None:
        _check_task(name, metadata, task)
    low, high = _action_box(name, metadata)
    path = data / "main_data.hdf5"
    if not path.is_file():
        raise DataError(f"data set '{name}': {path} is missing; found {_listing(data)}")
    labels, episodes = _read_hdf5(path, name, metadata, task)
    if task is not None:
        low, high = np.full(task.action_dim, task.action_low), np.full(task.action_dim, task.action_high)
    return Trajectories.from_episodes(
        name,
        episodes,
        action_low=low,
        action_high=high,
        observation_dim=task.observation_dim if task else None,
        action_dim=task.action_dim if task else len(low),
        episode_names=labels,
    )


def _data_folder(directory: str) -> Path:
    folder = Path(directory).expanduser()
    return folder / "data" if (folder / "data").is_dir() else folder


def read_metadata(data: Path) -> dict[str, Any]:
    """Read and check `metadata.json`; the environment it names must be one of the task table.

    Raises:
        DataError: When it is missing, damaged, lacks a space, or names an unknown environment or foreign
            code.
    """
    path = data / "metadata.json"
    if not path.is_file():
        raise DataError(f"data: {path} is missing, so {data} holds no Minari data set; found {_listing(data)}")
    try:
        metadata = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError, RecursionError) as error:
        raise DataError(f"data: {path} is damaged: it holds no JSON object ({error})") from error
    name = metadata.get("dataset_id", data.parent.name)
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            raise DataError(
                f"data set '{name}': metadata.json has no {key}; Minari would run the environment that the "
                "file names to find out, so such data sets are refused"
            )
        try:
            metadata[key] = json.loads(metadata[key])
        except ValueError as error:
            raise DataError(f"data set '{name}': {key} in metadata.json is damaged ({error})") from error
    if metadata.get("data_format", "hdf5") != "hdf5":
        raise DataError(f"data set '{name}': data_format is '{metadata['data_format']}', expected 'hdf5'")
    metadata["env_spec"] = _env_spec(name, metadata.get("env_spec"))
    return metadata


def _env_spec(name: str, text: Any) -> dict[str, Any] | None:
    if text is None:
        return None
    try:
        spec = json.loads(text)
        env_id, code = str(spec["id"]), [spec.get("entry_point")]
        code += [wrapper["entry_point"] for wrapper in spec.get("additional_wrappers") or ()]
        spec["kwargs"] = dict(spec.get("kwargs") or {})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(f"data set '{name}': env_spec in metadata.json is damaged ({error!r})") from error
    for found in code:
        if found is not None and str(found).partition(":")[0].partition(".")[0] not in _TRUSTED_PACKAGES:
            raise DataError(
                f"data set '{name}': env_spec names the code '{found}', expected only environments of "
                f"{' and '.join(_TRUSTED_PACKAGES)}; do not open this data set with other tools"
            )
    if env_id not in known_env_ids():
        raise DataError(f"data set '{name}': it was recorded in '{env_id}', which no task uses; see `dds tasks`")
    return dict(spec)


def _check_task(name: str, metadata: dict[str, Any], task: Task) -> None:
    spec = metadata["env_spec"]
    if spec is None:
        raise DataError(
            f"data set '{name}': metadata.json has no env_spec, so nothing says that it was recorded in "
            f"{task.env_id}, which task '{task.name}' needs"
        )
    if spec["id"] not in (task.env_id, *task.data_env_ids):
        raise DataError(
            f"data set '{name}' was recorded in {spec['id']}, but task '{task.name}' needs {task.env_id}; "
            "choose the task that fits the data, or other data"
        )
    maze_map = spec["kwargs"].get("maze_map")
    if task.maze_map is not None and maze_map is not None:
        rows = [_as_list(row) for row in _as_list(maze_map)]
        walls = tuple("".join("1" if value == 1 else "0" for value in row) for row in rows)
        if walls != task.maze_map:
            raise DataError(
                f"data set '{name}' was recorded in {spec['id']} with other walls ({'/'.join(walls)}) than "
                f"task '{task.name}' has ({'/'.join(task.maze_map)})"
            )


def _action_box(name: str, metadata: dict[str, Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    space = metadata["action_space"]
    try:
        low, high = (np.array(space[key], np.float32).reshape(-1) for key in ("low", "high"))
        sound = space["type"] == "Box" and low.shape == high.shape == (int(np.prod(space["shape"])),)
    except (KeyError, TypeError, ValueError):
        sound = False
    if not sound or not np.isfinite([low, high]).all():
        raise DataError(f"data set '{name}': its action space is {space}, expected a bounded Box")
    return low, high


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _read_hdf5(
    path: Path, name: str, metadata: dict[str, Any], task: Task | None
) -> tuple[list[str], list[dict[str, NDArray[Any]]]]:
    try:
        with h5py.File(path, "r") as file:
            labels = sorted(file, key=lambda key: int(key.removeprefix("episode_")))
            total = metadata.get("total_episodes")
            in_order = labels == [f"episode_{i}" for i in range(len(labels))]
            if total is not None and (len(labels) != total or not in_order):
                raise DataError(
                    f"data set '{name}': metadata.json promises {total} episodes, but {path} holds "
                    f"{len(labels)}{f' ({labels[0]} to {labels[-1]})' if labels else ''}"
                )
            episodes = [_read_episode(file, name, label, task) for label in labels]
    except DataError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"data set '{name}': {path} is truncated or damaged ({error})") from error
    steps = sum(len(fields["rewards"]) for fields in episodes)
    promised = metadata.get("total_steps")
    if promised is not None and steps != promised:
        raise DataError(f"data set '{name}': metadata.json promises {promised} steps, but {path} holds {steps}")
    return labels, episodes


def _read_episode(file: h5py.File, name: str, label: str, task: Task | None) -> dict[str, NDArray[Any]]:
    group = _member(file, label, f"data set '{name}'")
    where = f"data set '{name}', {label}"
    if not isinstance(group, h5py.Group):
        raise DataError(f"{where}: found an array, expected a group of {', '.join(FIELDS)}")
    fields = {}
    for key in FIELDS:
        if key not in group:
            raise DataError(f"{where}: '{key}' is missing; found {', '.join(group) or 'nothing'}")
        node = _member(group, key, where)
        if isinstance(node, h5py.Group):
            node = _observation(node, key, where, task)
        try:
            fields[key] = node[()]
        except (OSError, RuntimeError) as error:
            raise DataError(f"{where}, {key}: {file.filename} is damaged there ({error})") from error
    return fields


def _observation(group: h5py.Group, key: str, where: str, task: Task | None) -> h5py.Dataset:
    """The flat part of a dictionary observation; goals are left out, because a task has one."""
    if key != "observations" or "observation" not in group:
        raise DataError(f"{where}, {key}: found the entries {', '.join(group) or 'none'}, expected 'observation'")
    node = _member(group, "observation", f"{where}, {key}")
    if not isinstance(node, h5py.Dataset):
        raise DataError(f"{where}, {key}: 'observation' is no array")
    return node


def _member(group: h5py.Group, key: str, where: str) -> Any:
    """A member that is stored in this very file: links may point at any file of the reader's machine."""
    if not isinstance(group.get(key, getlink=True), h5py.HardLink):
        raise DataError(f"{where}: '{key}' is a link to elsewhere, expected the data themselves")
    node = group[key]
    if isinstance(node, h5py.Dataset) and node.external:
        raise DataError(f"{where}: '{key}' is stored in another file, expected the data themselves")
    return node


def _listing(folder: Path) -> str:
    if not folder.is_dir():
        return "no such folder"
    return ", ".join(sorted(path.name for path in folder.iterdir())[:8]) or "nothing"
