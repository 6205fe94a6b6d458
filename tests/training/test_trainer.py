"""The parts that every Trainer of this project has: checkpoints, loggers, the line of progress."""

import contextlib
import io
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from torch import nn

from dds_lightning.callbacks import ExactResume, FiniteGuard, rolling
from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import AtomicCheckpointIO
from dds_lightning.training import trainer as training
from dds_lightning.training.progress import StepProgress
from dds_lightning.training.trainer import trainer_settings


class Line(pl.LightningModule):
    """y = w x, with a validation metric that is best at step 4."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(1, 1)

    def training_step(self, batch, batch_idx):
        loss = (self.layer(batch) - 2 * batch).square().mean()
        self.log("train/loss", loss.detach())
        return loss

    def validation_step(self, batch, batch_idx):
        self.log("quality", -abs(float(self.global_step) - 4))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(extra, **settings):
    loader = torch.utils.data.DataLoader(torch.linspace(-1, 1, 64)[:, None], batch_size=4)
    base = {"max_steps": 10, "max_epochs": -1, "accelerator": "cpu", "enable_model_summary": False}
    base |= {"default_root_dir": "out", "val_check_interval": 2, "limit_val_batches": 1, "num_sanity_val_steps": 0}
    trainer = pl.Trainer(**trainer_settings({**base, "enable_progress_bar": False, **settings}, extra))
    trainer.fit(Line(), loader, loader)
    return trainer


def step_of(path):
    return torch.load(path, weights_only=True)["global_step"]


def test_the_last_checkpoint_is_of_the_last_step_although_the_interval_does_not_divide_it():
    fit([RollingCheckpoint("here", every_n_seconds=0, every_n_steps=4)])
    assert [path.name for path in Path("here").iterdir()] == ["last.ckpt"]
    assert step_of("here/last.ckpt") == 10


def test_a_checkpoint_is_written_every_so_many_steps_and_seconds(monkeypatch):
    saved = []
    monkeypatch.setattr(pl.Trainer, "save_checkpoint", lambda self, path, **k: saved.append(self.global_step))
    fit([RollingCheckpoint("here", every_n_seconds=0, every_n_steps=3)])
    assert saved == [3, 6, 6, 9, 10]  # a validation follows step 6, and what it found belongs into the file
    saved.clear()
    now = iter(range(1000))
    monkeypatch.setattr(rolling.time, "monotonic", lambda: next(now))
    fit([RollingCheckpoint("there", every_n_seconds=4)])
    assert saved[-1] == 10
    assert 2 <= len(saved) <= 5


def test_the_same_command_again_keeps_what_the_first_one_made():
    fit([RollingCheckpoint("here"), BestCheckpoint("quality")])
    first = torch.load("here/last.ckpt", weights_only=True)["state_dict"]
    with pytest.warns(UserWarning, match="is an earlier training's, and last-v1.ckpt now; --ckpt_path="):
        fit([RollingCheckpoint("here")], max_steps=3)
    assert sorted(path.name for path in Path("here").iterdir()) == ["best-v1.ckpt", "last-v1.ckpt", "last.ckpt"]
    assert (step_of("here/last.ckpt"), step_of("here/last-v1.ckpt")) == (3, 10)
    kept = torch.load("here/last-v1.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(value, kept[name]) for name, value in first.items())


def test_an_error_replaces_no_checkpoint():
    class Fails(pl.Callback):
        def on_train_batch_start(self, trainer, *_):
            if trainer.global_step == 7:
                raise RuntimeError("out of luck")

    with pytest.raises(RuntimeError, match="out of luck"):
        fit([RollingCheckpoint("here", every_n_seconds=0, every_n_steps=5), Fails()])
    assert step_of("here/last.ckpt") == 5


def test_negative_intervals_are_refused():
    with pytest.raises(UserError, match=r"every_n_seconds.*-1"):
        RollingCheckpoint(every_n_seconds=-1)


def test_the_best_checkpoint_lies_beside_the_last():
    fit([RollingCheckpoint("here"), BestCheckpoint("quality")])
    assert sorted(path.name for path in Path("here").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert step_of("here/best.ckpt") == 4
    assert step_of("here/last.ckpt") == 10


def test_no_metric_to_watch_means_no_best_checkpoint():
    trainer = fit([RollingCheckpoint("here"), BestCheckpoint()])
    assert not any(isinstance(callback, ModelCheckpoint) for callback in trainer.callbacks)


def test_without_a_folder_each_launch_has_its_own():
    first, second = fit([RollingCheckpoint()]), fit([RollingCheckpoint()])
    paths = [c.path for trainer in (first, second) for c in trainer.callbacks if isinstance(c, RollingCheckpoint)]
    assert paths == [Path(f"out/logs/version_{n}/checkpoints/last.ckpt") for n in (0, 1)]
    assert all(path.is_file() for path in paths)


@pytest.mark.parametrize("settings", [{"fast_dev_run": True}, {"enable_checkpointing": False}])
def test_where_saving_is_off_nothing_is_saved(settings):
    fit([RollingCheckpoint("here"), BestCheckpoint("quality")], **settings)
    assert not Path("here").exists()


def test_every_trainer_resumes_exactly_guards_and_writes_atomically():
    settings = trainer_settings({}, [])
    kinds = {type(callback) for callback in settings["callbacks"]}
    assert {ExactResume, FiniteGuard, StepProgress} <= kinds
    assert [type(plugin) for plugin in settings["plugins"]] == [AtomicCheckpointIO]


def test_what_the_user_chose_is_kept():
    mine = FiniteGuard(every_n_steps=3)
    settings = trainer_settings({"callbacks": [mine], "enable_progress_bar": False}, [])
    assert [c for c in settings["callbacks"] if isinstance(c, FiniteGuard)] == [mine]
    assert not any(isinstance(c, StepProgress) for c in settings["callbacks"])
    assert trainer_settings({"logger": False}, [])["logger"] is False


def test_csv_is_always_logged_and_tensorboard_when_it_is_installed(monkeypatch):
    monkeypatch.setattr(training, "find_spec", lambda name: None)
    assert [type(logger) for logger in training.loggers("out")] == [CSVLogger]
    monkeypatch.setattr(training, "find_spec", lambda name: object() if name == "tensorboard" else None)
    made = []
    monkeypatch.setattr(training, "TensorBoardLogger", lambda *a, **k: made.append(k) or "tensorboard")
    assert training.loggers("out")[1] == "tensorboard"
    assert made == [{"name": "logs", "version": 0}]
    own = TensorBoardLogger.__new__(TensorBoardLogger)
    assert [type(logger) for logger in trainer_settings({"logger": own}, [])["logger"]] == [
        CSVLogger,
        TensorBoardLogger,
    ]


def test_a_log_file_gets_plain_lines_with_steps_time_left_and_the_loss():
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        fit([StepProgress(log_every_n_seconds=0.0)], enable_progress_bar=True)
    lines = said.getvalue().splitlines()
    assert lines[0].startswith("  step 1, ")
    assert lines[-1].startswith("  step 10, 0.0 s left")
    assert "loss " in lines[-1]
    assert "\x1b" not in said.getvalue()


class Scores(pl.Callback):
    """A score after every fifth step, which is an epoch's end as well; the first is the best."""

    def on_train_batch_end(self, trainer, pl_module, *_):
        if trainer.global_step % 5 == 0:
            pl_module.log("score", float(-trainer.global_step), on_step=True, on_epoch=False)


