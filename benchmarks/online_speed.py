"""How fast is SAC on raw actions beside stable-baselines3's, on one core?

    python benchmarks/online_speed.py --steps 1000

Both learn Pendulum-v1 with one environment, one update a step, batches of 256 and two hidden layers of 256. Prints
environment steps per second of processor time, in which a busy machine counts less than in seconds on the clock; the
start (imports, the first 200 steps) is left out. Needs stable-baselines3.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch

from datamodules.online import OnlineDataModule
from dds_lightning.callbacks.guard import FiniteGuard
from dds_lightning.online.sac import SACModule

TASK = "env_id: Pendulum-v1\nmax_episode_steps: 200\nscore_min: -1200\nscore_max: -150\n"
START = 200


def ours(steps: int) -> float:
    """Steps per second of processor time of `dds online fit` without its files."""
    with tempfile.TemporaryDirectory() as folder:
        task = Path(folder) / "pendulum.yaml"
        task.write_text(TASK)
        data = OnlineDataModule(str(task), actions="raw", updates=1.0, random_steps=START, num_envs=1)
        module = SACModule(data.observation_dim, "raw", data.choices, backup_entropy=True, target_entropy=1.0)
        data.setup("fit")
        clock: dict[str, float] = {}

        class Clock(pl.Callback):
            def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
                if trainer.global_step == 50:
                    clock["start"] = time.process_time()

        trainer = pl.Trainer(
            max_steps=steps + 50,
            accelerator="cpu",
            logger=False,
            callbacks=[Clock(), FiniteGuard()],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
        )
        trainer.fit(module, data)
        return steps / (time.process_time() - clock["start"])


def theirs(steps: int) -> float:
    """The same of stable-baselines3."""
    import gymnasium as gym
    from stable_baselines3 import SAC

    model = SAC("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=START, batch_size=256, device="cpu", seed=0)
    model.learn(START + 50)
    start = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return steps / (time.process_time() - start)


def main() -> None:
    """Measure both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000)
    steps = parser.parse_args().steps
    torch.set_num_threads(1)
    own = ours(steps)
    print(f"dds-lightning      {own:6.1f} steps per second of processor time")
    other = theirs(steps)
    print(f"stable-baselines3  {other:6.1f}\nratio              {own / other:6.2f}")


if __name__ == "__main__":
    main()
