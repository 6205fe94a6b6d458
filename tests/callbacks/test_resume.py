"""Stopped anywhere and resumed in a new Trainer, training ends with the same bits."""

import random

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from datamodules.loader import TensorLoader
from dds_lightning.callbacks.resume import ExactResume, rng_state, set_rng_state, undisturbed
from dds_lightning.saving.checkpoint import AtomicCheckpointIO

BATCHES, STEPS = 13, 31  # two epochs and a bit


class Noisy(pl.LightningModule):
    """Uses every global stream in training, and torch's in validation."""

    def __init__(self):
        super().__init__()
        self.net = torch.nn.Sequential(torch.nn.Linear(3, 8), torch.nn.Dropout(0.5), torch.nn.Linear(8, 1))
        self.seen, self.validated = [], []

    def training_step(self, batch, batch_idx):
        self.seen.append(batch["x"][:, 0].tolist())
        x = batch["x"] + torch.randn_like(batch["x"]) + np.random.normal() + random.gauss(0, 1)
        return self.net(x).square().mean()

    def on_validation_epoch_end(self):
        self.validated.append(self.global_step)

    def validation_step(self, batch, batch_idx):
        self.log("val/loss", self.net(batch["x"] + torch.randn_like(batch["x"])).square().mean())

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), 0.01)


class Data(pl.LightningDataModule):
    def __init__(self):
        super().__init__()
        self.x = torch.arange(BATCHES * 4 * 3.0).reshape(-1, 3) / 100

    def train_dataloader(self):
        return TensorLoader(lambda i: {"x": self.x[i]}, len(self.x), 4, shuffle=True, seed=5)

    def val_dataloader(self):
        return TensorLoader(lambda i: {"x": self.x[i]}, 8, 4)


def fit(tmp_path, max_steps, callbacks=(), ckpt=None, seed=0, **settings):
    pl.seed_everything(seed, verbose=False)
    model = Noisy()
    trainer = pl.Trainer(
        max_steps=max_steps, accelerator="cpu", logger=False, enable_progress_bar=False,
        enable_model_summary=False, default_root_dir=tmp_path, plugins=[AtomicCheckpointIO()],
        callbacks=[ExactResume(), *callbacks], num_sanity_val_steps=0, **settings,
    )  # fmt: skip
    trainer.fit(model, Data(), ckpt_path=ckpt)
    return model, trainer


def same(one, other):
    return all(torch.equal(*pair) for pair in zip(one.parameters(), other.parameters(), strict=True))


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """An uninterrupted run that left a checkpoint after every step."""
    folder = tmp_path_factory.mktemp("straight")
    every = ModelCheckpoint(folder, "{step}", save_top_k=-1, every_n_train_steps=1, save_on_train_epoch_end=False)
    with torch.random.fork_rng():
        model, trainer = fit(folder, STEPS, [every], val_check_interval=5)
    return folder, model, trainer.callback_metrics["val/loss"]


@pytest.mark.parametrize("step", [1, 4, 5, 6, 10, 12, 13, 14, 18, 25, 26, 27, 30])
def test_resuming_after_any_step_ends_with_the_same_bits(straight, tmp_path, step):
    folder, model, loss = straight
    ckpt = folder / f"step={step}.ckpt"
    resumed, trainer = fit(tmp_path, STEPS, ckpt=ckpt, seed=99, enable_checkpointing=False, val_check_interval=5)
    assert resumed.seen == model.seen[step:]
    assert same(resumed, model)
    # Lightning leaves out a validation that was due at the very step of the checkpoint.
    assert resumed.validated == [at for at in model.validated if at > step], model.validated
    assert torch.equal(trainer.callback_metrics["val/loss"], loss)


@pytest.mark.parametrize("stop", [5, 7, 13, 20, 26])
def test_a_run_that_ended_goes_on_as_if_it_had_not(straight, tmp_path, stop):
    _, model, _ = straight
    first, trainer = fit(tmp_path, stop, enable_checkpointing=False, val_check_interval=5)
    trainer.save_checkpoint(tmp_path / "end.ckpt")
    assert first.seen == model.seen[:stop]
    resumed, _ = fit(
        tmp_path, STEPS, ckpt=tmp_path / "end.ckpt", seed=99, enable_checkpointing=False, val_check_interval=5
    )
    assert resumed.seen == model.seen[stop:]
    assert same(resumed, model)
    if stop % BATCHES:  # else Lightning counts the next validations one batch late
        assert first.validated + resumed.validated == model.validated


def test_without_it_the_bits_differ(straight, tmp_path):
    folder, model, _ = straight
    checkpoint = torch.load(folder / "step=7.ckpt", weights_only=True)
    assert len(checkpoint.pop("rng")) == 1
    torch.save(checkpoint, tmp_path / "bare.ckpt")
    resumed, _ = fit(tmp_path, STEPS, ckpt=tmp_path / "bare.ckpt", seed=99, enable_checkpointing=False)
    assert resumed.seen == model.seen[7:]
    assert not same(resumed, model)


def draw():
    return torch.rand(3).tolist(), np.random.rand(3).tolist(), [random.random(), random.gauss(0, 1)]


def test_the_state_of_every_stream_survives_the_disk(tmp_path):
    np.random.normal()  # leaves half a pair behind, which is part of the state
    random.gauss(0, 1)
    torch.save(rng_state(), tmp_path / "rng")
    expected = draw()
    draw()
    set_rng_state(torch.load(tmp_path / "rng", weights_only=True))
    assert draw() == expected


def test_undisturbed_puts_back_streams_and_modes_even_after_an_error():
    model = torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.Dropout())
    model[0].eval()  # a frozen part
    state = rng_state()
    expected = draw()
    set_rng_state(state)

    def disturb():
        with undisturbed(model):
            draw()
            model.eval()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        disturb()
    assert [part.training for part in model.modules()] == [True, False, True]
    assert draw() == expected
