"""stable-baselines3's PPO set up for a recipe: environments, algorithm, export to NumPy, and a state to resume from."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from datamodules.behaviours.policy import OBSERVATION_CLIP, MLPPolicy
from datamodules.behaviours.training.ant_world import AntWorld
from datamodules.behaviours.training.recipes import Recipe
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.saving.files import written_whole


def build_world(recipe: Recipe, seed: int) -> VecEnv:
    """The recipe's environments, side by side, before normalisation."""
    if recipe.world.startswith("ant:"):
        return AntWorld(recipe.world.removeprefix("ant:"), recipe.environments, seed=seed)
    world = DummyVecEnv([partial(build_env, recipe.world)] * recipe.environments)
    world.seed(seed)
    return world


def build_learner(recipe: Recipe, seed: int) -> PPO:
    """A new learner; observations and rewards are normalised by running statistics."""
    world = VecNormalize(
        VecMonitor(build_world(recipe, seed)), gamma=recipe.settings["gamma"], clip_obs=OBSERVATION_CLIP
    )
    policy_settings = {
        "net_arch": {"pi": list(recipe.hidden), "vf": list(recipe.hidden)},
        "activation_fn": torch.nn.Tanh,
        **recipe.policy_settings,
    }
    return PPO("MlpPolicy", world, policy_kwargs=policy_settings, device="cpu", seed=seed, **recipe.settings)


def export_policy(learner: PPO, metadata: Mapping[str, Any]) -> MLPPolicy:
    """The learner's current actor together with its current observation statistics."""
    policy: Any = learner.policy
    world: Any = learner.get_vec_normalize_env()
    layers = [m for m in policy.mlp_extractor.policy_net if isinstance(m, torch.nn.Linear)] + [policy.action_net]
    return MLPPolicy(
        weights=tuple(layer.weight.detach().numpy().T.copy() for layer in layers),
        biases=tuple(layer.bias.detach().numpy().copy() for layer in layers),
        mean=world.obs_rms.mean.astype(np.float32),
        std=np.sqrt(world.obs_rms.var + world.epsilon).astype(np.float32),
        log_std=policy.log_std.detach().numpy().copy(),
        activation="tanh",
        output="clip",
        metadata=metadata,
    )


def save_state(learner: PPO, path: Path, facts: Mapping[str, Any]) -> None:
    """Write what a training needs to resume: networks, optimiser, statistics, steps. Episodes start again."""
    world: Any = learner.get_vec_normalize_env()
    state = {
        "state_dict": learner.policy.state_dict(),
        "optimizer": learner.policy.optimizer.state_dict(),
        "steps": learner.num_timesteps,
        "facts": dict(facts),
    }
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(world, name)
        state[name] = {"mean": torch.as_tensor(rms.mean), "var": torch.as_tensor(rms.var), "count": float(rms.count)}
    with written_whole(path) as part:
        torch.save(state, part)


def load_state(learner: PPO, path: Path) -> dict[str, Any]:
    """Resume from what `save_state` wrote.

    Returns:
        The facts that were saved with the state.

    Raises:
        UserError: The file is missing or damaged, or an earlier version wrote it.
    """
    state = load_ckpt(path)
    if "optimizer" not in state:
        raise UserError(f"resume: {path} has no optimiser state (an earlier version wrote it); train again from step 0")
    learner.policy.load_state_dict(state["state_dict"])
    learner.policy.optimizer.load_state_dict(state["optimizer"])
    learner.num_timesteps = state["steps"]
    world: Any = learner.get_vec_normalize_env()
    for name in ("obs_rms", "ret_rms"):
        rms, saved = getattr(world, name), state[name]
        rms.mean, rms.var, rms.count = saved["mean"].numpy(), saved["var"].numpy(), saved["count"]
    return state["facts"]
