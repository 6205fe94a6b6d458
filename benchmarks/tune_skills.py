"""Whether an existing policy survives fine-tuning of its skills, with and without restarts of dead codes.

    python benchmarks/tune_skills.py [--seeds 0 1 2] [--steps 300] [--episodes 20] [--out runs/tune-skills]

Fine-tunes the shipped PointMaze-Large skills to 30,000 steps of a careful driver (1.5 m/s instead of 4.5), in each way
and with each seed; then each model plays under the unchanged shipped policy. Prints one row per training.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import lightning.pytorch as pl
import torch

from datamodules import SegmentDataModule, collect_pointmaze, load_trajectories
from dds_lightning import DDSAgent, SkillModule, get_task
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout

CHECKPOINT = Path("checkpoints/pointmaze-large")
WAYS = {
    "decoder": {"trainable": "decoder"},
    "codebook": {"trainable": "codebook"},
    "all": {},
    "all, no restarts": {"restart_threshold": 0.0},
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("runs/tune-skills"))
    arguments = parser.parse_args()

    torch.set_num_threads(1)
    task = get_task("pointmaze-large-diverse")
    folder = arguments.out / "pointmaze-large-careful-v0"
    if not folder.is_dir():
        collect_pointmaze(task, 30_000, 1, arguments.out, speed=1.5, dataset_id=folder.name)
    data = load_trajectories(f"local:{folder}", task)
    shipped = DDSAgent.load(CHECKPOINT)
    before = shipped.skill.bottleneck.vectors.detach()
    print("seed  way                success %  codes restarted")
    for seed in arguments.seeds:
        for way, settings in WAYS.items():
            pl.seed_everything(seed, verbose=False)
            skill = SkillModule.starting_from(CHECKPOINT, lr=2e-3, warmup_steps=10, **settings)
            segments = SegmentDataModule.from_trajectories(data, batch_size=64, validation_fraction=0.1, seed=seed)
            trainer = pl.Trainer(
                max_steps=arguments.steps, accelerator="cpu", devices=1, logger=False, enable_checkpointing=False,
                enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0, limit_val_batches=0,
            )  # fmt: skip
            trainer.fit(skill, datamodule=segments)
            strayed = (skill.bottleneck.vectors.detach() - before).norm(dim=1) > 0.7 * before.norm(dim=1)
            agent = DDSAgent(skill.eval(), shipped.policy)
            result = rollout(task, [Contestant(way, agent, arguments.episodes)], seed=5, workers=0, progress=False)
            success = float(result.summary()["success"].iloc[0])
            print(f"{seed:4d}  {way:17s}  {success:9.0f}  {int(strayed.sum()):15d}", flush=True)


if __name__ == "__main__":
    main()
