"""Several optimiser steps for each round of the Trainer: the same bits, the same counters, the same log."""

import lightning.pytorch as pl
import pandas as pd
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger

from datamodules.loader import TensorLoader
from dds_lightning import PolicyModule
from dds_lightning.callbacks import ExactResume, FiniteGuard, RolloutEvaluation, SeveralUpdates
from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import AtomicCheckpointIO

ROWS = 50
STEPS = {"max_steps": 40, "val_check_interval": 20, "check_val_every_n_epoch": None, "log_every_n_steps": 10}


class Transitions(pl.LightningDataModule):
    """Random transitions: six batches of eight an epoch, so that groups of ten cross its end."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.rows = {
            "observations": torch.randn(ROWS, 3, generator=generator),
            "codes": torch.randint(4, (ROWS,), generator=generator),
            "rewards": torch.randn(ROWS, generator=generator),
            "next_observations": torch.randn(ROWS, 3, generator=generator),
            "discounts": torch.full((ROWS,), 0.9),
            "dones": torch.zeros(ROWS),
        }

    def statistics(self):
        share = torch.full((4,), 0.25)
        units = {"observation_mean": torch.zeros(3), "observation_std": torch.ones(3)}
        return {**units, "code_share": share, "reward_range": (-3.0, 3.0), "max_discount": 0.9}

    def train_dataloader(self):
        return TensorLoader(lambda i: {k: x[i] for k, x in self.rows.items()}, ROWS, 8, shuffle=True, drop_last=True)

    def val_dataloader(self):
        return TensorLoader(lambda i: {k: x[i] for k, x in self.rows.items()}, ROWS, 25)


def train(folder, *callbacks, extraction="after", ckpt_path=None, data=None, **settings):
    """The module after a training, and its trainer."""
    pl.seed_everything(0, verbose=False)
    given = {"hidden_dims": [8], "extraction": extraction, "critic_steps": 15, "dropout": 0.1, "alpha_unit": "spread"}
    module = PolicyModule(3, 4, lr_schedule="cosine", lr=1e-2, **given)
    trainer = pl.Trainer(
        logger=CSVLogger(folder, name="logs"),
        accelerator="cpu",
        plugins=[AtomicCheckpointIO()],
        callbacks=[ExactResume(), FiniteGuard(), RollingCheckpoint(str(folder), every_n_seconds=0), *callbacks],
        enable_progress_bar=False,
        enable_model_summary=False,
        **{**STEPS, **settings},
    )
    trainer.fit(module, data or Transitions(), ckpt_path=ckpt_path, weights_only=True)
    return module, trainer


def same(one, other):
    """Whether two modules have the same bits."""
    theirs = other.state_dict()
    return all(torch.equal(value, theirs[name]) for name, value in one.state_dict().items())


def log_of(trainer):
    return pd.read_csv(f"{trainer.log_dir}/metrics.csv").drop(columns="epoch")


@pytest.mark.parametrize("extraction", ["after", "joint"])
def test_weights_counters_and_log_are_those_of_one_step_after_the_other(tmp_path, extraction):
    plain, first = train(tmp_path / "plain", extraction=extraction)
    grouped, second = train(tmp_path / "grouped", SeveralUpdates(10), extraction=extraction)
    assert same(plain, grouped)
    assert first.global_step == second.global_step == 40
    assert grouped.automatic_optimization
    assert "training_step" not in vars(grouped)
    assert second.val_check_interval == 20
    expected, found = log_of(first), log_of(second)
    assert expected["step"].tolist() == found["step"].tolist() == [9, 19, 19, 29, 39, 39]
    assert expected.filter(like="train/loss").notna().sum().tolist() == [4]
    if extraction == "joint":  # else the critic's last values stay in Lightning's log until an epoch ends
        pd.testing.assert_frame_equal(expected, found)


def test_a_training_that_was_stopped_goes_on_bit_for_bit(tmp_path):
    whole, _ = train(tmp_path / "whole")

    class Stop(pl.Callback):
        def on_train_batch_end(self, trainer, *_):
            trainer.should_stop = trainer.global_step == 20

    train(tmp_path / "half", SeveralUpdates(10), Stop())
    resumed, trainer = train(tmp_path / "rest", SeveralUpdates(10), ckpt_path=str(tmp_path / "half" / "last.ckpt"))
    assert trainer.global_step == 40
    assert same(whole, resumed)
    for more, told in (([], r"give SeveralUpdates\(updates=10\)"), ([SeveralUpdates(5)], "this one takes 5")):
        with pytest.raises(UserError, match=told):
            train(tmp_path / "other", *more, ckpt_path=str(tmp_path / "half" / "last.ckpt"))


def test_a_last_look_at_one_batch_takes_one_step(tmp_path):
    _, trainer = train(tmp_path, SeveralUpdates(10), fast_dev_run=True)
    assert trainer.global_step == 1


@pytest.mark.parametrize(
    ("settings", "callbacks", "told"),
    [
        ({"log_every_n_steps": 7}, [], "trainer.log_every_n_steps is 7, expected a multiple of the 10"),
        ({"val_check_interval": 15}, [], "trainer.val_check_interval is 15"),
        ({"max_steps": 45}, [], "trainer.max_steps is 45"),
        ({"max_epochs": 3}, [], "trainer.max_epochs is 3"),
        ({"accumulate_grad_batches": 2}, [], "accumulate_grad_batches is 2"),
        ({"gradient_clip_val": 1.0}, [], "gradient_clip_val is 1.0"),
        ({}, [AverageWeights(0.9)], "AverageWeights looks at every step"),
        ({}, [RolloutEvaluation(every_n_steps=15)], "every_n_steps of RolloutEvaluation is 15"),
    ],
)
def test_what_does_not_go_with_it_is_refused(tmp_path, settings, callbacks, told):
    with pytest.raises(UserError, match=told):
        train(tmp_path, SeveralUpdates(10), *callbacks, **settings)


def test_loaders_of_ones_own_are_refused(tmp_path):
    class Own(Transitions):
        def train_dataloader(self):
            rows = [{name: value[i] for name, value in self.rows.items()} for i in range(ROWS)]
            return torch.utils.data.DataLoader(rows, batch_size=8)

    with pytest.raises(UserError, match="come from DataLoader, expected recorded data"):
        train(tmp_path, SeveralUpdates(10), data=Own())
    with pytest.raises(UserError, match="expected at least 2"):
        SeveralUpdates(1)
