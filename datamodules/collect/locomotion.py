"""Locomotion data: runners of a trained ladder, recorded with a little noise, in D4RL's three mixtures.

```
 000_random ... 030 ... 060 ... expert         the ladder, rising scores
 └── medium-replay ──┘ │        │
                     medium     │              the rung nearest to 0.42 of the expert's score
                     └── medium-expert ──┘     half of the steps each
```
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from datamodules.behaviours.policy import MLPPolicy
from datamodules.behaviours.shipped import load_ladder
from datamodules.collect.collecting import place, record_set
from datamodules.collect.recording import Episode
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

BODIES = 8
"""Runners side by side in one process; belongs to the data, like the seed."""
MEDIUM = 0.42
"""Score of a medium behaviour as a share of the expert's."""


@dataclass(frozen=True)
class LocomotionRecipe:
    """How the data are made.

    Attributes:
        action_noise: Standard deviation of the Gaussian noise on every action entry. Experts are fragile: at 0.1
            most of the shipped hopper's runs end in a fall.
        episode_steps: Steps after which an episode is truncated.
    """

    action_noise: float = 0.03
    episode_steps: int = 1000

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if not 0.0 <= self.action_noise < math.inf:
            raise UserError(f"action_noise: found {self.action_noise}, expected a number of at least 0")
        if self.episode_steps < 1:
            raise UserError(f"episode_steps: found {self.episode_steps}, expected at least 1")


