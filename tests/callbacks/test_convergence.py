"""A training ends when its curve says that more would hardly help, and not before."""

import math
import re
from types import SimpleNamespace

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from dds_lightning.callbacks.convergence import OVERFIT, Convergence, expected_fall, overfit
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.training.trainer import trainer_settings

STEPS = np.arange(500, 20_001, 500)


def curve(exponent, floor=0.0, noise=0.0):
    """(step, loss) of a power law above a floor."""
    loss = floor + (STEPS / 500.0) ** -exponent
    return list(
        zip(
            STEPS.tolist(),
            (loss * (1 + noise * np.random.default_rng(0).normal(size=len(STEPS)))).tolist(),
            strict=True,
        )
    )


@pytest.mark.parametrize("exponent", [0.1, 0.3, 0.8])
def test_the_fall_of_a_power_law_is_known_in_closed_form(exponent):
    assert expected_fall(curve(exponent)) == pytest.approx(1 - 1.25**-exponent, rel=1e-6)


def test_a_curve_that_rises_promises_no_fall_and_few_points_promise_nothing():
    assert expected_fall(curve(-0.2)) == pytest.approx(1 - 1.25**0.2)
    assert math.isnan(expected_fall(curve(0.3)[:4]))


def test_noise_of_a_few_per_cent_does_not_hide_the_slope():
    assert expected_fall(curve(0.3, noise=0.02)) == pytest.approx(1 - 1.25**-0.3, abs=0.02)


def stopping_step(points, **settings):
    callback, trainer = Convergence("converged", **settings), SimpleNamespace(should_stop=False)
    trainer.sanity_checking, trainer.state = False, SimpleNamespace(fn="fit")
    for step, loss in points:
        trainer.global_step, trainer.callback_metrics = step, {"val/loss": torch.tensor(loss)}
        callback.on_validation_end(trainer, None)
        if trainer.should_stop:
            return step
    return None


def test_a_curve_with_a_floor_ends_the_training_and_one_that_falls_does_not():
    assert stopping_step(curve(0.3)) is None
    stopped = stopping_step(curve(1.0, floor=1.0))
    assert 3000 < stopped < 8000
    assert stopping_step(curve(1.0, floor=1.0), tolerance=0.01) > stopped
    assert stopping_step(curve(1.0, floor=1.0), min_steps=15_000) == 15_000


def test_with_steps_the_curve_is_noted_and_ends_nothing():
    callback = Convergence("steps")
    trainer = SimpleNamespace(should_stop=False, sanity_checking=False, state=SimpleNamespace(fn="fit"))
    for step, loss in curve(1.0, floor=1.0):
        trainer.global_step, trainer.callback_metrics = step, {"val/loss": torch.tensor(loss)}
        callback.on_validation_end(trainer, None)
    assert callback.converged
    assert not trainer.should_stop


def test_the_curve_survives_a_checkpoint_of_plain_values():
    first, second = Convergence(), Convergence()
    first.history, first.trained = curve(0.3), curve(0.4)
    second.load_state_dict(first.state_dict())
    assert (second.history, second.trained) == (first.history, first.trained)
    second.load_state_dict({"history": first.history, "ends": None, "rates": None})  # as an earlier version wrote it
    assert second.trained == []


def test_a_training_that_ended_early_says_what_more_steps_would_bring():
    callback = Convergence()
    assert callback.remark() is None  # nothing is known
    callback.history = curve(0.3)
    assert callback.remark() == (
        "val/loss would fall by another 6 % with a quarter more steps; if the agent disappoints, raise "
        "--trainer.max_steps"
    )
    callback.history = curve(1.0, floor=1.0)
    assert callback.remark() is None  # it has levelled off


def valley(depth, noise=0.0):
    """Falls for a third of the training, then rises to `depth` times its lowest loss."""
    third = len(STEPS) // 3
    loss = np.concatenate([np.linspace(3.0, 1.0, third), np.linspace(1.0, depth, len(STEPS) - third)])
    return list(zip(STEPS.tolist(), loss * (1 + noise * np.random.default_rng(0).normal(size=len(STEPS))), strict=True))


