"""The best checkpoint: a score that is kept, and paths of strangers that are not."""

import warnings
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import nn

from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.training.trainer import trainer_settings


class Rising(pl.LightningModule):
    """Its metric is the number of the step, so that each look finds a better checkpoint."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(1, 1)

    def training_step(self, batch, batch_idx):
        self.log("quality", float(self.global_step))
        return self.layer(batch).square().mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(steps, callbacks, resume=None):
    loader = torch.utils.data.DataLoader(torch.ones(64, 1), batch_size=4)
    settings = {"max_steps": steps, "max_epochs": -1, "accelerator": "cpu", "enable_model_summary": False}
    settings |= {"default_root_dir": "out", "limit_val_batches": 0, "enable_progress_bar": False}
    trainer = pl.Trainer(**trainer_settings(settings, callbacks))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer.fit(Rising(), loader, ckpt_path=resume, weights_only=True)
    return trainer


def both():
    return [RollingCheckpoint("here"), BestCheckpoint("quality", every_n_steps=2)]


def hostile(victim, **more):
    """A checkpoint whose best one seems to lie at `victim`, with the worst of scores."""
    checkpoint = torch.load("here/last.ckpt", weights_only=True)
    (key,) = [key for key in checkpoint["callbacks"] if key.startswith(("BestCheckpoint", "ModelCheckpoint"))]
    score = torch.tensor(-1e30)
    state = {"best_k_models": {str(victim): score}, "kth_best_model_path": str(victim), "kth_value": score}
    state |= {"best_model_path": str(victim), "best_model_score": score, "last_model_path": str(victim)}
    checkpoint["callbacks"][key] = {**state, **more}
    torch.save(checkpoint, "hostile.ckpt")
    return "hostile.ckpt"


@pytest.mark.parametrize("place", ["../precious", "here/precious", "here/../here/precious", "here/sub/../../precious"])
@pytest.mark.parametrize("more", [{}, {"dirpath": "here"}], ids=["no folder", "our folder"])
def test_a_path_in_a_checkpoints_state_is_never_deleted(tmp_path, monkeypatch, place, more):
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    fit(2, both())
    Path("here/sub").mkdir()
    Path(place).mkdir()
    (Path(place) / "thesis").write_text("years of work")
    trainer = fit(6, both(), hostile(place, **more))
    assert (Path(place) / "thesis").read_text() == "years of work"
    (best,) = [c for c in trainer.callbacks if isinstance(c, BestCheckpoint)]
    assert Path(best.best_model_path) == Path("here/best.ckpt")
    assert torch.load("here/best.ckpt", weights_only=True)["global_step"] == 6


def test_another_checkpoint_in_the_same_folder_is_not_deleted_either():
    """Its owner may add Lightning's own callback, which deletes what a state names."""
    several = {"dirpath": "here", "filename": "{step}", "monitor": "quality", "mode": "max", "every_n_train_steps": 2}
    fit(2, [RollingCheckpoint("here"), ModelCheckpoint(**several)])
    Path("here/other.ckpt").write_text("of another training")
    resume = hostile(Path("here/other.ckpt").absolute(), dirpath=str(Path("here").absolute()))
    fit(6, [RollingCheckpoint("here"), ModelCheckpoint(**several)], resume)
    assert Path("here/other.ckpt").read_text() == "of another training"
    names = sorted(path.name for path in Path("here").glob("step*"))
    assert names[-1] == "step=6.ckpt"
    assert "step=4.ckpt" not in names  # its own files are still replaced


def test_a_training_that_goes_on_compares_with_the_best_so_far():
    fit(4, both())
    checkpoint = torch.load("here/last.ckpt", weights_only=True)
    (key,) = [key for key in checkpoint["callbacks"] if key.startswith("BestCheckpoint")]
    assert float(checkpoint["callbacks"][key]["best_model_score"]) == 3
    checkpoint["callbacks"][key]["best_model_score"] = torch.tensor(100.0)
    torch.save(checkpoint, "better.ckpt")
    before = Path("here/best.ckpt").read_bytes()
    fit(8, both(), "better.ckpt")
    assert Path("here/best.ckpt").read_bytes() == before
