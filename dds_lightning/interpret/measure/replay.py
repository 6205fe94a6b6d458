"""Skills replayed from given states: the simulator is set to a state, and one code is held for H steps or a multiple.

```
 state 0 ─┬─ code 0 ─► s, a, s, a, ...        every code from every state: differences are due to the code
          └─ code 1 ─► s, a, s, a, ...
 state 1 ─┬─ code 0 ─► ...
```

One environment plays all replays side by side: before each step it is set to the replay's state, the solver's
memory included. That is as exact as one environment per replay, and much quicker to build.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from datamodules.trajectories import Trajectories
from dds_lightning.envs.physics import mujoco
from dds_lightning.errors import UserError
from dds_lightning.interpret.measure.states import BodyStates, Played
from dds_lightning.tasks import Task
from dds_lightning.tasks.env import open_env

Act = Callable[[NDArray[np.float32], NDArray[np.intp]], NDArray[np.float32]]
"""Maps observations (n, O) of the replays numbered `rows` (n,) to actions (n, A)."""

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class Skills(Protocol):
    """The interface of what is replayed and recovered: a discrete skill model, or a clustered continuous one."""

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
class Replays:
    """N replays of T steps; values after the end of an episode are NaN.

    Attributes:
        codes: (N,) the code held.
        states: (N,) number of the state that the replay started in.
        observations: (N, T + 1, O) float32.
        actions: (N, T, A) float32.
        rewards: (N, T) the environment's rewards.
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
        """Return the replays numbered `index` (or chosen by a mask), in that order."""
        rows = np.asarray(index)
        return Replays(**{name: values[rows] for name, values in vars(self).items()})


# ---------------------------------------------------------------------- playing


@contextlib.contextmanager
def simulator(task: Task) -> Iterator[Any]:
    """Yield the task's environment after a reset; `unwrapped` has its `model` and `data`.

    Raises:
        UserError: The environment is not simulated by MuJoCo.
    """
    with open_env(task) as env:
        if not hasattr(env.unwrapped, "model"):
            raise UserError(f"task '{task.name}': {task.env_id} has no MuJoCo model, so skills cannot be replayed")
        yield env


def device_of(skills: Skills) -> torch.device:
    """Where a model expects its inputs; what is not a module is on the CPU."""
    return next(skills.parameters()).device if isinstance(skills, torch.nn.Module) else torch.device("cpu")


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
        task: The environment.
        skills: The model whose decoder plays; it stays on its device.
        states: S states.
        codes: Codes to play; None plays all of them.
        steps: T; None takes the skills' horizon H.
        noise_scale: Factor on the decoder's noise; None takes the model's.
        seed: Seed of the decoder's noise.
        env: An environment from `simulator`; without it one is created.
        each: Whether `codes` (S,) holds one code per state, instead of all codes for all states.
        report: Called with the number of steps done so far, for a progress bar.

    Returns:
        S x K replays, code by code: replay ``i * S + j`` is the i-th code from state j.

    Raises:
        UserError: A code does not exist, or there are no states.
    """
    chosen = np.arange(skills.num_skills) if codes is None else np.asarray(codes, dtype=np.int64)
    if not len(states) or not len(chosen) or chosen.min() < 0 or chosen.max() >= skills.num_skills:
        raise UserError(
            f"codes are {chosen} from {len(states)} states, expected codes of 0 to {skills.num_skills - 1} and a state"
        )
    which = np.arange(len(states)) if each else np.tile(np.arange(len(states)), len(chosen))
    held = chosen if each else np.repeat(chosen, len(states))
    index = torch.from_numpy(held)
    device = device_of(skills)
    stream = torch.Generator(device).manual_seed(seed)

    @torch.inference_mode()
    def act(observations: NDArray[np.float32], rows: NDArray[np.intp]) -> NDArray[np.float32]:
        wanted = index[torch.from_numpy(rows)].to(device)
        actions = skills.decode(torch.from_numpy(observations).to(device), wanted, noise_scale, stream)
        return actions.float().cpu().numpy()

    with contextlib.ExitStack() as stack:
        env = stack.enter_context(simulator(task)) if env is None else env
        fields = play(env, task, act, states.take(which), steps or skills.horizon, report)
    return Replays(codes=held, states=which, **fields)


def play(
    env: Any, task: Task, act: Act, states: BodyStates, steps: int, report: Callable[[int], None] | None = None
) -> dict[str, NDArray[Any]]:
    """Play N replays for T steps, or until their episode ends; returns `Replays` without codes and states.

    Args:
        env: From `simulator`.
        task: The environment's task.
        act: Called once a step with all replays that go on.
        states: (N,) where they begin.
        steps: T.
        report: Called with the number of steps done so far.
    """
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
        mujoco.mj_resetData(model, data)  # clears what the solver remembers of the previous state
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
            if robot is not None:  # the kitchen's arm moves from where it last observed its joints
                robot._last_robot_qpos = observations[n, t, :9].astype(np.float64)
            observations[n, t + 1], rewards[n, t], terminated, *_ = env.step(actions[n, t])
            mujoco.mj_getState(model, data, memory[n], _STATE)
            qpos[n, t + 1] = data.qpos
            # The kitchen ends when its subtasks are done, which it counts over all replays played in it.
            ended[i] = terminated and robot is None
        going = going[~ended]
        if report is not None:
            report(t + 1)
    return {"observations": observations, "actions": actions, "rewards": rewards, "qpos": qpos, "alive": alive}


def play_skills(task: Task, skills: Skills, steps: int = 2000, seed: int = 0) -> Played:
    """Play episodes of random skills, to get states to replay from if observations do not hold the simulator's state.

    Args:
        task: The environment.
        skills: The model whose decoder plays.
        steps: Minimum number of steps in total.
        seed: Seed of the codes and of the decoder's noise.
    """
    rng, stream = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    episodes: list[dict[str, Any]] = []
    qpos, qvel = [], []
    with simulator(task) as env, torch.inference_mode():
        data = env.unwrapped.data
        while sum(len(episode["rewards"]) for episode in episodes) < steps:
            observation, _ = env.reset(seed=int(rng.integers(2**31)))
            seen, ended = [observation], False
            taken: list[Any] = []
            rewards: list[float] = []
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
            while not ended and len(taken) < task.max_episode_steps:
                if len(taken) % skills.horizon == 0:
                    code = torch.from_numpy(rng.integers(skills.num_skills, size=1))
                action = skills.decode(torch.from_numpy(observation[None]), code, None, stream)[0].float().numpy()
                observation, reward, ended, *_ = env.step(action)
                seen.append(observation)
                taken.append(action)
                rewards.append(reward)
                qpos.append(data.qpos.copy())
                qvel.append(data.qvel.copy())
            last = np.arange(len(taken)) == len(taken) - 1
            arrays = {"observations": np.array(seen), "actions": np.array(taken), "rewards": np.array(rewards)}
            episodes.append({**arrays, "terminations": last & ended, "truncations": last & (not ended)})
    name = f"{task.name}, played"
    low, high = task.action_box()
    made = Trajectories.from_episodes(name, episodes, action_low=low, action_high=high)
    fields: dict[str, Any] = {"name": name, **made.arrays(), "qpos": np.array(qpos), "qvel": np.array(qvel)}
    return Played(**fields)