def test_held_out_loss_that_rises_while_training_loss_falls_is_told():
    rise, lowest = overfit(valley(1.6, noise=0.03), curve(0.5, noise=0.1))
    assert rise == pytest.approx(0.6, abs=0.1)
    assert lowest < STEPS[len(STEPS) // 2]
    callback = Convergence(monitor="val/denoising")
    callback.history, callback.trained = valley(1.6), curve(0.5)
    assert re.match(r"val/denoising has risen by \d\d % since step [\d,]+ while training loss fell", callback.remark())


@pytest.mark.parametrize(
    ("held_out", "trained"),
    [
        (curve(0.3, noise=0.05), curve(0.5, noise=0.2)),  # both fall
        (curve(1.0, floor=1.0, noise=0.05), curve(0.5)),  # levelled off
        (valley(1.6), curve(-0.5)),  # training has diverged: both rise
        (valley(1.6), []),  # a checkpoint of an earlier version
        (valley(1.6)[:5], curve(0.5)[:5]),  # too few validations
    ],
)
def test_no_other_curve_counts_as_overfit(held_out, trained):
    assert overfit(held_out, trained)[0] < OVERFIT


def test_a_metric_that_nobody_logs_is_named_beside_those_that_are():
    trainer = SimpleNamespace(should_stop=False, sanity_checking=False, state=SimpleNamespace(fn="fit"))
    trainer.global_step, trainer.callback_metrics = 10, {"val/loss": torch.tensor(1.0), "train/loss": torch.tensor(1.0)}
    with pytest.raises(UserError, match=r"stop.monitor is val_loss, .* expected one of train/loss, val/loss"):
        Convergence("converged", monitor="val_loss").on_validation_end(trainer, pl.LightningModule())


class Level(pl.LightningModule):
    """One weight whose held-out loss is always 1; it notes the learning rate of every step."""

    def __init__(self, lr_schedule):
        super().__init__()
        self.save_hyperparameters()
        self.weight, self.rates = torch.nn.Parameter(torch.zeros(1)), []

    def training_step(self, batch, batch_idx):
        self.rates.append(self.optimizers().param_groups[0]["lr"])
        return self.weight.sum()

    def validation_step(self, batch, batch_idx):
        self.log("val/loss", torch.tensor(1.0))

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=1.0)

    def train_dataloader(self):
        return torch.utils.data.DataLoader(torch.zeros(1000), batch_size=1)

    val_dataloader = train_dataloader


class Keep(pl.Callback):
    """A checkpoint of step 21."""

    def __init__(self, folder):
        self.folder = folder

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == 21:
            trainer.save_checkpoint(self.folder / "step-21.ckpt")


def rates(folder, steps, resume=None, lr_schedule="constant", **settings):
    """The learning rates of a training that validates every 10 steps, and its callback."""
    module, stop = Level(lr_schedule), Convergence(decay=4, **settings)
    base = {"max_steps": steps, "max_epochs": -1, "accelerator": "cpu", "logger": False, "limit_val_batches": 1}
    base |= {"enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    base |= {"val_check_interval": 10, "check_val_every_n_epoch": None}
    trainer = pl.Trainer(**trainer_settings(base, [RollingCheckpoint(str(folder)), stop, Keep(folder)]))
    trainer.fit(module, ckpt_path=folder / resume if resume else None, weights_only=True)
    return module.rates, stop


DOWN = [1.0, 0.75, 0.5, 0.25]


def test_the_learning_rate_comes_down_at_the_end_of_the_budget(tmp_path):
    found, stop = rates(tmp_path, 23)
    assert found == [1.0] * 19 + DOWN
    assert stop.history == [(10, 1.0)]  # at step 20 the rate was coming down


def test_it_comes_down_in_a_fifth_of_a_short_training_and_never_where_it_has_a_schedule_of_its_own(tmp_path):
    assert rates(tmp_path / "short", 10)[0] == [1.0] * 9 + [0.5]
    assert rates(tmp_path / "cosine", 23, lr_schedule="cosine")[0] == [1.0] * 23


def test_the_learning_rate_comes_down_where_the_loss_has_levelled_off_and_then_the_training_ends(tmp_path):
    found, stop = rates(tmp_path, 200, when="converged", min_steps=20)
    levelled = stop.history[-1][0]
    assert 20 <= levelled < 150
    assert found == [1.0] * levelled + DOWN
    assert stop.ends == levelled + 4


def test_a_training_that_is_resumed_while_its_rate_comes_down_goes_on_from_there(tmp_path):
    rates(tmp_path, 23)
    found, _ = rates(tmp_path, 23, resume="step-21.ckpt")
    assert found == DOWN[2:]


def test_a_training_that_goes_on_after_its_end_has_the_full_rate_again(tmp_path):
    rates(tmp_path, 22)
    found, _ = rates(tmp_path, 30, resume="last.ckpt")
    assert found == [1.0] * 4 + DOWN
    _, stop = rates(tmp_path, 200, resume="last.ckpt", when="converged", min_steps=20)
    found, _ = rates(tmp_path, 400, resume="last.ckpt", when="converged", min_steps=stop.ends + 20)
    assert found[:20] == [1.0] * 20


@pytest.mark.parametrize(
    ("setting", "value"), [("decay", -1), ("min_steps", -1), ("tolerance", 0.0), ("tolerance", 1.0)]
)
def test_settings_that_cannot_work_are_named(setting, value):
    with pytest.raises(UserError, match=f"stop.{setting} is {value}"):
        Convergence(**{setting: value})
