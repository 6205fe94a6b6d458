"""A loss that is not finite stops the training before it reaches the weights."""

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from dds_lightning.callbacks.guard import FiniteGuard
from dds_lightning.errors import UserError


class Model(pl.LightningModule):
    """Loss becomes NaN in step 3."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))

    def training_step(self, batch, batch_idx):
        poison = torch.nan if self.global_step == 3 else 1.0
        self.terms = {"fine": self.weight.detach(), "spoilt": self.weight.detach() * poison}
        return (self.weight * poison).sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_the_step_and_the_term_are_named_and_the_weights_untouched():
    model = Model()
    trainer = pl.Trainer(
        max_steps=10,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[FiniteGuard()],
    )
    with pytest.raises(UserError, match=r"step 3: the loss is nan \(not finite: spoilt\)"):
        trainer.fit(model, DataLoader(torch.zeros(10, 1)))
    assert model.weight.item() == pytest.approx(1.0 - 3 * 0.1)


def test_a_useless_setting_is_refused():
    with pytest.raises(UserError, match="every_n_steps is 0"):
        FiniteGuard(0)
