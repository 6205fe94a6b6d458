"""The measurement behind `precision: auto`."""

import torch

from dds_lightning.nn.precision import fastest_precision


def test_the_measurement_gives_one_of_two_precisions_and_draws_nothing():
    before = torch.get_rng_state()
    choice = fastest_precision()
    assert choice.speedup > 0
    assert choice.precision == ("bf16-mixed" if choice.speedup > 1.2 else "32-true")
    assert torch.equal(torch.get_rng_state(), before)
