"""Scores of behaviour policies: returns of the runners, speed and falls of the Ant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from datamodules.behaviours.policy import MLPPolicy
from dds_lightning.envs.build import build_env
from dds_lightning.tasks import get_task

UPRIGHT, ON_ITS_BACK = 0.5, 0.0
"""Cosines of the tilt: a body has fallen when it was above the first and drops below the second."""


@dataclass(frozen=True)
class RunnerScore:
    """Returns of whole episodes.

    Attributes:
        score: Mean D4RL-normalised score.
        mean_return: Mean return.
        std_return: Standard deviation of the returns.
        mean_steps: Mean length of the episodes.
        episodes: Number of episodes.
        sampled: Whether actions were sampled as in training; otherwise they are the policy's means.
    """

    score: float
    mean_return: float
    std_return: float
    mean_steps: float
    episodes: int
    sampled: bool

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, rounded for files."""
        return {key: round(value, 2) if isinstance(value, float) else value for key, value in asdict(self).items()}


def score_runner(
    policy: MLPPolicy, behaviour: str, *, episodes: int = 20, seed: int = 0, sampled: bool = False
) -> RunnerScore:
    """Play whole episodes side by side.

    Args:
        policy: The policy that acts.
        behaviour: "hopper", "walker2d" or "halfcheetah".
        episodes: Number of episodes; episode i is reset with `seed + i`.
        seed: Seed of the episodes and of sampled actions.
        sampled: Sample actions as in training.

    Returns:
        The score over all episodes.
    """
    task = get_task(f"{behaviour}-medium")
    environments = [build_env(task.env_id) for _ in range(episodes)]
    rng = np.random.default_rng(seed) if sampled else None
    observations = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(environments)])
    returns, lengths = np.zeros(episodes), np.zeros(episodes, dtype=np.int64)
    playing = np.ones(episodes, dtype=bool)
    while playing.any():
        actions = policy.act(observations, rng)
        for i in np.flatnonzero(playing):
            observations[i], reward, terminated, truncated, _ = environments[i].step(actions[i])
            returns[i] += float(reward)
            lengths[i] += 1
            playing[i] = not (terminated or truncated)
    for env in environments:
        env.close()
    return RunnerScore(
        score=float(task.normalised_score(returns).mean()),
        mean_return=float(returns.mean()),
        std_return=float(returns.std()),
        mean_steps=float(lengths.mean()),
        episodes=episodes,
        sampled=sampled,
    )


@dataclass(frozen=True)
class WalkScore:
    """How well an Ant follows headings.

    Attributes:
        action_noise: Standard deviation of Gaussian noise on its actions.
        speed: Mean speed along the heading in m/s, including time on its back.
        upright_speed: The same over the steps of Ants that have not fallen yet.
        falls_per_1000: Falls per 1,000 steps of standing bodies.
        on_its_back: Share of the Ants that lie on their backs at the end.
        steps: Environment steps behind the numbers.
    """

    action_noise: float
    speed: float
    upright_speed: float
    falls_per_1000: float
    on_its_back: float
    steps: int

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, rounded for files."""
        return {key: round(value, 4) for key, value in asdict(self).items()}


def score_walker(
    act: Callable[[NDArray[np.float32]], NDArray[Any]],
    physics: str,
    *,
    action_noise: float = 0.0,
    ants: int = 64,
    steps: int = 1000,
    seed: int = 0,
    heading_steps: tuple[int, int] | None = None,
) -> WalkScore:
    """Let Ants follow changing headings for one long episode each; a fall does not end it.

    Args:
        act: Maps features (B, 28) of `ant.see` to actions (B, 8); `MLPPolicy.act`, for example.
        physics: "d4rl" or "robotics".
        action_noise: Standard deviation of Gaussian noise on the actions.
        ants: Number of episodes.
        steps: Steps of an episode.
        seed: Seed of starts, headings and noise.
        heading_steps: Fewest and most steps for which a heading holds; by default as in training.

    Returns:
        The score over all Ants and steps.
    """
    from datamodules.behaviours.training.ant_world import AntWorld, calm

    rules = calm(physics)
    if heading_steps is not None:
        rules = replace(rules, heading_steps=heading_steps)
    world = AntWorld(physics, ants, rules, seed=seed)
    seen = world.reset()
    world.noise[:] = action_noise
    standing = np.ones(ants, dtype=bool)
    never_fell = np.ones(ants, dtype=bool)
    falls = standing_steps = 0
    speed = upright_speed = upright_steps = 0.0
    for _ in range(steps):
        world.step_async(act(seen))
        seen, _, _, _ = world.step_wait()
        fell = standing & (world.upright < ON_ITS_BACK)
        standing = np.where(standing, ~fell, world.upright > UPRIGHT)
        never_fell &= ~fell
        falls += int(fell.sum())
        standing_steps += int(standing.sum())
        speed += world.speed.sum()
        upright_speed += world.speed[never_fell].sum()
        upright_steps += never_fell.sum()
    return WalkScore(
        action_noise=action_noise,
        speed=float(speed / (ants * steps)),
        upright_speed=float(upright_speed / max(upright_steps, 1)),
        falls_per_1000=1000 * falls / max(standing_steps, 1),
        on_its_back=float(1.0 - standing.mean()),
        steps=ants * steps,
    )


def score_navigator(physics: str, noises: tuple[float, ...], *, episodes: int = 100, seed: int = 0) -> pd.DataFrame:
    """Let a shipped Ant controller walk from the start to the evaluation's goal, in each of D4RL's mazes.

    Args:
        physics: "d4rl" or "robotics".
        noises: Standard deviations of Gaussian noise on the actions.
        episodes: Number of episodes for each maze and noise.
        seed: Seed of goals, starts and noise.

    Returns:
        One row per maze and noise: `maze`, `action_noise`, `episodes`, `reached`, `median_steps` (of the episodes that
        reached the goal), `cap` (steps after which an episode is over).
    """
    from datamodules.collect.antmaze import AntMazeRecipe, AntNavigator
    from dds_lightning.rollout.actors import Contestant
    from dds_lightning.rollout.play import rollout

    rows = []
    for maze in ("umaze", "medium", "large"):
        task = get_task(f"antmaze-{maze}{'' if maze == 'umaze' else '-diverse'}").variant(physics)
        players = [
            Contestant(f"{noise:g}", AntNavigator(task, AntMazeRecipe(action_noise=noise)), episodes)
            for noise in noises
        ]
        played = rollout(task, players, seed=seed).episodes
        for player, noise in zip(players, noises, strict=True):
            own = played[played["actor"] == player.name]
            there = own[own["success"].astype(bool)]
            rows.append(
                {
                    "maze": maze,
                    "action_noise": noise,
                    "episodes": episodes,
                    "reached": len(there),
                    "median_steps": float(there["length"].median()),
                    "cap": task.max_episode_steps,
                }
            )
    return pd.DataFrame(rows)
