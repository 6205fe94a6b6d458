"""Train a behaviour policy: `python -m datamodules.behaviours.train ant|hopper|walker2d|halfcheetah`.

Runs in one process and one thread. Ctrl-C or SIGTERM stops after the current step with everything saved; `--resume`
continues. The folder receives `curve.csv`, `snapshots/STEPS.safetensors` (the ladder) and `state.pt`.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from dds_lightning.errors import UserError, lacks_extra

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as missing:
    raise lacks_extra("training a behaviour needs stable-baselines3", "behaviours") from missing

from datamodules.behaviours.training.ant_world import AntWorld
from datamodules.behaviours.training.learner import build_learner, export_policy, load_state, save_state
from datamodules.behaviours.training.recipes import RECIPES, Recipe, get_recipe
from dds_lightning.console.interrupts import caught, deferred, pending

COLUMNS = ("steps", "hours", "return", "episode_steps", "speed", "falls_per_1000", "exploration", "steps_per_second")
EULER = int(mujoco.mjtIntegrator.mjINT_EULER)


class Bookkeeper(BaseCallback):
    """Writes the curve, the snapshots and the state; stops the training when a signal is pending."""

    def __init__(self, recipe: Recipe, learner: PPO, out: Path, hours: float, every: int = 50_000) -> None:
        super().__init__()
        self.learner: Any = learner
        world: Any = learner.env
        self.recipe, self.out, self.every = recipe, out, every
        self.hours_before, self.began = hours, time.process_time()
        self.falls, self.speeds = 0, 0.0
        self.world = world.unwrapped
        self.models: list[mujoco.MjModel] = world.get_attr("model")
        self.integrator = self.models[0].opt.integrator
        self.next_row = self.next_snapshot = self.next_state = 0
        self.spacing = max(recipe.steps // recipe.rungs, 1)
        self.last = (time.process_time(), 0)

    @property
    def hours(self) -> float:
        """Hours of one core so far, including those before a resumption."""
        return self.hours_before + (time.process_time() - self.began) / 3600

    def _on_training_start(self) -> None:
        steps = self.num_timesteps
        self.last = (time.process_time(), steps)
        self.next_row, self.next_state = steps + self.every, steps + 5 * self.every
        self.next_snapshot = -(-steps // self.spacing) * self.spacing

    def _on_rollout_start(self) -> None:
        coarse = self.num_timesteps < self.recipe.coarse_steps
        for model in self.models:
            model.opt.integrator = EULER if coarse else self.integrator
        if self.num_timesteps >= self.next_snapshot:
            self.snapshot()
            self.next_snapshot += self.spacing
        if self.num_timesteps >= self.next_row:
            self.row()
            self.next_row += self.every
        if self.num_timesteps >= self.next_state:
            self.save()
            self.next_state += 5 * self.every

    def _on_step(self) -> bool:
        if isinstance(self.world, AntWorld):
            self.falls += sum(info["walk"]["fell"] for info in self.locals["infos"] if "walk" in info)
            self.speeds += float(self.world.speed.sum())
        return pending() is None

    def snapshot(self) -> None:
        """Write the current policy."""
        facts = {
            "behaviour": self.recipe.name,
            "environment": self.recipe.world,
            "algorithm": "PPO",
            "steps": self.num_timesteps,
            "hours": round(self.hours, 3),
        }
        export_policy(self.learner, facts).save(self.out / "snapshots" / f"{self.num_timesteps:09d}.safetensors")

    def save(self) -> None:
        """Write the state to resume from."""
        save_state(self.learner, self.out / "state.pt", {"hours": self.hours})

    def row(self) -> None:
        """Append a row to curve.csv and print it."""
        episodes = list(self.learner.ep_info_buffer or [])
        now, then = time.process_time(), self.last
        ant = isinstance(self.world, AntWorld)
        walked = max(self.num_timesteps - then[1], 1)
        row = {
            "steps": self.num_timesteps,
            "hours": round(self.hours, 4),
            "return": round(float(np.mean([e["r"] for e in episodes])), 2) if episodes else "",
            "episode_steps": round(float(np.mean([e["l"] for e in episodes])), 1) if episodes else "",
            "speed": round(self.speeds / walked, 3) if ant else "",
            "falls_per_1000": round(1000 * self.falls / walked, 3) if ant else "",
            "exploration": round(float(self.learner.policy.log_std.detach().exp().mean()), 3),
            "steps_per_second": round((self.num_timesteps - then[1]) / (now - then[0])),
        }
        self.last, self.falls, self.speeds = (now, self.num_timesteps), 0, 0.0
        path = self.out / "curve.csv"
        fresh = not path.exists()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)


def train(recipe: Recipe, out: Path, *, seed: int = 0, resume: bool = False) -> int:
    """Train until the recipe's steps are done or a signal arrives.

    Args:
        recipe: What to train.
        out: The folder; must be new or empty unless `resume` is set.
        seed: Seed of networks, environments and noise.
        resume: Continue from `out/state.pt`.

    Returns:
        Total number of steps, including those before a resumption.

    Raises:
        UserError: The folder is not empty, or there is no state to resume from.
    """
    torch.set_num_threads(1)
    state = out / "state.pt"
    if not resume and out.exists() and any(out.iterdir()):
        raise UserError(f"out: {out} is not empty; add --resume to continue there, or choose another folder")
    if resume and not state.is_file():
        raise UserError(f"resume: {state} does not exist; leave out --resume to start a new training")
    out.mkdir(parents=True, exist_ok=True)
    learner = build_learner(recipe, seed)
    hours = load_state(learner, state)["hours"] if resume else 0.0
    book = Bookkeeper(recipe, learner, out, hours)
    with caught(), deferred():
        learner.learn(
            max(recipe.steps - learner.num_timesteps, 0),
            callback=book,
            reset_num_timesteps=not resume,
            progress_bar=sys.stderr.isatty(),
        )
        book.snapshot()
        book.save()
    return learner.num_timesteps


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        "python -m datamodules.behaviours.train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("behaviour", choices=RECIPES)
    parser.add_argument("--steps", type=int, help="environment steps, instead of the recipe's")
    parser.add_argument("--out", type=Path, help="output folder (default: runs/behaviours/NAME)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", action="store_true", help="continue from the folder's state.pt")
    arguments = parser.parse_args()
    recipe = get_recipe(arguments.behaviour)
    if arguments.steps:
        recipe = replace(recipe, steps=arguments.steps)
    out = arguments.out or Path("runs/behaviours") / recipe.name
    try:
        steps = train(recipe, out, seed=arguments.seed, resume=arguments.resume)
    except UserError as error:
        parser.exit(2, f"{error}\n")
    print(f"{steps} steps in {out}")


if __name__ == "__main__":
    main()
