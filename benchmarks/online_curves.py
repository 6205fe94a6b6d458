"""Does SAC on raw actions learn as stable-baselines3's does? Curves of both, seed by seed.

    python benchmarks/online_curves.py Pendulum-v1 --steps 8000 --seeds 3

All have the settings of `online_speed.py`, which are stable-baselines3's; ours learns in float32 and in bfloat16. What
is compared is the mean return of the latest ten episodes played while learning. Writes `results/online_ENV.parquet` and
`.png`, where learners that are not asked for keep their curves; prints the returns at a quarter, half and the end, and
whether all ranges over the seeds overlap there. Needs stable-baselines3.
"""

import argparse
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import lightning.pytorch as pl
import pandas as pd
import torch
from matplotlib.figure import Figure
from online_speed import START, train

COLOURS = {"dds-lightning": "#0072b2", "dds-lightning, bfloat16": "#56b4e9", "stable-baselines3": "#d55e00"}
RESULTS = Path(__file__).parent / "results"
LATEST = 10
EVERY = 200
"""Environment steps between two points of a curve."""


class Watch(pl.Callback):
    """Mean return of the latest episodes, every `EVERY` steps."""

    def __init__(self) -> None:
        self.curve: list[tuple[int, float]] = []

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Note where the collector is."""
        collector = trainer.datamodule.loader.collector  # type: ignore[attr-defined]
        if collector.steps % EVERY == 0 and collector.finished:
            returns = [row[0] for row in collector.finished][-LATEST:]
            self.curve.append((collector.steps, sum(returns) / len(returns)))


def ours(env_id: str, steps: int, seed: int, way: str = "float32") -> list[tuple[int, float]]:
    """(environment steps, return) of `dds online fit`."""
    watch = Watch()
    train(env_id, steps - START, watch, seed, way)
    return watch.curve


def theirs(env_id: str, steps: int, seed: int) -> list[tuple[int, float]]:
    """The same of stable-baselines3."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    curve: list[tuple[int, float]] = []

    class Note(BaseCallback):
        def _on_step(self) -> bool:
            returns: deque[Any] = self.model.ep_info_buffer
            if self.num_timesteps % EVERY == 0 and returns:
                latest = [one["r"] for one in list(returns)[-LATEST:]]
                curve.append((self.num_timesteps, sum(latest) / len(latest)))
            return True

    model = SAC("MlpPolicy", gym.make(env_id), learning_starts=START, batch_size=256, device="cpu", seed=seed)
    model.learn(steps, callback=Note())
    return curve


LEARNERS: dict[str, Callable[..., list[tuple[int, float]]]] = dict(
    zip(COLOURS, (ours, partial(ours, way="bfloat16"), theirs), strict=True)
)


def draw(table: pd.DataFrame, env_id: str) -> Figure:
    """Every seed as a line."""
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    ax = figure.add_subplot()
    for (name, seed), curve in table.groupby(["of", "seed"]):
        label = name if seed == table.loc[table["of"] == name, "seed"].min() else None
        ax.plot(curve["env_steps"], curve["return"], color=COLOURS[name], alpha=0.8, label=label)
    ax.set(xlabel="environment steps", ylabel=f"return of the latest {LATEST} episodes", title=env_id)
    ax.legend(frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    """Train all with every seed, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id")
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    file = RESULTS / f"online_{asked.env_id}.parquet"
    table = pd.read_parquet(file) if file.is_file() else pd.DataFrame()
    for name in asked.learners:
        rows = []
        for seed in range(asked.seeds):
            curve = LEARNERS[name](asked.env_id, asked.steps, seed)
            print(f"{name}, seed {seed}: {curve[-1][1]:.0f}", flush=True)
            rows += [{"of": name, "seed": seed, "env_steps": step, "return": value} for step, value in curve]
        others = table[table["of"] != name] if len(table) else table
        table = pd.concat([others, pd.DataFrame(rows)], ignore_index=True)
        table.to_parquet(file, index=False)
    draw(table, asked.env_id).savefig(file.with_suffix(".png"), dpi=120)
    for share in (0.25, 0.5, 1.0):
        at = int(asked.steps * share) // EVERY * EVERY
        found = table[table["env_steps"] == at].groupby("of")["return"].agg(["min", "mean", "max", "std"])
        apart = found["min"].max() > found["max"].min()
        print(f"{at:,} steps: {'apart' if apart else 'ranges overlap'}\n{found.round(1)}\n")


if __name__ == "__main__":
    main()
