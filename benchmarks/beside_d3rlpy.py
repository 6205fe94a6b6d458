"""Does our training of a method score as d3rlpy's own training of it does, on the same data?

    python benchmarks/beside_d3rlpy.py hopper-medium-expert --data local:DIR [--methods clone iql td3bc]
        [--steps 16000] [--seeds 3] [--episodes 50] [--out runs/d3rlpy]

Cloning is our own code here and d3rlpy's there. Of IQL and TD3+BC the update is d3rlpy's in both; data, units, loop,
checkpoints and evaluation are ours here, and `MDPDataset`, `StandardObservationScaler` and `fit` there. Steps, batches,
widths, rates and learning rewards are the same, and both play the same episodes. Prints means over the seeds and how
far they are apart, and writes `scores.csv` to --out, a row for each training. Finished trainings are kept there, and an
interrupted comparison goes on. Needs d3rlpy (the extra `baselines`).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.console import Console

from datamodules import load_trajectories
from datamodules.relabelling import Relabelling
from dds_lightning.baselines.d3 import library
from dds_lightning.baselines.methods import METHODS
from dds_lightning.rollout.actors import Acted, Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.saving.run_directory import RunDirectory
from dds_lightning.tasks import Task, get_task
from dds_lightning.training.stage_cli import command

WIDTHS = [256, 256]
PEERS: dict[str, tuple[str, dict[str, Any]]] = {
    "clone": ("BCConfig", {"batch_size": 512, "learning_rate": 1e-3}),
    "iql": ("IQLConfig", {"batch_size": 256}),
    "td3bc": ("TD3PlusBCConfig", {"batch_size": 256}),
}
"""Method -> d3rlpy's name, and what our preset (`dds_lightning/configs/METHOD.yaml`) has otherwise than its default."""


class Predictor:
    """An algorithm of d3rlpy as an `Actor`."""

    def __init__(self, algorithm: Any, task: Task) -> None:
        self.algorithm, self.box = algorithm, task.action_box()

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """It has no memory."""

    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]) -> Acted:
        """As `Actor.act`."""
        return Acted(self.algorithm.predict(np.ascontiguousarray(observations, np.float32)).clip(*self.box))


def theirs(method: str, task: Task, spec: str, steps: int, seed: int, folder: Path) -> Predictor:
    """Train by d3rlpy alone."""
    import structlog

    d3 = library()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))  # d3rlpy's messages
    d3.seed(seed)
    data = load_trajectories(spec, task)
    rewards = Relabelling(reward_scale="auto", reward_shift="auto").for_task(task).learning_rewards(data, 1)
    acted_on = np.ones(len(data.observations), dtype=bool)
    acted_on[data.observation_offsets[1:] - 1] = False  # d3rlpy has no place for what an episode's last action led to
    columns = (rewards, data.terminations, data.truncations)
    dataset = d3.dataset.MDPDataset(
        data.observations[acted_on], data.actions, *(column.astype(np.float32) for column in columns)
    )
    name, settings = PEERS[method]
    config = getattr(d3.algos, name)
    names = [field.name for field in dataclasses.fields(config) if field.name.endswith("encoder_factory")]
    settings = {**settings, **dict.fromkeys(names, d3.models.VectorEncoderFactory(WIDTHS))}
    learner = config(observation_scaler=d3.preprocessing.StandardObservationScaler(), **settings).create("cpu:0")
    silent = d3.logging.NoopAdapterFactory()
    learner.fit(dataset, steps, steps, show_progress=False, logger_adapter=silent)
    return Predictor(learner, task)


def ours(method: str, task: Task, spec: str, steps: int, seed: int, folder: Path) -> Any:
    """Train by `dds METHOD fit`, as many steps."""
    words = [f"--seed_everything={seed}", f"--data.task={task.name}", f"--data.seed={seed}", f"--data.data={spec}"]
    words += [f"--trainer.max_steps={steps}", f"--checkpoint.dirpath={folder}", f"--trainer.default_root_dir={folder}"]
    words += ["--trainer.enable_model_summary=false", "--trainer.enable_progress_bar=false"]
    words += ["--stop.when=steps"] if method == "clone" else []
    last = folder / "last.ckpt"
    words += [f"--ckpt_path={last}"] if last.is_file() else []
    checkpoint = command(method, ["fit", "--config", f"{method}.yaml", *words])().data["checkpoint"]
    return METHODS[method].play({method: str(checkpoint)})


WAYS = {"here": ours, "d3rlpy": theirs}


def main() -> None:
    """Train both, play, and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--data", required=True, help="SOURCE:NAME")
    parser.add_argument("--methods", nargs="+", default=["clone"], choices=list(PEERS))
    parser.add_argument("--steps", type=int, default=16_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--out", type=Path, default=Path("runs/d3rlpy"))
    asked = parser.parse_args()
    task = get_task(asked.task)
    run = RunDirectory(asked.out, Console(stderr=True))
    rows = []
    for method, seed, way in itertools.product(asked.methods, range(asked.seeds), WAYS):

        def work(folder: Path, resuming: bool, method: str = method, seed: int = seed, way: str = way) -> Any:
            actor = WAYS[way](method, task, asked.data, asked.steps, seed, folder)
            played = rollout(task, [Contestant(way, actor, asked.episodes)], seed=seed, workers=0)
            return {"score": float(played.summary()["score"].iloc[0])}

        settings = {"steps": asked.steps, "episodes": asked.episodes, "data": asked.data, "task": task.name}
        done = run.do(f"{method}-{way}-seed{seed}", f"{method}, {way}, seed {seed}", settings, [], work)
        rows.append({"method": method, "of": way, "seed": seed, "steps": asked.steps, **done.facts})
    scores = pd.DataFrame(rows)
    scores.to_csv(asked.out / "scores.csv", index=False)
    means = scores.groupby(["method", "of"])["score"].agg(["mean", "std", "min", "max"]).round(1).reset_index()
    print(means.to_string(index=False))
    for method, part in means.groupby("method"):
        print(f"{method}: {np.ptp(part['mean']):.1f} points between the means over {asked.seeds} seeds")


if __name__ == "__main__":
    main()
