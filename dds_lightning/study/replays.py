"""Each skill replayed alone from several starts of a maze, so that one sees what it does where."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dds_lightning.files import written_whole
from dds_lightning.tasks import Cell, Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent

Arrays = dict[str, NDArray[np.generic]]


def junctions(task: Task, count: int = 8) -> tuple[Cell, ...]:
    """The task's start, then cells with several ways out, each as far as can be from those before it.

    The goal's cell is left out: there every episode is over at once.
    """
    free = set(task.free_cells()) - {task.goal_cell}

    def ways(place: Cell) -> int:
        i, j = place
        return sum(neighbour in free for neighbour in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)))

    assert task.start_cell is not None, "mazes have a start"
    chosen = [task.start_cell]
    for least in (3, 2, 1):  # where several ways lead on, skills differ most
        places = [place for place in task.free_cells() if place in free and ways(place) >= least]
        while len(chosen) < min(count, len(free)) and (rest := [p for p in places if p not in chosen]):
            chosen.append(max(rest, key=lambda p: min(abs(p[0] - c[0]) + abs(p[1] - c[1]) for c in chosen)))
    return tuple(chosen)


def replay_skills(task: Task, agent: DDSAgent, steps: int = 50, seed: int = 0) -> Arrays:
    """Play every skill alone from every junction, the body at rest.

    Args:
        task: a maze.
        agent: its decoder is used, its policy is not.
        steps: T of each replay, if it does not reach the goal before.
        seed: of the environments (the exact place in the cell) and of the decoder's noise.

    Returns:
        `starts` (N, 2) where the body was set down, the same for all skills of a cell, `positions`
        (N, T + 1, 2) metres, `codes` (N,), `alive` (N, T), with N = cells x K.
    """
    cells = junctions(task)
    size, skills = len(cells), agent.num_skills
    envs = [task.make_env() for _ in cells]
    positions = np.full((skills, size, steps + 1, 2), np.nan, np.float32)
    alive = np.zeros((skills, size, steps), bool)
    try:
        for code in range(skills):
            alone = agent.variant("fixed", fixed_codes=[code])
            alone.reset(size, seed)
            states = [
                env.reset(seed=seed, options={"reset_cell": np.array(place)})
                for env, place in zip(envs, cells, strict=True)
            ]
            observations = np.stack([observation for observation, _ in states])
            positions[code, :, 0] = [info["position"] for _, info in states]
            going = np.arange(size)
            for t in range(steps):
                if not len(going):
                    break
                actions = alone.act(observations[going], rows=going)
                alive[code, going, t] = True
                ended = np.zeros(len(going), bool)
                for i, (slot, action) in enumerate(zip(going, actions, strict=True)):
                    observations[slot], _, terminated, truncated, info = envs[slot].step(action)
                    positions[code, slot, t + 1] = info["position"]
                    ended[i] = terminated or truncated
                going = going[~ended]
    finally:
        for env in envs:
            env.close()
    return {
        "starts": positions[:, :, 0].reshape(skills * size, 2),
        "positions": positions.reshape(skills * size, steps + 1, 2),
        "codes": np.repeat(np.arange(skills), size),
        "alive": alive.reshape(skills * size, steps),
    }


def stored_replays(path: Path, task: Task, directory: Path) -> Arrays:
    """The replays in `path`; made and written there first unless they are of this agent already.

    Args:
        path: the `.npz` file.
        task: a maze.
        directory: the published agent.
    """
    from dds_lightning.agent import DDSAgent

    key = json.dumps({"task": task.name, "agent": (directory / "SHA256SUMS").read_text(encoding="utf-8")})
    if path.is_file():
        with np.load(path, allow_pickle=False) as stored:
            if str(stored.get("key")) == key:
                return {name: stored[name] for name in stored.files if name != "key"}
    arrays = replay_skills(task, DDSAgent.load(directory))
    with written_whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, key=np.array(key), **arrays)
    return arrays
