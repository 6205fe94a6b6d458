"""Averaged weights: the recursion, what a checkpoint holds, exact resuming, and what validation sees."""

from types import SimpleNamespace

import lightning.pytorch as pl
import pytest
import torch
from torch import nn

from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.resume import ExactResume
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import AtomicCheckpointIO
from dds_lightning.training.trainer import trainer_settings

DECAY = 0.5


class Walk(pl.LightningModule):
    """One weight that noise pushes about; a buffer that counts steps."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        self.path, self.validated = [], []

    def training_step(self, batch, batch_idx):
        self.path.append(self.weight.detach().clone())
        self.steps += 1
        return (self.weight * torch.randn(3)).sum()

    def validation_step(self, batch, batch_idx):
        self.validated.append(self.weight.detach().clone())

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=1.0)

    def train_dataloader(self):
        return torch.utils.data.DataLoader(torch.zeros(100), batch_size=1)

    val_dataloader = train_dataloader


def fit(folder, steps, resume=False, decay=DECAY, **settings):
    torch.manual_seed(0)
    module = Walk()
    base = {"max_steps": steps, "max_epochs": -1, "accelerator": "cpu", "logger": False, "limit_val_batches": 0}
    base |= {"enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0, **settings}
    trainer = pl.Trainer(**trainer_settings(base, [RollingCheckpoint(str(folder)), AverageWeights(decay)]))
    trainer.fit(module, ckpt_path=folder / "last.ckpt" if resume else None, weights_only=True)
    return module


def averages(path):
    """The average after each of the weights of a path, by the recursion that the docstring states."""
    average, found = path[0], []
    for count, weight in enumerate(path):
        keep = min(DECAY, (1 + count) / (10 + count)) if count else 0.0
        average = keep * average + (1 - keep) * weight
        found.append(average)
    return found


def test_a_finished_module_holds_the_average_and_so_does_its_checkpoint(tmp_path):
    module = fit(tmp_path, 12)
    path = [*module.path[1:], torch.load(tmp_path / "last.ckpt", weights_only=True)["current_model_state"]["weight"]]
    expected = averages(path)[-1]
    torch.testing.assert_close(module.weight.data, expected)
    checkpoint = torch.load(tmp_path / "last.ckpt", weights_only=True)
    torch.testing.assert_close(checkpoint["state_dict"]["weight"], expected)
    assert not torch.allclose(path[-1], expected, atol=1e-3)
    assert checkpoint["state_dict"]["steps"] == 12  # a buffer is not averaged


def test_stopped_and_resumed_both_sets_of_weights_end_with_the_same_bits(tmp_path):
    fit(tmp_path / "through", 20)
    fit(tmp_path / "stopped", 9)
    fit(tmp_path / "stopped", 20, resume=True)
    one, two = (torch.load(tmp_path / name / "last.ckpt", weights_only=True) for name in ("through", "stopped"))
    for key in ("state_dict", "current_model_state", "averaging_state"):
        assert all(torch.equal(value, two[key][name]) for name, value in one[key].items())


def test_validation_sees_the_average_and_training_goes_on_with_its_own_weights(tmp_path):
    settings = {"limit_val_batches": 1, "val_check_interval": 4, "check_val_every_n_epoch": None}
    watched = fit(tmp_path / "a", 8, **settings)
    plain = fit(tmp_path / "b", 8, decay=None, **settings)
    assert all(torch.equal(one, two) for one, two in zip(watched.path, plain.path, strict=True))
    expected = averages(plain.path[1:])[3]  # after four steps
    torch.testing.assert_close(watched.validated[0], expected)


def test_the_average_is_where_the_module_is_about_to_go():
    """Its story: the module is still on the processor when a fit is set up, and the first step on a GPU failed."""
    average, there = AverageWeights(DECAY), torch.device("meta")
    average.setup(SimpleNamespace(strategy=SimpleNamespace(root_device=there)), Walk(), "fit")
    assert {value.device for value in average._average_model.module.state_dict().values()} == {there}


def test_without_a_decay_nothing_is_averaged(tmp_path):
    kinds = {type(callback) for callback in trainer_settings({}, [AverageWeights()])["callbacks"]}
    assert AverageWeights not in kinds
    assert ExactResume in kinds
    assert AtomicCheckpointIO in {type(plugin) for plugin in trainer_settings({}, [])["plugins"]}


@pytest.mark.parametrize("decay", [0.0, 1.0, -0.1])
def test_a_decay_that_averages_nothing_or_never_moves_is_refused(decay):
    with pytest.raises(UserError, match=f"average.decay is {decay}"):
        AverageWeights(decay)
