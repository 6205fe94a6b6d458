"""Every setting of Lightning's Trainer, with values that people give it: it works, or is refused in one sentence."""

import contextlib
import os
from pathlib import Path

import pytest
import torch

from dds_lightning.training.options import TRAINER
from dds_lightning.training.source import parameters_of
from tests.fits import QUIET, SKILL, call, of_data, told

WORKS = [
    *("barebones=true", "overfit_batches=1", "overfit_batches=0.1", "fast_dev_run=true", "fast_dev_run=2"),
    *("max_epochs=1", "max_steps=0", "min_steps=2", "min_epochs=1", "max_time=00:00:10:00"),
    *("limit_train_batches=2", "limit_train_batches=0.1", "limit_val_batches=0", "limit_test_batches=1"),
    *("limit_predict_batches=1", "val_check_interval=2", "val_check_interval=0.05", "val_check_interval=00:00:00:01"),
    *("num_sanity_val_steps=2", "num_sanity_val_steps=-1", "log_every_n_steps=0", "log_every_n_steps=1"),
    *("enable_checkpointing=false", "enable_progress_bar=true", "enable_model_summary=true"),
    *("accumulate_grad_batches=2", "gradient_clip_val=1.0", "deterministic=true", "deterministic=warn"),
    *("benchmark=true", "inference_mode=false", "use_distributed_sampler=false", "profiler=simple"),
    *("detect_anomaly=true", "sync_batchnorm=true", "reload_dataloaders_every_n_epochs=1"),
    *("enable_autolog_hparams=false", "logger=false", "logger=true", "precision=bf16-mixed", "precision=64-true"),
    *(
        "devices=1",
        "devices=auto",
        "accelerator=auto",
        "strategy=auto",
        "num_nodes=1",
        "callbacks+=LearningRateMonitor",
    ),
    *("check_val_every_n_epoch=2", "gradient_clip_algorithm=norm", "default_root_dir=there", "plugins=null"),
]
REFUSED = [
    ("accelerator=gpuu", "gpuu"),
    ("accelerator=tpu", "torch_xla"),
    ("strategy=dpp", "dpp"),
    ("devices=0", "devices"),
    ("devices=many", "devices"),
    ("num_nodes=0", "trainer.num_nodes is 0"),
    ("num_nodes=2", "MASTER_ADDR"),
    ("precision=16-mixd", "16-mixd"),
    ("precision=bf16-true", "trainer.precision is bf16-true, expected bf16-mixed"),
    ("logger=WandbLoger", "WandbLogger"),
    ("logger=CSVLogger", "--trainer.logger.save_dir=VALUE"),
    ("callbacks+=EarlyStopping", "--trainer.callbacks.monitor=VALUE"),
    ("callbacks+=EarlyStoping", "did you mean EarlyStopping?"),
    ("profiler=simpel", "simple"),
    ("plugins=nope", "nope"),
    ("max_time=tomorrow", "tomorrow"),
    ("max_steps=3.5", "a whole number"),
    ("max_steps=-2", "-2"),
    ("max_epochs=-2", "-2"),
    ("limit_train_batches=0", "nothing would be trained"),
    ("limit_train_batches=-1", "limit_train_batches"),
    ("limit_val_batches=1.5", "limit_val_batches"),
    ("overfit_batches=-1", "overfit_batches"),
    ("val_check_interval=0", "trainer.val_check_interval is 0"),
    ("val_check_interval=2.5", "val_check_interval"),
    ("val_check_interval=5000", "val_check_interval"),
    ("check_val_every_n_epoch=0", "trainer.check_val_every_n_epoch is 0"),
    ("accumulate_grad_batches=0", "trainer.accumulate_grad_batches is 0"),
    ("log_every_n_steps=-1", "trainer.log_every_n_steps is -1"),
    ("gradient_clip_algorithm=nrom", "nrom"),
    ("reload_dataloaders_every_n_epochs=-1", "reload_dataloaders_every_n_epochs"),
]
UNTESTED = {"model_registry"}
"""Settings that need a service."""


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    return ["skill", "fit", *of_data(tmp_path_factory.mktemp("data")), *QUIET, *SKILL, "--trainer.max_steps=3"]


@pytest.fixture(autouse=True)
def _torch_as_before():
    yield
    torch.use_deterministic_algorithms(False)
    torch.backends.cudnn.benchmark = False


@pytest.mark.parametrize("setting", WORKS)
def test_a_setting_that_works(words, setting):
    assert call(*words, f"--trainer.{setting}") == 0


@pytest.mark.parametrize(("setting", "part"), REFUSED)
def test_a_setting_that_is_refused(words, setting, part, capfd):
    assert call(*words, f"--trainer.{setting}") == 2
    assert part in told(capfd.readouterr().err)


def test_every_setting_of_the_trainer_is_in_one_of_the_tables():
    tried = {one.split("=")[0].rstrip("+") for one in [*WORKS, *(setting for setting, _ in REFUSED)]}
    assert set(parameters_of(TRAINER)) - tried == UNTESTED


def test_overfitting_trains_and_validates_on_the_same_batch(words, monkeypatch):
    """Its story: it trained on five different batches and validated on a sixth."""
    from dds_lightning.skill import SkillModule

    seen = []

    def watched(name, real):
        def step(self, batch, index):
            seen.append((name, batch["observations"].sum().item()))
            return real(self, batch, index)

        return step

    for name in ("training_step", "validation_step"):
        monkeypatch.setattr(SkillModule, name, watched(name, getattr(SkillModule, name)))
    assert call(*words, "--trainer.overfit_batches=1", "--trainer.num_sanity_val_steps=0") == 0
    assert {name for name, _ in seen} == {"training_step", "validation_step"}
    assert len({total for _, total in seen}) == 1


def test_barebones_writes_no_checkpoint_and_no_metrics(words):
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        assert call(*words, "--trainer.barebones=true") == 0
    assert [path for path in Path().rglob("*") if path.suffix in (".ckpt", ".csv")] == []
