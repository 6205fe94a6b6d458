"""Skills replayed from given states: the simulator is put there, and one code is held for H steps or several times H.

```
 state 0 ─┬─ code 0 ─► s, a, s, a, ...        every code from every state: what differs, the code did
          └─ code 1 ─► s, a, s, a, ...
 state 1 ─┬─ code 0 ─► ...
```

One environment plays all replays side by side: before each step it is put into the replay's own state, the solver's
memory included. That is as exact as an environment each, and much quicker to build.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from datamodules.physics.states import state_layout
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Cell, Task

Act = Callable[[NDArray[np.float32], NDArray[np.intp]], NDArray[np.float32]]
"""Observations (n, O) of the replays numbered `rows` (n,) to actions (n, A)."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class Skills(Protocol):
    """What is replayed and recovered: a discrete skill model, or a continuous one in clusters (`recovery`)."""

    horizon: int
    num_skills: int

    def encode(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Codes (B,) of segments (B, H, O), (B, H, A)."""

    def decode(
        self,
        observations: Tensor,
        codes: Tensor,
        noise_scale: float | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Actions (B, A) for observations (B, O) under codes (B,)."""


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
        """The states numbered `index`, in that order."""
        rows = np.asarray(index)
        return BodyStates(self.observations[rows], self.qpos[rows], self.qvel[rows])


@dataclass(frozen=True, eq=False)
class Replays:
    """N replays of T steps; what comes after the end of an episode is NaN.

    Attributes:
        codes: (N,) code held.
        states: (N,) number of the state that the replay began in.
        observations: (N, T + 1, O) float32.
        actions: (N, T, A) float32.
        rewards: (N, T) the environment's own.
        qpos: (N, T + 1, nq).
        alive: (N, T) whether the step was taken.
    """

    codes: NDArray[np.int64]
    states: NDArray[np.int64]
    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    qpos: NDArray[np.float64]
    alive: NDArray[np.bool_]

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(N,) steps taken."""
        return self.alive.sum(axis=1)

    def take(self, index: ArrayLike) -> Replays:
        """The replays numbered `index` (or chosen by a mask), in that order."""
        rows = np.asarray(index)
        return Replays(**{name: values[rows] for name, values in vars(self).items()})


# ---------------------------------------------------------------------- states to begin in


def body_states(task: Task, observations: ArrayLike, previous: ArrayLike | None = None) -> BodyStates:
    """The simulator's states behind some observations.

    What an observation leaves out is filled in: a runner stands at x = 0, on which no force depends; a kitchen whose
    observations hold no velocities moves as from the previous observation, or is at rest.

    Args:
        task: whose observations.
        observations: (S, O).
        previous: (S, O) a step earlier; NaN rows where there is none.
    """
    seen = np.asarray(observations, dtype=np.float64)
    layout = state_layout(task, seen.shape[1])
    positions = list(layout.positions)
    qpos = np.pad(seen[:, positions], ((0, 0), (layout.hidden, 0)))
    qvel = np.zeros((len(seen), layout.degrees))
    if layout.velocities:
        qvel[:] = seen[:, list(layout.velocities)]
    elif previous is not None:
        # Joints alone: of the kettle's seven position numbers four are a quaternion, and it mostly stands.
        joints = np.nan_to_num((seen - np.asarray(previous, dtype=np.float64))[:, positions]) / task.step_seconds
        free = len(positions) - 7
        qvel[:, :free] = joints[:, :free]
    return BodyStates(np.asarray(observations, np.float32), qpos, qvel)


def draw_states(task: Task, trajectories: Trajectories, count: int, seed: int = 0) -> BodyStates:
    """Draw states from all over a data set, none of them an episode's last.

    Args:
        task: what the data are of.
        trajectories: the data.
        count: S; fewer come back from shorter data.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    steps = np.sort(rng.choice(trajectories.num_steps, min(count, trajectories.num_steps), replace=False))
    rows = steps + trajectories.episode_of(steps)
    previous = trajectories.observations[np.maximum(rows - 1, 0)].astype(np.float64)
    previous[np.isin(rows, trajectories.observation_offsets)] = np.nan
    return body_states(task, trajectories.observations[rows], previous)


def rest_states(task: Task, cells: Sequence[Cell]) -> BodyStates:
    """The body at rest in the middle of some cells of a maze, an ant upright.

    Raises:
        UserError: the task has no maze.
    """
    return body_states(task, at_rest(task, task.cell_to_xy(list(cells))))


def at_rest(task: Task, points: ArrayLike) -> NDArray[np.float32]:
    """Observations (N, O) of a body at rest at positions (N, 2) in metres, an ant upright as its episodes begin."""
    observations = np.zeros((len(np.asarray(points)), task.observation_dim), np.float32)
    observations[:, :2] = points
    if task.family == "antmaze":
        observations[:, 2:4] = 0.75, 1.0  # height, and w of the quaternion
    return observations


def junctions(task: Task, count: int = 8) -> tuple[Cell, ...]:
    """A maze's start, then cells with several ways out, each as far as can be from those before it.

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


# ---------------------------------------------------------------------- playing


@contextlib.contextmanager
def simulator(task: Task) -> Iterator[Any]:
    """The task's environment after a reset; `unwrapped` has its `model` and `data`."""
    env = task.make_env()
    try:
        env.reset(seed=0)
        yield env
    finally:
        env.close()


def replay_codes(
    task: Task,
    skills: Skills,
    states: BodyStates,
    codes: Sequence[int] | NDArray[Any] | None = None,
    steps: int | None = None,
    noise_scale: float | None = None,
    seed: int = 0,
    env: Any = None,
    each: bool = False,
    report: Callable[[int], None] | None = None,
) -> Replays:
    """Play every code from every state.

    Args:
        task: the environment.
        skills: whose decoder plays; a model's own device is used.
        states: S states.
        codes: those to play; None plays all.
        steps: T; None the skills' horizon H.
        noise_scale: factor on the decoder's noise; None takes the model's own.
        seed: of the decoder's noise.
        env: from `simulator`, to play in an environment that is there already.
        each: `codes` (S,) is one code a state, instead of all from all.
        report: told the number of steps done so far, for a progress bar.

    Returns:
        S x K replays, code by code: replay ``i * S + j`` is the i-th code from state j.

    Raises:
        UserError: a code that there is not, or no state.
    """
    chosen = np.arange(skills.num_skills) if codes is None else np.asarray(codes, dtype=np.int64)
    if not len(states) or not len(chosen) or chosen.min() < 0 or chosen.max() >= skills.num_skills:
        raise UserError(
            f"codes are {chosen} from {len(states)} states, expected codes of 0 to {skills.num_skills - 1} and a state"
        )
    which = np.arange(len(states)) if each else np.tile(np.arange(len(states)), len(chosen))
    held = chosen if each else np.repeat(chosen, len(states))
    index = torch.from_numpy(held)
    device = next(skills.parameters()).device if isinstance(skills, torch.nn.Module) else torch.device("cpu")
    stream = torch.Generator(device).manual_seed(seed)

    @torch.inference_mode()
    def act(observations: NDArray[np.float32], rows: NDArray[np.intp]) -> NDArray[np.float32]:
        wanted = index[torch.from_numpy(rows)].to(device)
        actions = skills.decode(torch.from_numpy(observations).to(device), wanted, noise_scale, stream)
        return actions.float().cpu().numpy()

    with contextlib.ExitStack() as stack:
        env = stack.enter_context(simulator(task)) if env is None else env
        fields = _play(env, task, act, states.take(which), steps or skills.horizon, report)
    return Replays(codes=held, states=which, **fields)


def _play(
    env: Any, task: Task, act: Act, states: BodyStates, steps: int, report: Callable[[int], None] | None
) -> dict[str, NDArray[Any]]:
    """Play N replays for T steps, or until their episode ends; everything of `Replays` but codes and states."""
    inner = env.unwrapped
    model, data = inner.model, inner.data
    robot = getattr(inner, "robot_env", None)
    count = len(states)
    memory = np.empty((count, mujoco.mj_stateSize(model, _STATE)))
    observations = np.full((count, steps + 1, task.observation_dim), np.nan, np.float32)
    qpos = np.full((count, steps + 1, model.nq), np.nan)
    actions = np.full((count, steps, task.action_dim), np.nan, np.float32)
    rewards = np.full((count, steps), np.nan)
    alive = np.zeros((count, steps), bool)
    observations[:, 0], qpos[:, 0] = states.observations, states.qpos
    for n in range(count):
        mujoco.mj_resetData(model, data)  # no solver's memory of the state before
        data.qpos[:], data.qvel[:] = states.qpos[n], states.qvel[n]
        mujoco.mj_forward(model, data)
        mujoco.mj_getState(model, data, memory[n], _STATE)
    going = np.arange(count)
    for t in range(steps):
        if not len(going):
            break
        actions[going, t] = act(observations[going, t], going)
        alive[going, t] = True
        ended = np.zeros(len(going), bool)
        for i, n in enumerate(map(int, going)):
            mujoco.mj_setState(model, data, memory[n], _STATE)
            if robot is not None:  # the kitchen's arm moves from where it last saw its joints
                robot._last_robot_qpos = observations[n, t, :9].astype(np.float64)
            observations[n, t + 1], rewards[n, t], terminated, *_ = env.step(actions[n, t])
            mujoco.mj_getState(model, data, memory[n], _STATE)
            qpos[n, t + 1] = data.qpos
            # The kitchen ends when its subtasks are done, which it counts over all that was played in it.
            ended[i] = terminated and robot is None
        going = going[~ended]
        if report is not None:
            report(t + 1)
    return {"observations": observations, "actions": actions, "rewards": rewards, "qpos": qpos, "alive": alive}
