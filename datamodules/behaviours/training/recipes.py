"""How each behaviour is trained: every number of it, in one place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dds_lightning.errors import UserError


def falling(start: float, end: float) -> Callable[[float], float]:
    """A learning rate that goes from `start` to `end` in a straight line."""
    return lambda remaining: end + (start - end) * remaining


@dataclass(frozen=True)
class Recipe:
    """One training.

    Attributes:
        name: What a user types.
        world: Gymnasium's name of the environment, or "ant:PHYSICS".
        steps: Environment steps of the whole training.
        environments: How many of them side by side.
        hidden: Widths of the actor's hidden layers.
        settings: More arguments of the algorithm.
        policy_settings: More arguments of its policy.
        coarse_steps: First steps, simulated by Euler's method in place of Runge-Kutta's: a quarter of the cost, nearly
            the same motion. The rest is learnt in the true physics.
        rungs: Snapshots that are kept along the way.
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
        # fast at first that snapshots must be close for a ladder to have a medium rung.
        _runner("halfcheetah", "HalfCheetah-v4", 6_000_000, rungs=120, ent_coef=0.003),
    )
}


def get_recipe(name: str) -> Recipe:
    """The recipe of that name.

    Raises:
        UserError: There is none.
    """
    if name not in RECIPES:
        raise UserError(f"behaviour: found '{name}', expected one of {', '.join(RECIPES)}")
    return RECIPES[name]