def collect_locomotion(
    task: Task | str,
    steps: int = 1_000_000,
    seed: int = 0,
    out: str | Path = "data",
    workers: int | None = None,
    *,
    recipe: LocomotionRecipe | None = None,
    ladder: Mapping[str, MLPPolicy] | None = None,
    dataset_id: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Collect a locomotion data set and write it as a Minari data set.

    An interrupted call goes on where it stopped when it is made again.

    Args:
        task: A locomotion task or its name.
        steps: Environment steps in all.
        seed: Same seed, same bytes of every array, whatever the workers and interruptions.
        out: Folder of data sets; the set becomes `out/<dataset_id>`.
        workers: Processes; None takes every core, 1 stays in this process.
        recipe: What the behaviour does.
        ladder: Policies by name, rising scores, the last the expert; None takes the shipped ones.
        dataset_id: Name of the set; None takes the task's own, for example "hopper-medium-expert-v0".
        overwrite: Replace a set of the same name.
        progress: Show a progress bar on standard error.

    Returns:
        The data set's folder; `load_trajectories(f"local:{folder}", task)` reads it.

    Raises:
        UserError: For a task of another family, a number out of range, no ladder, or a folder that exists.
    """
    task = get_task(task) if isinstance(task, str) else task
    recipe = recipe or LocomotionRecipe()
    if task.family != "locomotion":
        raise UserError(f"task: '{task.name}' is no locomotion task, and this collector knows only those")
    folder = place(task, steps, seed, out, dataset_id, overwrite)
    body, _, quality = task.base_name.partition("-")
    chosen = mixture(ladder or load_ladder(body), quality)
    recorder = _Recorder(task, seed, steps, recipe, tuple(chosen.values()))
    behaviours = {rung: dict(policy.metadata) for rung, policy in chosen.items()}
    noise = f"with action noise {recipe.action_noise}"
    return record_set(
        folder,
        recorder,
        recorder.env(),
        {"task": task.name, "seed": seed, "steps": steps, **asdict(recipe), "behaviours": behaviours},
        observation_space=gym.spaces.Box(-np.inf, np.inf, (task.observation_dim,), np.float32),
        algorithm=f"PPO, {', '.join(chosen)}",
        description=f"{body} run by {len(chosen)} behaviour(s) {noise}. Seed {seed}.",
        workers=workers,
        overwrite=overwrite,
        progress=progress,
    )


def mixture(ladder: Mapping[str, MLPPolicy], quality: str) -> dict[str, MLPPolicy]:
    """The behaviours of a data quality.

    Args:
        ladder: Policies by name with `metadata["score"]["score"]`, rising, the last the expert.
        quality: "medium", "medium-replay" (all rungs up to the medium one) or "medium-expert".

    Raises:
        UserError: For another quality.
    """
    names = list(ladder)
    scores = np.array([float(ladder[name].metadata["score"]["score"]) for name in names])
    middle = int(np.argmin(np.abs(scores[:-1] - MEDIUM * scores[-1])))
    chosen = {
        "medium": names[middle : middle + 1],
        "medium-replay": names[: middle + 1],
        "medium-expert": [names[middle], names[-1]],
    }
    if quality not in chosen:
        raise UserError(f"quality: found '{quality}', expected one of {', '.join(chosen)}")
    return {name: ladder[name] for name in chosen[quality]}


class _Recorder:
    """Records round i of a data set: some runners of one behaviour side by side; follows from (seed, i) alone."""

    def __init__(
        self, task: Task, seed: int, steps: int, recipe: LocomotionRecipe, policies: tuple[MLPPolicy, ...]
    ) -> None:
        self.task, self.seed, self.steps, self.recipe, self.policies = task, seed, steps, recipe, policies
        # Each behaviour needs rounds enough for its share, however small the set is.
        self.size = min(BODIES * recipe.episode_steps, -(-steps // len(policies)))
        self.rounds = -(-steps // self.size)
        self._envs: list[gym.Env[Any, Any]] = []

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_envs": []}  # each process makes its own

    def env(self, body: int = 0) -> gym.Env[Any, Any]:
        while len(self._envs) <= body:
            self._envs.append(build_env(self.task.env_id, max_episode_steps=self.recipe.episode_steps))
        return self._envs[body]

    def __call__(self, number: int) -> list[Episode]:
        size = min(self.size, self.steps - number * self.size)
        each = -(-size // BODIES)
        policy = self.policies[number % len(self.policies)]
        runs = []
        for body in range(-(-size // each)):
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number, body)))
            runs.append(_Run(self.recipe, self.env(body), rng, min(each, size - body * each)))
        while running := [run for run in runs if run.left]:
            states = np.stack([run.state for run in running])
            for run, action in zip(running, policy.act(states), strict=True):
                run.step(action)
        return [episode for run in runs for episode in run.episodes]


class _Run:
    """One runner for a number of steps, in as many episodes as they take."""

    def __init__(self, recipe: LocomotionRecipe, env: gym.Env[Any, Any], rng: np.random.Generator, steps: int) -> None:
        self.recipe, self.env, self.rng, self.left = recipe, env, rng, steps
        self.episodes: list[Episode] = []
        self._begin()

    def _begin(self) -> None:
        self.state, _ = self.env.reset(seed=int(self.rng.integers(2**31)))
        self.observations: list[NDArray[Any]] = [self.state]
        self.actions: list[NDArray[np.float32]] = []
        self.rewards: list[float] = []

    def step(self, action: NDArray[np.float32]) -> None:
        """Act once, with noise; where the episode ends, begin the next."""
        noise = self.recipe.action_noise * self.rng.standard_normal(len(action))
        self.actions.append(np.clip(action + noise, -1.0, 1.0).astype(np.float32))
        self.state, reward, terminated, truncated, _ = self.env.step(self.actions[-1])
        self.observations.append(self.state)
        self.rewards.append(float(reward))
        self.left -= 1
        if terminated or truncated or not self.left:
            self.episodes.append(self._episode(terminated))
            if self.left:
                self._begin()

    def _episode(self, terminated: bool) -> Episode:
        last = np.arange(len(self.rewards)) == len(self.rewards) - 1
        return {
            "observations": np.array(self.observations, np.float32),
            "actions": np.array(self.actions),
            "rewards": np.array(self.rewards),
            "terminations": last & terminated,
            "truncations": last & (not terminated),
        }


class Runners:
    """The behaviours of a data set as an actor: environment e is played by behaviour e modulo their number.

    `codes` is None: this actor chooses no skills.
    """

    def __init__(
        self, task: Task | str, recipe: LocomotionRecipe | None = None, ladder: Mapping[str, MLPPolicy] | None = None
    ) -> None:
        """Prepare for `task`; the arguments are those of `collect_locomotion`."""
        task = get_task(task) if isinstance(task, str) else task
        self.recipe = recipe or LocomotionRecipe()
        body, _, quality = task.base_name.partition("-")
        self.policies = tuple(mixture(ladder or load_ladder(body), quality).values())
        self.codes: NDArray[np.int64] | None = None
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Prepare for `num_envs` environments; `seed` fixes the noise."""
        del num_envs
        self._rng = np.random.default_rng(seed)

    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Actions (E, A) in the box for observations (E, O)."""
        del restarted
        owners = np.arange(len(observations)) % len(self.policies)
        proposed = np.stack([policy.act(observations) for policy in self.policies])  # (policies, E, A)
        actions = proposed[owners, np.arange(len(observations))]
        noise = self.recipe.action_noise * self._rng.standard_normal(actions.shape)
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)
