"""What every collector does around its recorder: check what was asked for, record, write the set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from importlib import metadata as installed
from pathlib import Path
from typing import Any

import gymnasium as gym

from datamodules.collect.minari_writer import write_minari
from datamodules.collect.recording import Episode, EpisodeRecorder, Kept, record
from datamodules.storage import refuse_existing
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task


def place(task: Task, steps: int, seed: int, out: str | Path, dataset_id: str | None, overwrite: bool) -> Path:
    """The folder of the set to come.

    Raises:
        UserError: A number is out of range, or the folder exists and may not be replaced.
    """
    if steps < 1:
        raise UserError(f"steps: found {steps}, expected at least 1")
    if seed < 0:
        raise UserError(f"seed: found {seed}, expected at least 0")
    folder = Path(out) / (dataset_id or task.data_ids["local"])
    refuse_existing(folder, overwrite)
    return folder


def record_set(
    folder: Path,
    recorder: EpisodeRecorder,
    env: gym.Env[Any, Any],
    settings: Mapping[str, Any],
    *,
    observation_space: gym.Space[Any],
    algorithm: str,
    description: str,
    workers: int | None,
    overwrite: bool,
    progress: bool,
    shorten: Callable[[Iterator[Episode]], Iterator[Episode]] = iter,
) -> Path:
    """Record a set and write it; an interrupted call with the same settings goes on where it stopped.

    Args:
        folder: Where `place` says.
        recorder: What records it.
        env: The recorded environment, made by its id.
        settings: Everything that the data depend on; kept in the set's metadata as `collection`.
        observation_space: Of the stored observations.
        algorithm: Minari's `algorithm_name`.
        description: Minari's `description`.
        workers: Processes; None takes every core.
        overwrite: Replace a set of the same name.
        progress: Show a progress bar on standard error.
        shorten: Gives up what was recorded beyond the set's end.

    Returns:
        `folder`.
    """
    kept = Kept(folder, settings)
    title = f"collecting {folder.name}" if progress else None
    episodes = shorten(record(recorder, workers, parcel=1, kept=kept, title=title))
    assert env.spec is not None, "made by its id"
    packages = ("gymnasium", "gymnasium-robotics", "mujoco")
    write_minari(
        folder.parent,
        folder.name,
        episodes,
        env_spec=env.spec,
        observation_space=observation_space,
        action_space=env.action_space,
        overwrite=overwrite,
        metadata={
            "author": ["dds-lightning"],
            "algorithm_name": algorithm,
            "description": description,
            "requirements": [f"{package}=={installed.version(package)}" for package in packages],
            "collection": dict(settings),
        },
    )
    kept.remove()
    return folder
