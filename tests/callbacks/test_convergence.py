"""A training ends when its curve says that more would hardly help, and not before."""

import math
from types import SimpleNamespace

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from dds_lightning.callbacks.convergence import Convergence, expected_fall
from dds_lightning.errors import UserError

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
    first.history = curve(0.3)
    second.load_state_dict(first.state_dict())
    assert second.history == first.history


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


def test_a_metric_that_nobody_logs_is_named_beside_those_that_are():
    trainer = SimpleNamespace(should_stop=False, sanity_checking=False, state=SimpleNamespace(fn="fit"))
    trainer.global_step, trainer.callback_metrics = 10, {"val/loss": torch.tensor(1.0), "train/loss": torch.tensor(1.0)}
    with pytest.raises(UserError, match=r"stop.monitor is val_loss, .* expected one of train/loss, val/loss"):
        Convergence("converged", monitor="val_loss").on_validation_end(trainer, pl.LightningModule())


@pytest.mark.parametrize(("setting", "value"), [("min_steps", -1), ("tolerance", 0.0), ("tolerance", 1.0)])
def test_settings_that_cannot_work_are_named(setting, value):
    with pytest.raises(UserError, match=f"stop.{setting} is {value}"):
        Convergence(**{setting: value})
