"""What all stages share: the optimiser and its schedule."""

import math
from types import SimpleNamespace

import lightning.pytorch as pl
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, IterableDataset

from dds_lightning.module import adam, learning_rate_factor, planned_steps


@pytest.mark.parametrize(
    ("step", "schedule", "warmup", "total", "expected"),
    [
        (0, "constant", 0, 100, 1.0),
        (99, "constant", 0, 100, 1.0),
        (0, "constant", 10, 100, 0.1),
        (9, "constant", 10, 100, 1.0),
        (10, "constant", 10, 100, 1.0),
        (0, "cosine", 0, 100, 1.0),
        (25, "cosine", 0, 100, 0.5 * (1 + math.sqrt(0.5))),
        (50, "cosine", 0, 100, 0.5),
        (100, "cosine", 0, 100, 0.0),
        (150, "cosine", 0, 100, 0.0),  # further steps do not climb again
        (55, "cosine", 10, 100, 0.5),  # half way between warm-up and end
        (20, "cosine", 10, -1, 1.0),  # without an end there is nothing to decay to
    ],
)
def test_the_learning_rate_warms_up_and_decays_as_documented(step, schedule, warmup, total, expected):
    assert learning_rate_factor(step, schedule, warmup, total) == pytest.approx(expected, abs=1e-12)


def test_adam_takes_the_learnable_parameters_at_the_given_rate_and_no_scheduler_unless_needed():
    net = nn.Linear(2, 3)
    net.bias.requires_grad_(False)
    optimizer = adam(net.parameters(), 0.3, "constant", 0, SimpleNamespace())
    assert [group["params"] for group in optimizer.param_groups] == [[net.weight]]
    before = net.weight.detach().clone()
    net.weight.grad = torch.tensor([[1.0, -2.0]] * 3)
    optimizer.step()
    # The first step of Adam is the rate times the gradient's sign.
    torch.testing.assert_close(net.weight.detach() - before, torch.tensor([[-0.3, 0.3]] * 3))


def test_each_group_follows_the_schedule_from_its_own_rate():
    net = nn.ModuleList([nn.Linear(2, 2), nn.Linear(2, 2)])
    groups = [{"params": list(part.parameters()), "lr": lr} for part, lr in zip(net, (0.1, 0.01), strict=True)]
    module = SimpleNamespace(trainer=SimpleNamespace(max_steps=4))
    configured = adam(groups, 0.1, "cosine", 0, module)
    optimizer, scheduler = configured["optimizer"], configured["lr_scheduler"]["scheduler"]
    assert configured["lr_scheduler"]["interval"] == "step"
    rates = []
    for _ in range(5):
        rates.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        scheduler.step()
    factors = [0.5 * (1 + math.cos(math.pi * step / 4)) for step in range(5)]
    assert rates == [pytest.approx([0.1 * factor, 0.01 * factor]) for factor in factors]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"max_steps": 40}, 40),
        ({"max_steps": 40, "max_epochs": 3}, 12),  # three times four batches
        ({"max_steps": 10, "max_epochs": 3}, 10),
        ({"max_steps": -1, "max_epochs": 2}, 8),
        ({"max_steps": 40, "max_epochs": 3, "limit_train_batches": 2}, 6),
        ({"max_steps": 40, "max_epochs": 3, "limit_train_batches": 0.5}, 6),
        ({"max_steps": 40, "max_epochs": 3, "accumulate_grad_batches": 3}, 6),
        ({"max_steps": -1, "max_epochs": -1}, -1),
    ],
)
def test_a_training_ends_with_its_steps_or_its_epochs_and_the_schedule_with_it(settings, expected):
    rates = []

    class Net(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.net = nn.Linear(1, 1)

        def training_step(self, batch, batch_idx):
            rates.append(self.optimizers().param_groups[0]["lr"])
            return self.net(batch).sum()

        def configure_optimizers(self):
            return adam(self.net.parameters(), 0.1, "cosine", 0, self)

    class Data(pl.LightningDataModule):
        def train_dataloader(self):
            return DataLoader(torch.ones(4, 1))

    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    trainer = pl.Trainer(accelerator="cpu", **quiet, **settings)
    data = Data()
    trainer.datamodule = data  # as `fit` leaves it
    assert planned_steps(trainer) == expected
    if expected > 0 and "accumulate_grad_batches" not in settings:
        trainer.fit(Net(), datamodule=data)
        assert trainer.global_step == len(rates) == expected
        assert rates[-1] == pytest.approx(0.1 * learning_rate_factor(expected - 1, "cosine", 0, expected))


def test_a_loader_that_does_not_know_its_length_leaves_the_end_to_the_steps():
    class Endless(IterableDataset):
        def __iter__(self):
            return iter(lambda: torch.ones(1), None)

    trainer = pl.Trainer(max_steps=7, max_epochs=3, accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.datamodule = pl.LightningDataModule.from_datasets(train_dataset=Endless())
    assert planned_steps(trainer) == 7
