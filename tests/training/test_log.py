"""What `metrics.csv` says of a step is what that step found."""

import lightning.pytorch as pl
import pandas as pd
import pytest

from tests.callbacks.test_several import train


class Losses(pl.Callback):
    """The loss of every step."""

    def __init__(self):
        self.seen = {}

    def on_before_backward(self, trainer, pl_module, loss):
        self.seen[trainer.global_step] = float(loss.detach())


@pytest.mark.parametrize("every", [4, 10])
def test_a_row_has_the_loss_of_its_step_also_where_epochs_are_short(tmp_path, every):
    """Its story: the values were of the first step of the interval, and an epoch's end within it lost them."""
    losses = Losses()  # six batches an epoch
    _, trainer = train(tmp_path, losses, log_every_n_steps=every, val_check_interval=40)
    table = pd.read_csv(f"{trainer.log_dir}/metrics.csv")
    rows = table.dropna(subset=["train/loss"]).set_index("step")["train/loss"]
    assert rows.index.tolist() == list(range(every - 1, 40, every))
    assert rows.tolist() == pytest.approx([losses.seen[step] for step in rows.index], rel=1e-6)
