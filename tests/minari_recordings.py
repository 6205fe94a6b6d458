"""Minari data sets of real environment steps, stored as Minari itself stores them: raw observations, raw spaces."""

from __future__ import annotations

import copy
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np

from datamodules.collect.minari_writer import write_minari
from dds_lightning.envs.kitchen import SUBTASKS
from dds_lightning.tasks import Task
from tests.recordings import Act, Episode

Recorded = tuple[Any, gym.Space[Any], gym.Space[Any]]


def write_minari_set(
    root: str | Path,
    dataset_id: str,
    task: Task,
    episodes: Sequence[Episode],
    *,
    kwargs: Mapping[str, Any] | None = None,
    metadata: Mapping[str, Any] | None = None,
    spoil: Callable[[h5py.File], None] | None = None,
) -> Path:
    """Write episodes of `tests.recordings.record` as a Minari data set.

    Args:
        root: Folder of data sets, the value of MINARI_DATASETS_PATH.
        dataset_id: Minari's name of the set.
        task: In whose environment the episodes were recorded.
        episodes: From `record`.
        kwargs: Other arguments in env_spec than those that the environment had.
        metadata: Entries that metadata.json has instead; None leaves one out.
        spoil: Changes the finished main_data.hdf5.

    Returns:
        The data set's folder.
    """
    spec, observations, actions = copy.deepcopy(_recorded(task))
    spec.kwargs.update(kwargs or {})
    folder = write_minari(
        root,
        dataset_id,
        [_minari_episode(episode) for episode in episodes],
        env_spec=spec,
        observation_space=observations,
        action_space=actions,
        metadata={},
    )
    change_metadata(folder, metadata or {})
    if spoil is not None:
        with h5py.File(folder / "data" / "main_data.hdf5", "r+") as file:
            spoil(file)
    return folder


def change_metadata(folder: Path, changes: Mapping[str, Any]) -> None:
    """Give metadata.json other entries; None leaves one out."""
    path = folder / "data" / "metadata.json"
    entries = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in entries.items() if value is not None}))


def changed_spec(folder: Path, **entries: Any) -> str:
    """The env_spec of a data set with other entries."""
    metadata = json.loads((folder / "data" / "metadata.json").read_text())
    return json.dumps({**json.loads(metadata["env_spec"]), **entries})


@functools.cache
def _recorded(task: Task) -> Recorded:
    """Specification and spaces of the environment inside the task's adapter."""
    env = task.make_env()
    inner = env.env.unwrapped
    env.close()
    return inner.spec, inner.observation_space, inner.action_space


def _minari_episode(episode: Episode) -> dict[str, Any]:
    infos = {key: episode[key] for key in ("qpos", "qvel") if key in episode}
    fields = {key: episode[key] for key in ("actions", "rewards", "terminations", "truncations")}
    return {"observations": _stacked(episode["raw_observations"]), **fields, "infos": infos}


def _stacked(steps: Sequence[Any]) -> Any:
    if isinstance(steps[0], Mapping):
        return {key: _stacked([step[key] for step in steps]) for key in steps[0]}
    return np.stack(steps)


def doing(env: Any, when: Mapping[int, str], undo: Mapping[int, str] | None = None) -> Act:
    """Actions for the kitchen in which, at some steps, somebody's hand does a subtask, or undoes it.

    Args:
        env: The kitchen that is recorded.
        when: Step -> subtask that is done from there on.
        undo: Step -> subtask whose object goes back.
    """
    start: Any = None
    step = 0

    def act(observation: Any, rng: np.random.Generator) -> Any:
        nonlocal start, step
        inner = env.unwrapped.robot_env
        qpos, qvel = inner.data.qpos.copy(), inner.data.qvel.copy()
        start = qpos.copy() if start is None else start
        for events, place in ((when, None), (undo or {}, start)):
            if step in events:
                columns, values = SUBTASKS[events[step]]
                qpos[list(columns)] = values if place is None else place[list(columns)]
                inner.set_state(qpos, qvel)
        step += 1
        return rng.uniform(-0.2, 0.2, env.action_space.shape)

    return act
