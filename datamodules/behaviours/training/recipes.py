"""How each behaviour is trained: all numbers in one place.

The shipped policies were trained with these numbers by an earlier implementation of the same algorithm, so training
again follows the same rules but does not give the same bits. A runner takes 0.5 ms per step on one core, about four
times as long as then (the halfcheetah 50 minutes in all); the Ant takes 0.16 ms in place of 0.12 ms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dds_lightning.errors import UserError


def falling(start: float, end: float) -> Callable[[float], float]:
    """A learning rate that falls linearly from `start` to `end`."""
    return lambda remaining: end + (start - end) * remaining


@dataclass(frozen=True)
class Recipe:
    """One training of one behaviour.

    Attributes:
        name: Name on the command line.
        world: Gymnasium's name of the environment, or "ant:PHYSICS".
        steps: Environment steps of the whole training.
        environments: Number of environments side by side.
        hidden: Widths of the actor's hidden layers.
        settings: Further arguments of PPO.
        policy_settings: Further arguments of its policy.
        coarse_steps: Number of steps at the beginning that are simulated with Euler's method instead of Runge-Kutta:
            a quarter of the cost, nearly the same motion. The rest is learnt in the true physics.
        rungs: Number of snapshots on the way.
    """

    name: str
    world: str
    steps: int
    environments: int
    hidden: tuple[int, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    policy_settings: Mapping[str, Any] = field(default_factory=dict)
    coarse_steps: int = 0
    rungs: int = 24


def _ant(name: str, physics: str) -> Recipe:
    return Recipe(
        name=name,
        world=f"ant:{physics}",
        steps=4_600_000,
        environments=64,
        hidden=(128, 128),
        settings={
            "n_steps": 64,
            "batch_size": 512,
            "n_epochs": 5,
            "learning_rate": falling(4e-4, 3e-5),
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "vf_coef": 0.5,
        },
        policy_settings={"log_std_init": -0.7},
        coarse_steps=4_000_000,
    )


def _runner(name: str, world: str, steps: int, coarse_steps: int = 0, rungs: int = 40, **settings: Any) -> Recipe:
    return Recipe(
        name=name,
        world=world,
        steps=steps,
        environments=32,
        hidden=(64, 64),
        settings={
            "n_steps": 64,
            "batch_size": 64,
            "n_epochs": 10,
            "learning_rate": falling(3e-4, 0.0),
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "vf_coef": 0.25,
            **settings,
        },
        policy_settings={"log_std_init": -0.5},
        coarse_steps=coarse_steps,
        rungs=rungs,
    )


RECIPES = {
    recipe.name: recipe
    for recipe in (
        _ant("ant", "d4rl"),
        _ant("ant-robotics", "robotics"),
        _runner("hopper", "Hopper-v4", 1_200_000, 900_000),
        _runner("walker2d", "Walker2d-v4", 3_000_000, 2_600_000),
        # Without a bonus on entropy the cheetah stops exploring early, in a gait that ends at 65 points. It learns so
        # fast at first that snapshots must be close together for a ladder to have a medium rung.
        _runner("halfcheetah", "HalfCheetah-v4", 6_000_000, rungs=120, ent_coef=0.003),
    )
}


def get_recipe(name: str) -> Recipe:
    """The recipe with this name.

    Raises:
        UserError: There is no such recipe.
    """
    if name not in RECIPES:
        raise UserError(f"behaviour: got '{name}', expected one of {', '.join(RECIPES)}")
    return RECIPES[name]
