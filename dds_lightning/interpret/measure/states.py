"""States of a task's simulator from which skills are replayed: drawn from data, at rest, or reached by playing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.trajectories import Trajectories
from dds_lightning.tasks import Cell, Task
from dds_lightning.tasks.bodies import body_of, state_layout


@dataclass(frozen=True, eq=False)
class BodyStates:
    """S states of a task's simulator.

    Attributes:
        observations: (S, O) float32, as the task's environment gives them.
        qpos: (S, nq).
        qvel: (S, nv).
    """

    observations: NDArray[np.float32]
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]

    def __len__(self) -> int:
        """S."""
        return len(self.qpos)

    def take(self, index: ArrayLike) -> BodyStates:
        """Return the states numbered `index`, in that order."""
        rows = np.asarray(index)
        return BodyStates(self.observations[rows], self.qpos[rows], self.qvel[rows])


def body_states(task: Task, observations: ArrayLike, previous: ArrayLike | None = None) -> BodyStates:
    """Return the simulator's states behind some observations.

    What an observation leaves out is filled in: a runner stands at x = 0, which no force depends on; a kitchen whose
    observations hold no velocities gets those since the previous observation, or is at rest.

    Args:
        task: The task that defines the observations.
        observations: (S, O).
        previous: (S, O) observations a step earlier; NaN rows where there is none.
    """
    seen = np.asarray(observations, dtype=np.float64)
    layout = state_layout(task, seen.shape[1])
    positions = list(layout.positions)
    qpos = np.pad(seen[:, positions], ((0, 0), (layout.hidden, 0)))
    qvel = np.zeros((len(seen), layout.degrees))
    if layout.velocities:
        qvel[:] = seen[:, list(layout.velocities)]
    elif previous is not None:
        # Joints only: four of the kettle's seven position numbers are a quaternion, and it mostly stands.
        joints = np.nan_to_num((seen - np.asarray(previous, dtype=np.float64))[:, positions]) / task.step_seconds
        free = len(positions) - 7
        qvel[:, :free] = joints[:, :free]
    return BodyStates(np.asarray(observations, np.float32), qpos, qvel)


def draw_states(task: Task, trajectories: Trajectories, count: int, seed: int = 0) -> BodyStates:
    """Draw states from all over a data set, none of them an episode's last.

    Args:
        task: The task of the data.
        trajectories: The data.
        count: S; fewer are returned from shorter data.
        seed: Seed of the draw.
    """
    rng = np.random.default_rng(seed)
    steps = np.sort(rng.choice(trajectories.num_steps, min(count, trajectories.num_steps), replace=False))
    return states_at(task, trajectories, steps + trajectories.episode_of(steps))


def states_at(task: Task, trajectories: Trajectories, rows: NDArray[Any]) -> BodyStates:
    """Return the simulator's states in some rows of a data set's observations, see `body_states`."""
    if isinstance(trajectories, Played):
        return BodyStates(trajectories.observations[rows], trajectories.qpos[rows], trajectories.qvel[rows])
    previous = trajectories.observations[np.maximum(rows - 1, 0)].astype(np.float64)
    previous[np.isin(rows, trajectories.observation_offsets)] = np.nan
    return body_states(task, trajectories.observations[rows], previous)


@dataclass(frozen=True, eq=False)
class Played(Trajectories):
    """Episodes with the simulator's state in every row of observations.

    Attributes:
        qpos: (N + E, nq).
        qvel: (N + E, nv).
    """

    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]


def rest_states(task: Task, cells: Sequence[Cell]) -> BodyStates:
    """Return states of the body at rest in the middle of some cells of a maze, an ant upright.

    Raises:
        UserError: The task has no maze.
    """
    return body_states(task, at_rest(task, task.cell_to_xy(list(cells))))


def at_rest(task: Task, points: ArrayLike) -> NDArray[np.float32]:
    """Return observations (N, O) of a body at rest at positions (N, 2) in metres, an ant upright."""
    observations = np.zeros((len(np.asarray(points)), task.observation_dim), np.float32)
    observations[:, :2] = points
    for column, value in body_of(task).rest.items():
        observations[:, column] = value
    return observations


def junctions(task: Task, count: int = 8) -> tuple[Cell, ...]:
    """Return a maze's start, then cells with several ways out, each as far as possible from those before it.

    The goal's cell is left out, because an episode ends there at once.
    """
    free = set(task.free_cells()) - {task.goal_cell}

    def ways(place: Cell) -> int:
        i, j = place
        return sum(neighbour in free for neighbour in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)))

    assert task.start_cell is not None, "mazes have a start"
    chosen = [task.start_cell]
    for least in (3, 2, 1):  # skills differ most where several ways lead on
        places = [place for place in task.free_cells() if place in free and ways(place) >= least]
        while len(chosen) < min(count, len(free)) and (rest := [p for p in places if p not in chosen]):
            chosen.append(max(rest, key=lambda p: min(abs(p[0] - c[0]) + abs(p[1] - c[1]) for c in chosen)))
    return tuple(chosen)
