"""Dropout: which share is left out, what is kept, and where it is used."""

import pytest
import torch
from torch import nn

from dds_lightning.nn.dropout import Dropout, dropout
from dds_lightning.skill import SkillModule


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("rate", [0.001, 0.1, 0.5])
def test_the_share_is_left_out_and_the_others_are_scaled(dtype, rate):
    torch.manual_seed(0)
    x = torch.ones(1000, 1000, dtype=dtype, requires_grad=True)
    out = dropout(x, rate, training=True)
    left_out = out == 0
    assert out.dtype == dtype
    # A share of a million draws: its standard deviation is sqrt(rate (1 - rate)) / 1000, five of which never happen.
    assert left_out.float().mean().item() == pytest.approx(rate, abs=5e-3 * (rate * (1 - rate)) ** 0.5)
    torch.testing.assert_close(out[~left_out].unique().float(), torch.tensor([1 / (1 - rate)]), rtol=4e-3, atol=0)
    out.float().sum().backward()
    assert torch.equal(x.grad == 0, left_out)


def test_nothing_is_drawn_where_nothing_is_left_out():
    x, before = torch.randn(4, 4), torch.get_rng_state()
    assert dropout(x, 0.5, training=False) is x
    assert dropout(x, 0.0, training=True) is x
    assert Dropout(0.5).eval()(x) is x
    assert torch.equal(torch.get_rng_state(), before)


def test_a_seed_repeats_what_is_left_out():
    masks = [(torch.manual_seed(seed), dropout(torch.ones(8, 8), 0.5, training=True))[1] for seed in (1, 1, 2)]
    assert torch.equal(masks[0], masks[1])
    assert not torch.equal(masks[0], masks[2])


def test_every_layer_of_a_skill_model_draws_the_fast_way():
    module = SkillModule(4, 2, horizon=5, dropout=0.1, codebook_init="uniform")
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Dropout)]
    assert layers
    assert all(type(layer) is Dropout and layer.p == 0.1 for layer in layers)
