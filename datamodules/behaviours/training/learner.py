"""stable-baselines3 made ready for a recipe: worlds, algorithm, export to NumPy, and a state to go on from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from datamodules.behaviours.policy import OBSERVATION_CLIP, MLPPolicy
from datamodules.behaviours.training.ant_world import AntWorld
from datamodules.behaviours.training.fast_ppo import FastPPO
from datamodules.behaviours.training.recipes import Recipe
from datamodules.behaviours.training.worlds import RunnerWorld, World
from dds_lightning.saving.checkpoint import load_ckpt
from dds_lightning.saving.files import written_whole


def build_world(recipe: Recipe, seed: int) -> World:
    """The recipe's environments, not normalised."""
    if recipe.world.startswith("ant:"):
        return AntWorld(recipe.world.removeprefix("ant:"), recipe.environments, seed=seed)
    return RunnerWorld(recipe.world, recipe.environments, seed)


def build_learner(recipe: Recipe, seed: int) -> FastPPO:
    """A fresh learner, its environments normalised by running statistics."""
    world = VecNormalize(
        VecMonitor(build_world(recipe, seed)), gamma=recipe.settings["gamma"], clip_obs=OBSERVATION_CLIP
    )
    policy_settings = {
        "net_arch": {"pi": list(recipe.hidden), "vf": list(recipe.hidden)},
        "activation_fn": torch.nn.Tanh,
        **recipe.policy_settings,
    }
    return FastPPO("MlpPolicy", world, policy_kwargs=policy_settings, device="cpu", seed=seed, **recipe.settings)


def export_policy(learner: FastPPO, metadata: Mapping[str, Any]) -> MLPPolicy:
    """The actor as it stands, with the observation statistics of now."""
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


def save_state(learner: FastPPO, path: Path, facts: Mapping[str, Any]) -> None:
    """Write what a training needs to go on: networks, Adam's means, statistics, steps. Episodes start again."""
    world: Any = learner.get_vec_normalize_env()
    state = {
        "state_dict": learner.policy.state_dict(),
        "moments": [torch.from_numpy(moment) for moment in learner.moments],
        "adam_steps": learner.adam_steps,
        "steps": learner.num_timesteps,
        "facts": dict(facts),
    }
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(world, name)
        state[name] = {"mean": torch.as_tensor(rms.mean), "var": torch.as_tensor(rms.var), "count": float(rms.count)}
    with written_whole(path) as part:
        torch.save(state, part)


def load_state(learner: FastPPO, path: Path) -> dict[str, Any]:
    """Go on from what `save_state` wrote; returns its facts.

    Raises:
        UserError: The file is missing or damaged.
    """
    state = load_ckpt(path)
    learner.policy.load_state_dict(state["state_dict"])
    for moment, saved in zip(learner.moments, state["moments"], strict=True):
        moment[:] = saved.numpy()
    learner.adam_steps, learner.num_timesteps = state["adam_steps"], state["steps"]
    world: Any = learner.get_vec_normalize_env()
    for name in ("obs_rms", "ret_rms"):
        rms, saved = getattr(world, name), state[name]
        rms.mean, rms.var, rms.count = saved["mean"].numpy(), saved["var"].numpy(), saved["count"]
    return state["facts"]
