"""Each skill replayed alone from several starts of a maze, to show what it does where."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.interpret.measure.replay import replay_codes
from dds_lightning.interpret.measure.states import junctions as junctions
from dds_lightning.interpret.measure.states import rest_states
from dds_lightning.saving.arrays import read_npz
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.published import SUMS
from dds_lightning.saving.untrusted import read_text
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

    key = json.dumps({"task": task.name, "agent": read_text(directory / SUMS)})
    agent = DDSAgent.load(directory)
    if path.exists():
        try:
            stored: Arrays = dict(read_npz(path, root=path.parent))
            if str(stored.pop("key", "")) == key:
                return _checked(stored, agent.num_skills, path)
        except UserError as error:
            warnings.warn(f"{error}; the skills are played again", stacklevel=2)
    arrays = replay_skills(task, agent)
    entries: dict[str, Any] = {"key": np.array(key), **arrays}
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **entries)
    return arrays


def _checked(stored: Arrays, num_skills: int, path: Path) -> Arrays:
    """Return stored replays if they have the shapes and values of `replay_skills`.

    Raises:
        UserError: They do not.
    """
    count, steps = np.shape(stored.get("alive", 0)) if np.ndim(stored.get("alive", 0)) == 2 else (0, 0)
    forms = {"starts": ((count, 2), "f"), "positions": ((count, steps + 1, 2), "f"), "codes": ((count,), "iu")}
    for name, (shape, kinds) in {**forms, "alive": ((count, steps), "b")}.items():
        array = stored.get(name, np.zeros(0))
        if not count or array.shape != shape or array.dtype.kind not in kinds:
            raise UserError(f"{path} is damaged: {name} have shape {array.shape}, expected {shape}")
    codes = stored["codes"]
    if codes.min() < 0 or codes.max() >= num_skills or not np.isfinite(stored["starts"]).all():
        raise UserError(f"{path} is damaged: it holds other codes than 0 to {num_skills - 1}, or no starts")
    return {name: stored[name] for name in ("starts", "positions", "codes", "alive")}
