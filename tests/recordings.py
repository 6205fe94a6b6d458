"""Real steps of the tasks' environments, and the file layouts in which others publish such steps.

Tests of data never invent a file: they record one here, from the simulator that the file is about.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
from numpy.typing import NDArray

from dds_lightning.tasks import Task

Act = Callable[[NDArray[np.float32], np.random.Generator], Any]
Episode = dict[str, Any]


def record(
    task: Task,
    steps: int,
    *,
    seed: int = 0,
    episode_steps: int = 50,
    act: Act | None = None,
    env: gym.Env[Any, Any] | None = None,
) -> list[Episode]:
    """Play episodes until there are `steps` steps in all.

    An episode ends where the environment says so, after `episode_steps`, or when there are enough steps; the
    last two are truncations.

    Args:
        task: Whose environment is played.
        steps: N, of all episodes together.
        seed: Of the first reset and of the actions; the same seed records the same episodes.
        episode_steps: Longest episode.
        act: (flat observation, generator) -> action; None draws smooth random actions.
        env: Another environment with the same widths, for example of the wrong physics; None makes the task's.
            It is left open.

    Returns:
        One mapping an episode of T steps:

        - `raw_observations`: T + 1 of what the environment itself returned, arrays or dictionaries
        - `observations` (T + 1, O) float32, flat; `actions` (T, A) float32; `rewards` (T,)
        - `terminations`, `truncations` (T,) bool
        - `qpos`, `qvel` (T + 1, ...): the simulator's state at every observation
        - `goals` (T + 1, 2), in mazes
        - `subtasks_done` (T + 1,) int, in the kitchen: how many are done so far in this episode
    """
    played = task.make_env() if env is None else env
    rng = np.random.default_rng(seed)
    episodes: list[Episode] = []
    left = steps
    try:
        while left > 0:
            length = min(left, episode_steps)
            episodes.append(_episode(played, length, seed if not episodes else None, act or _smooth(played), rng))
            left -= len(episodes[-1]["rewards"])
    finally:
        if env is None:
            played.close()
    return episodes


def _episode(
    env: gym.Env[Any, Any], steps: int, seed: int | None, act: Act, rng: np.random.Generator
) -> dict[str, Any]:
    states: dict[str, list[Any]] = {}
    taken: dict[str, list[Any]] = {"actions": [], "rewards": [], "terminations": [], "truncations": []}
    with _raw_of(env) as raw:
        observation, info = env.reset(seed=seed)
        _append(states, _state(env, observation, info))
        while not taken["rewards"] or not (taken["terminations"][-1] or taken["truncations"][-1]):
            action = np.asarray(act(observation, rng), np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            _append(states, _state(env, observation, info))
            stopped = len(taken["rewards"]) + 1 == steps
            end = {"terminations": bool(terminated), "truncations": not terminated and bool(truncated or stopped)}
            _append(taken, {"actions": action, "rewards": float(reward), **end})
    arrays = {key: np.asarray(values) for key, values in {**states, **taken}.items()}
    arrays["observations"] = arrays["observations"].astype(np.float32)
    return {"raw_observations": raw or [row.copy() for row in arrays["observations"]], **arrays}


def _append(lists: dict[str, list[Any]], values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        lists.setdefault(key, []).append(value)


def _state(env: gym.Env[Any, Any], observation: Any, info: Mapping[str, Any]) -> dict[str, Any]:
    inner: Any = env.unwrapped
    data = inner.robot_env.data if hasattr(inner, "robot_env") else inner.data
    state = {"observations": np.array(observation), "qpos": data.qpos.copy(), "qvel": data.qvel.copy()}
    goal = getattr(inner, "goal", None)
    if isinstance(goal, np.ndarray):
        state["goals"] = goal.copy()
    if "subtasks_done" in info:
        state["subtasks_done"] = info["subtasks_done"]
    return state


@contextlib.contextmanager
def _raw_of(env: Any) -> Iterator[list[Any]]:
    """Collect what the environment inside a task's adapter returns: copies, for some are changed in place."""
    seen: list[Any] = []
    flatten = getattr(env, "flatten", None)

    def spy(observation: Any) -> Any:
        seen.append(copy.deepcopy(observation))
        return flatten(observation)

    if flatten is None:
        yield seen
        return
    env.flatten = spy
    try:
        yield seen
    finally:
        del env.flatten


def _smooth(env: gym.Env[Any, Any]) -> Act:
    """Random actions that change slowly enough to move a body."""
    box: Any = env.action_space
    centre, half = (box.high + box.low) / 2, (box.high - box.low) / 2
    last = np.zeros(box.shape)

    def act(observation: Any, rng: np.random.Generator) -> Any:
        nonlocal last
        last = np.clip(0.8 * last + 0.4 * rng.normal(size=box.shape), -1, 1)
        return centre + half * last

    return act


# ---------------------------------------------------------------------- D4RL's layout


def d4rl_rows(task: Task, episodes: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    """Episodes as the flat arrays of D4RL's files: N rows each, end to end.

    Row t holds the state before step t, the action, and what the step gave; the state after an episode's last
    step is in no row.
    """
    ends = {key: _join(episodes, key) for key in ("terminations", "truncations")}
    rows = {
        "observations": _join(episodes, "observations", drop=1).astype(np.float32),
        "actions": _join(episodes, "actions").astype(np.float32),
        "rewards": _join(episodes, "rewards").astype(np.float32),
        "terminals": ends["terminations"],
        "timeouts": ends["truncations"],
        "infos/qpos": _join(episodes, "qpos", drop=1).astype(np.float32),
        "infos/qvel": _join(episodes, "qvel", drop=1).astype(np.float32),
    }
    if task.family == "antmaze":
        rows["infos/goal"] = _join(episodes, "goals", drop=1).astype(np.float32)
    if task.family == "kitchen":
        from dds_lightning.envs.kitchen import subtasks_done

        # As D4RL relabelled its demonstrations: the subtasks that are done in the row's own state, every demonstration
        # ends in a terminal, and `infos` is one array with the number of the demonstration.
        numbers = [np.full(len(episode["rewards"]), number) for number, episode in enumerate(episodes)]
        rows["rewards"] = subtasks_done(rows["observations"], task.subtasks).sum(axis=1).astype(np.float32)
        rows["terminals"] = (ends["terminations"] | ends["truncations"]).astype(np.float32)
        rows["infos"] = np.concatenate(numbers)
        for key in ("timeouts", "infos/qpos", "infos/qvel"):
            del rows[key]
    return rows


def write_d4rl_file(path: str | Path, task: Task, episodes: Sequence[Episode]) -> Path:
    """Write episodes in the HDF5 layout of D4RL's files of that family, compressed as they are."""
    path = Path(path)
    with h5py.File(path, "w") as file:
        for key, array in d4rl_rows(task, episodes).items():
            file.create_dataset(key, data=array, compression="gzip")
    return path


def _join(episodes: Sequence[Episode], key: str, drop: int = 0) -> NDArray[Any]:
    return np.concatenate([episode[key][: len(episode[key]) - drop] for episode in episodes])
