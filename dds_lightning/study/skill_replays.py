"""Each skill replayed alone from several starts of a maze, to show what it does where."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.interpret.measure.replay import replay_codes
from dds_lightning.interpret.measure.states import junctions as junctions
from dds_lightning.interpret.measure.states import rest_states
from dds_lightning.saving.files import written_whole
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent

Arrays = dict[str, NDArray[np.generic]]


def replay_skills(task: Task, agent: DDSAgent, steps: int = 50, seed: int = 0) -> Arrays:
    """Play every skill alone from every junction, starting with the body at rest.

    Args:
        task: A maze.
        agent: The agent whose decoder acts; its policy is not used.
        steps: T of each replay, unless it reaches the goal earlier.
        seed: Seed of the decoder's noise.

    Returns:
        `starts` (N, 2) where the body starts, the same for all skills of a cell, `positions`
        (N, T + 1, 2) metres, `codes` (N,), `alive` (N, T), with N = cells x K.
    """
    states = rest_states(task, junctions(task))
    replays = replay_codes(task, agent.skill, states, steps=steps, noise_scale=agent.noise_scale, seed=seed)
    positions = replays.qpos[..., :2].astype(np.float32)
    return {"starts": positions[:, 0], "positions": positions, "codes": replays.codes, "alive": replays.alive}


def stored_replays(path: Path, task: Task, directory: Path) -> Arrays:
    """Read the replays in `path`, after creating them there unless they already belong to this agent.

    Args:
        path: The `.npz` file.
        task: A maze.
        directory: The published agent.
    """
    from dds_lightning.agent import DDSAgent

    key = json.dumps({"task": task.name, "agent": (directory / "SHA256SUMS").read_text(encoding="utf-8")})
    if path.is_file():
        with np.load(path, allow_pickle=False) as stored:
            if str(stored.get("key")) == key:
                return {name: stored[name] for name in stored.files if name != "key"}
    arrays = replay_skills(task, DDSAgent.load(directory))
    entries: dict[str, Any] = {"key": np.array(key), **arrays}
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **entries)
    return arrays
