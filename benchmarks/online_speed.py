"""How fast is SAC on raw actions beside stable-baselines3's, on one core?

    python benchmarks/online_speed.py --steps 1000 --rounds 3

Both learn Pendulum-v1 with one environment, one update a step, batches of 256 and two hidden layers of 256. Ours does
so in float32, in bfloat16, and in both with a compiled loss. Prints environment steps per second of processor time, in
which a busy machine counts less than in seconds on the clock, the best of the rounds; the start (imports, compiling,
the first 200 steps) is left out. Needs stable-baselines3.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import lightning.pytorch as pl
import torch

from datamodules.online import OnlineDataModule
from dds_lightning.callbacks.compiled import CompiledLoss
from dds_lightning.callbacks.guard import FiniteGuard
from dds_lightning.online.sac import SACModule

START = 200
"""Steps with random actions."""


WAYS: dict[str, tuple[Any, bool]] = {
    "float32": ("32-true", False),
    "float32, compiled": ("32-true", True),
    "bfloat16": ("bf16-mixed", False),
    "bfloat16, compiled": ("bf16-mixed", True),
}
"""Precision, and whether the loss is compiled."""


def train(env_id: str, steps: int, callback: pl.Callback, seed: int = 0, way: str = "float32") -> None:
    """SAC on raw actions with stable-baselines3's settings: `dds online fit` without its files.

    Args:
        env_id: Of Gymnasium.
        steps: Updates, one for each environment step after the first `START`.
        callback: Looks on.
        seed: Of networks, episodes and batches.
        way: One of `WAYS`.
    """
    precision, compiled = WAYS[way]
    longest = gym.spec(env_id).max_episode_steps
    pl.seed_everything(seed, verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        task = Path(folder) / "task.yaml"
        task.write_text(f"env_id: {env_id}\nmax_episode_steps: {longest}\nscore_min: 0\nscore_max: 1\n")
        data = OnlineDataModule(str(task), actions="raw", updates=1.0, random_steps=START, num_envs=1, seed=seed)
        settings = {"backup_entropy": True, "target_entropy": 1.0, "temperature": 1.0}
        module = SACModule(data.observation_dim, "raw", data.choices, **settings)
        data.setup("fit")
        trainer = pl.Trainer(
            max_steps=steps,
            accelerator="cpu",
            precision=precision,
            logger=False,
            callbacks=[callback, FiniteGuard(), *([CompiledLoss()] if compiled else [])],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
        )
        trainer.fit(module, data)


class Clock(pl.Callback):
    """Processor time when the first 50 steps are over."""

    began = 0.0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Start after a few steps."""
        if trainer.global_step == 50:
            self.began = time.process_time()


def ours(steps: int, way: str) -> float:
    """Steps per second of processor time."""
    clock = Clock()
    train("Pendulum-v1", steps + 50, clock, way=way)
    return steps / (time.process_time() - clock.began)


def theirs(steps: int) -> float:
    """The same of stable-baselines3."""
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=START, batch_size=256, device="cpu", seed=0)
    model.learn(START + 50)
    start = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return steps / (time.process_time() - start)


def main() -> None:
    """Measure both, in turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    best: dict[str, float] = {}
    for _ in range(asked.rounds):
        best["stable-baselines3"] = max(best.get("stable-baselines3", 0.0), theirs(asked.steps))
        for way in WAYS:
            best[way] = max(best.get(way, 0.0), ours(asked.steps, way))
    for name, speed in best.items():
        print(f"{name:20}{speed:6.1f} steps/s, {speed / best['stable-baselines3']:.2f} times stable-baselines3's")


if __name__ == "__main__":
    main()
