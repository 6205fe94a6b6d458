"""Encoders: sizes, masks, order."""

import pytest
import torch

from dds_lightning.nn.encoder import ENCODERS, masked_mean, step_mask


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(("hidden_dim", "layers"), [(256, 4), (128, 2), (192, 3), (64, 1)])
def test_gru_has_as_many_parameters_as_the_transformer(hidden_dim, layers):
    sizes = {name: count(cls(37, 128, 10, hidden_dim, layers)) for name, cls in ENCODERS.items()}
    assert sizes["gru"] == pytest.approx(sizes["transformer"], rel=0.1)


def test_the_papers_transformer_has_its_size():
    assert count(ENCODERS["transformer"](37, 128, 10)) == 3_270_016


def test_masked_mean_leaves_out_what_was_not_taken():
    features = torch.tensor([[[1.0], [3.0], [100.0]], [[2.0], [4.0], [6.0]]])
    mask = step_mask(torch.tensor([2, 3]), 3)
    assert masked_mean(features, mask).flatten().tolist() == [2.0, 4.0]
    assert masked_mean(features, None).flatten()[1].item() == 4.0


@pytest.mark.parametrize("name", ENCODERS)
def test_a_short_segment_ignores_its_padding(name):
    torch.manual_seed(0)
    encoder = ENCODERS[name](3, 4, 6, hidden_dim=16, layers=2, heads=2).eval()
    sequence = torch.randn(2, 6, 3)
    other = sequence.clone()
    other[0, 4:] = 99.0
    lengths = torch.tensor([4, 6])
    torch.testing.assert_close(encoder(sequence, lengths), encoder(other, lengths))
    full = torch.tensor([6, 6])
    torch.testing.assert_close(encoder(sequence, full), encoder(sequence), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ENCODERS)
def test_the_order_of_the_steps_matters(name):
    torch.manual_seed(0)
    encoder = ENCODERS[name](3, 4, 6, hidden_dim=16, layers=1, heads=2).eval()
    sequence = torch.randn(1, 6, 3)
    assert (encoder(sequence) - encoder(sequence.flip(1))).abs().max() > 1e-3