def test_the_best_checkpoint_is_of_the_step_that_was_scored_also_at_an_epochs_end():
    """Its story: where the next validation was steps away, Lightning kept the weights of that later step."""
    base = {"limit_train_batches": 5, "check_val_every_n_epoch": None, "val_check_interval": 3}
    fit([RollingCheckpoint("here"), BestCheckpoint("score", every_n_steps=5), Scores()], **base)
    assert step_of("here/best.ckpt") == 5


def test_a_metric_that_was_never_logged_leaves_no_best_checkpoint_and_a_warning():
    with pytest.warns(UserWarning, match=r"best.monitor is val_loss, which was not logged \(.*train/loss"):
        fit([RollingCheckpoint("here"), BestCheckpoint("val_loss", every_n_steps=5)])
    assert [path.name for path in Path("here").iterdir()] == ["last.ckpt"]


def test_the_last_line_names_the_folder_and_the_loggers_that_write_elsewhere():
    trainer = fit([])
    assert training.log_places(trainer) == "out/logs/version_0"
    assert training.log_places(fit([], logger=False)) == "no place, as asked"
    trainer.loggers = [*trainer.loggers, TensorBoardLogger.__new__(TensorBoardLogger)]
    assert training.log_places(trainer) == "out/logs/version_0, TensorBoardLogger"


def test_a_folder_that_cannot_be_made_shows_before_the_first_step():
    Path("file").touch()
    watched = StepProgress(log_every_n_seconds=0.0)
    with contextlib.redirect_stderr(io.StringIO()) as said, pytest.raises(UserError, match="but file is a file"):
        fit([RollingCheckpoint("file/here"), watched], enable_progress_bar=True)
    assert "step" not in said.getvalue()
