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
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from datamodules.behaviours.policy import MLPPolicy
from datamodules.behaviours.shipped import load_ladder
from datamodules.collect.collecting import Collector, DataSetPlan
from datamodules.collect.recording import Episode
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

BODIES = 8
"""Runners side by side in one process; the data depend on it, as on the seed."""
MEDIUM = 0.42
"""Score of the medium behaviour as a share of the expert's."""


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
        """Refuse settings out of range."""
        if not 0.0 <= self.action_noise < math.inf:
            raise UserError(f"action_noise: got {self.action_noise}, expected a number of at least 0")
        if self.episode_steps < 1:
            raise UserError(f"episode_steps: got {self.episode_steps}, expected at least 1")


def _plan(
    task: Task, seed: int, steps: int, recipe: LocomotionRecipe, ladder: Mapping[str, MLPPolicy] | None = None
) -> DataSetPlan:
    body, _, quality = task.base_name.partition("-")
    chosen = mixture(ladder or load_ladder(body), quality)
    recorder = _Recorder(task, seed, steps, recipe, tuple(chosen.values()))
    noise = f"with action noise {recipe.action_noise}"
    return DataSetPlan(
        recorder,
        recorder.env(),
        algorithm=f"PPO, {', '.join(chosen)}",
        description=f"{body} run by {len(chosen)} behaviour(s) {noise}. Seed {seed}.",
        settings={"behaviours": {rung: dict(policy.metadata) for rung, policy in chosen.items()}},
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
        raise UserError(f"quality: got '{quality}', expected one of {', '.join(chosen)}")
    return {name: ladder[name] for name in chosen[quality]}


class _Recorder:
    """Records round i of a data set: runners of one behaviour side by side; depends on (seed, i) alone."""

    def __init__(
        self, task: Task, seed: int, steps: int, recipe: LocomotionRecipe, policies: tuple[MLPPolicy, ...]
    ) -> None:
        self.task, self.seed, self.steps, self.recipe, self.policies = task, seed, steps, recipe, policies
        # Each behaviour needs enough rounds for its share, however small the set is.
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
    """One runner for a number of steps, in as many episodes as that takes."""

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
        """Act once, with noise; begin the next episode where this one ends."""
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
            "observations": np.array(self.observations),
            "actions": np.array(self.actions),
            "rewards": np.array(self.rewards),
            "terminations": last & terminated,
            "truncations": last & (not terminated),
        }


class Runners:
    """The behaviours of a data set as an actor: behaviour e modulo their number plays in environment e."""

    def __init__(
        self, task: Task | str, recipe: LocomotionRecipe | None = None, ladder: Mapping[str, MLPPolicy] | None = None
    ) -> None:
        """Prepare for `task`; the arguments are those of `collect_locomotion`."""
        self.recipe = recipe or LocomotionRecipe()
        body, _, quality = get_task(task).base_name.partition("-")
        self.policies = tuple(mixture(ladder or load_ladder(body), quality).values())
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Prepare for new episodes in `num_envs` environments; `seed` fixes the noise."""
        self.num_envs, self._rng = num_envs, np.random.default_rng(seed)

    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """As `Actor.act`: actions (n, A) in the box for observations (n, O); without `rows`, of all environments."""
        rows = np.arange(self.num_envs) if rows is None else rows
        proposed = np.stack([policy.act(observations) for policy in self.policies])  # (policies, n, A)
        actions = proposed[rows % len(self.policies), np.arange(len(rows))]
        # Drawn for all environments, so that the noise of one does not depend on which others have finished.
        noise = self.recipe.action_noise * self._rng.standard_normal((self.num_envs, actions.shape[1]))[rows]
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)


COLLECTOR = Collector("locomotion", None, 1_000_000, LocomotionRecipe, _plan, Runners)


def collect_locomotion(
    task: Task | str, *arguments: Any, ladder: Mapping[str, MLPPolicy] | None = None, **options: Any
) -> Path:
    """Collect a locomotion data set.

    Args:
        task: A locomotion task or its name.
        *arguments: As in `Collector.collect`.
        ladder: Policies by name, rising scores, the last the expert; None takes the shipped ones.
        **options: As in `Collector.collect`.

    Returns:
        The data set's folder.

    Raises:
        UserError: As in `Collector.collect`, and without a ladder for the task's body.
    """
    collector = replace(COLLECTOR, plan=partial(_plan, ladder=ladder))
    return collector.collect(task, *arguments, **options)
