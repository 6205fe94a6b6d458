"""Writes a Minari data set: completely or not at all, every chunk with a checksum."""

from __future__ import annotations

import errno
import importlib.metadata
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from datamodules.storage import refuse_existing
from dds_lightning.saving.arrays import create_h5
from dds_lightning.saving.files import folder_written_whole

Episode = Mapping[str, Any]
"""Minari's field names (observations, actions, rewards, ..., infos) to arrays or mappings of arrays."""
ROOM_TO_CLOSE = 4 << 20
"""Bytes of the disk that stay free, for HDF5's tables and what other processes write meanwhile."""


def write_minari(
    root: str | Path,
    dataset_id: str,
    episodes: Iterable[Episode],
    *,
    env_spec: EnvSpec,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    metadata: Mapping[str, Any],
    overwrite: bool = False,
) -> Path:
    """Write `root/dataset_id/data/{main_data.hdf5,metadata.json}`, as `minari.load_dataset` expects them.

    Everything is written into a hidden sibling folder that is renamed only when it is complete, so that an interrupted
    run leaves no data set. Chunks carry HDF5's Fletcher-32 sums: changed bytes are noticed on
    reading.

    Args:
        root: Folder of data sets; the value of MINARI_DATASETS_PATH under which Minari finds this one.
        dataset_id: Minari's name, for example "pointmaze-large-diverse-v0".
        episodes: Consumed one by one; arrays have T rows (observations and infos T + 1).
        env_spec: Specification of the recorded environment.
        observation_space: Space of the stored observations.
        action_space: Space of the stored actions.
        metadata: More entries for metadata.json (author, algorithm_name, description, ...).
        overwrite: Replace a data set of the same name.

    Returns:
        The data set's folder.

    Raises:
        UserError: When the folder exists and `overwrite` is False.
        OSError: When the disk is full; an earlier set of the name is still there.
    """
    folder = Path(root) / dataset_id
    refuse_existing(folder, overwrite)
    with folder_written_whole(folder) as part:
        data = part / "data"
        data.mkdir()
        count, steps = _write_episodes(data / "main_data.hdf5", episodes)
        from minari.serialization import serialize_space

        facts = {
            "dataset_id": dataset_id,
            "total_episodes": count,
            "total_steps": steps,
            "data_format": "hdf5",
            "jpeg_encoding": False,
            "observation_space": serialize_space(observation_space),
            "action_space": serialize_space(action_space),
            "env_spec": env_spec.to_json(),
            "minari_version": importlib.metadata.version("minari"),
            "dataset_size": round((data / "main_data.hdf5").stat().st_size / 1e6, 1),
            **metadata,
        }
        (data / "metadata.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
        refuse_existing(folder, overwrite)
    return folder


def _write_episodes(path: Path, episodes: Iterable[Episode]) -> tuple[int, int]:
    count = steps = 0
    with create_h5(path) as file:
        for count, episode in enumerate(episodes, start=1):
            group = file.create_group(f"episode_{count - 1}")
            length = len(episode["rewards"])
            group.attrs["id"] = count - 1
            group.attrs["total_steps"] = length
            steps += length
            _refuse_full_disk(path, episode)
            _write_fields(group, episode)
    return count, steps


def _refuse_full_disk(path: Path, episode: Episode) -> None:
    """Stop while there is room to close the file: when a write fails, HDF5 aborts the whole process."""
    if shutil.disk_usage(path.parent).free < _size(episode) + ROOM_TO_CLOSE:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _size(value: Any) -> int:
    """Bytes of all arrays in it."""
    return sum(map(_size, value.values())) if isinstance(value, Mapping) else np.asarray(value).nbytes


def _write_fields(group: h5py.Group, fields: Mapping[str, Any]) -> None:
    for name, value in fields.items():
        if isinstance(value, Mapping):
            _write_fields(group.create_group(name), value)
        else:
            array: NDArray[Any] = np.asarray(value)
            shape = (None, *array.shape[1:])
            group.create_dataset(name, data=array, chunks=array.shape, maxshape=shape, fletcher32=True)
