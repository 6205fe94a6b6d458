"""Stopped after any step and resumed, every stage ends as if it had never stopped: weights, metrics, order of data."""

import json
import math
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pandas as pd
import pytest
import torch

from datamodules.relabelled import RelabeledDataModule
from datamodules.segments import SegmentDataModule
from datamodules.trajectories import Trajectories
from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.console import interrupts
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from dds_lightning.training.stage_cli import quieten
from dds_lightning.training.trainer import trainer_settings

STEPS, EPOCH = 12, 5  # two epochs and a bit
STAGES = ["skill", "policy after", "policy joint"]
# A validation follows the steps 3, 6, 9 and 12: in the middle of an epoch, and after the last step.
MIDDLE = {"check_val_every_n_epoch": None, "val_check_interval": 3}
SMALL = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 8}


def trajectories():
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(9):
        episodes.append(
            {
                "observations": rng.normal(size=(9, 2)).cumsum(0).astype(np.float32),
                "actions": rng.uniform(-1, 1, (8, 1)).astype(np.float32),
                "rewards": rng.normal(size=8).astype(np.float32),
                "terminations": np.zeros(8, bool),
                "truncations": np.arange(8) == 7,
            }
        )
    return Trajectories.from_episodes("walks", episodes)


@pytest.fixture(scope="module")
def skill_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("skill") / "skill.ckpt"
    torch.manual_seed(0)
    skill = SkillModule(2, 1, horizon=3, num_skills=4, **SMALL)
    torch.save({"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}, path)
    return path


def parts(stage, skill_path):
    """A new module and its data; 35 training segments, so five batches an epoch."""
    common = {"batch_size": 7, "validation_fraction": 0.3, "seed": 2}
    if stage == "skill":
        # Every code counts as dead at every second step, dropout and denoising draw, the rate changes at each step.
        busy = {"dropout": 0.2, "restart_threshold": 1.9, "restart_every": 2, "lr_schedule": "cosine"}
        module = SkillModule(2, 1, horizon=3, num_skills=4, lr=1e-3, **busy, **SMALL)
        return module, SegmentDataModule.from_trajectories(trajectories(), horizon=3, **common)
    extraction = stage.split()[1]
    module = PolicyModule(2, 4, hidden_dims=[16], extraction=extraction, critic_steps=6, fourier_features=4, lr=1e-2)
    return module, RelabeledDataModule.from_trajectories(trajectories(), str(skill_path), **common)


class Watch(pl.Callback):
    """Notes which data a training sees, and asks it to stop during a step."""

    def __init__(self, stop=None):
        self.stop, self.seen = stop, []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.seen.append(batch["observations"].numpy().tobytes())
        if trainer.global_step + 1 == self.stop:
            signal.raise_signal(signal.SIGTERM)


def train(stage, folder, skill_path, *, seed, stop=None, resume=False, **settings):
    """One launch; returns the data it saw."""
    quieten()
    pl.seed_everything(seed, verbose=False)
    module, data = parts(stage, skill_path)
    watch = Watch(stop)
    base = {"max_steps": STEPS, "max_epochs": -1, "accelerator": "cpu", "default_root_dir": str(folder)}
    base |= {"enable_progress_bar": False, "enable_model_summary": False, "log_every_n_steps": 1}
    saving = [RollingCheckpoint(str(folder)), BestCheckpoint("val/code_accuracy" if stage != "skill" else "val/loss")]
    trainer = pl.Trainer(**trainer_settings({**base, **settings, "num_sanity_val_steps": 0}, [*saving, watch]))
    ckpt = folder / "last.ckpt" if resume else None
    with warnings.catch_warnings(), interrupts.caught(), interrupts.deferred():
        warnings.simplefilter("ignore")
        trainer.fit(module, data, ckpt_path=ckpt, weights_only=True)
    return watch.seen


def told(folder):
    """(step, name) -> value of everything that the launches in a folder logged; each only once."""
    found = {}
    for path in sorted(folder.glob("logs/version_*/metrics.csv")):
        for row in pd.read_csv(path).to_dict("records"):
            step = row.pop("step")
            row.pop("epoch", None)
            for name, value in row.items():
                if not math.isnan(value):
                    assert (step, name) not in found, f"{name} of step {step} was logged twice"
                    found[step, name] = value
    return found


def end(folder, name="last"):
    checkpoint = torch.load(folder / f"{name}.ckpt", weights_only=True)
    optimizer = checkpoint["optimizer_states"][0]["state"]
    tensors = {**checkpoint["state_dict"], **{f"{i} {k}": v for i, s in optimizer.items() for k, v in s.items()}}
    tensors["rng"] = checkpoint["rng"][0]["torch"]
    metrics = checkpoint["callbacks"]["RollingCheckpoint"]["metrics"] if name == "last" else None
    return checkpoint["global_step"], metrics, tensors


def same(one, other):
    assert one[:2] == other[:2]
    assert [name for name, value in one[2].items() if not torch.equal(value, other[2][name])] == []


@pytest.fixture(scope="module")
def straight(tmp_path_factory, skill_path):
    """Uninterrupted runs by stage and time of validation, made when they are asked for."""
    made = {}

    def run(stage, **settings):
        key = json.dumps([stage, settings])
        if key not in made:
            folder = tmp_path_factory.mktemp("straight")
            with torch.random.fork_rng():
                made[key] = folder, train(stage, folder, skill_path, seed=1, **settings)
        return made[key]

    return run


def stop_and_resume(straight, skill_path, folder, stage, step, **settings):
    expected, seen = straight(stage, **settings)
    with pytest.raises(interrupts.Interrupted) as stop:
        train(stage, folder, skill_path, seed=1, stop=step, **settings)
    assert (stop.value.code, stop.value.saved) == (143, str(folder / "last.ckpt"))
    assert torch.load(folder / "last.ckpt", weights_only=True)["global_step"] == step
    rest = train(stage, folder, skill_path, seed=99, resume=True, **settings)
    assert rest == seen[step:]
    assert told(folder) == told(expected)
    same(end(folder), end(expected))
    if (expected / "best.ckpt").is_file():
        same(end(folder, "best"), end(expected, "best"))


@pytest.mark.parametrize("step", [1, 3, 5, STEPS], ids=["first", "middle", "epoch's end", "last"])
@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_stopped_after_a_step_ends_the_same(straight, skill_path, tmp_path, stage, step):
    """Its story: the metrics of the last step and a validation due after it were lost, and with them the best."""
    stop_and_resume(straight, skill_path, tmp_path, stage, step, **MIDDLE)


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_stopped_at_an_epochs_end_still_validates(straight, skill_path, tmp_path, stage):
    stop_and_resume(straight, skill_path, tmp_path, stage, EPOCH)


def test_stopped_twice_is_no_different(straight, skill_path, tmp_path):
    expected, seen = straight("policy joint", **MIDDLE)
    for stop, launch in ((6, "first"), (7, "second")):
        with pytest.raises(interrupts.Interrupted):
            train("policy joint", tmp_path, skill_path, seed=1, stop=stop, resume=launch == "second", **MIDDLE)
    assert train("policy joint", tmp_path, skill_path, seed=7, resume=True, **MIDDLE) == seen[7:]
    assert told(tmp_path) == told(expected)
    same(end(tmp_path), end(expected))


def test_resumed_in_a_new_process_it_ends_the_same(straight, skill_path, tmp_path):
    expected, _ = straight("skill", **MIDDLE)
    with pytest.raises(interrupts.Interrupted):
        train("skill", tmp_path, skill_path, seed=1, stop=7, **MIDDLE)
    code = (
        "import sys; from pathlib import Path; from tests.training import test_exact_resume as t\n"
        "t.torch.set_num_threads(1)\n"
        "t.train('skill', Path(sys.argv[1]), Path(sys.argv[2]), seed=5, resume=True, **t.MIDDLE)"
    )
    root = Path(__file__).parents[2]
    words = [sys.executable, "-c", code, str(tmp_path), str(skill_path)]
    ran = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    same(end(tmp_path), end(expected))
