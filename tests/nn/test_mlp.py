"""Networks: an ensemble is its members side by side."""

import pytest
import torch
from torch import nn

from dds_lightning.nn.mlp import MLP, EnsembleLinear, FourierFeatures


@pytest.mark.parametrize("width", [2, 1])
def test_an_ensemble_of_linear_layers_is_that_many_linear_layers(width):
    torch.manual_seed(0)
    ensemble, x = EnsembleLinear(3, 4, width), torch.randn(3, 5, 4)
    weight = torch.randn(3, 5, width)
    (ensemble(x) * weight).sum().backward()
    for n in range(3):
        alone = nn.Linear(4, width)
        with torch.no_grad():
            alone.weight.copy_(ensemble.weight[n].T)
            alone.bias.copy_(ensemble.bias[n, 0])
        torch.testing.assert_close(ensemble(x)[n], alone(x[n]))
        (alone(x[n]) * weight[n]).sum().backward()
        torch.testing.assert_close(ensemble.weight.grad[n], alone.weight.grad.T)
        torch.testing.assert_close(ensemble.bias.grad[n, 0], alone.bias.grad)


def test_members_start_apart_within_the_bounds_of_a_linear_layer():
    torch.manual_seed(0)
    layer = EnsembleLinear(2, 16, 64)
    assert not torch.equal(layer.weight[0], layer.weight[1])
    assert 0.24 < layer.weight.abs().max() <= 0.25  # 1 / sqrt(16)


def test_dropout_leaves_out_hidden_numbers_of_training_steps_alone_and_adds_no_name():
    torch.manual_seed(0)
    plain, dropping = MLP(3, 2, (64, 64)), MLP(3, 2, (64, 64), dropout=0.5)
    dropping.load_state_dict(plain.state_dict())
    x = torch.randn(5, 3)
    assert torch.equal(plain(x), dropping.eval()(x))
    dropping.train()
    drawn = torch.stack([dropping(x) for _ in range(2000)])
    assert drawn.std(dim=0).min() > 0.05
    one = MLP(3, 2, (64,), dropout=0.5)  # with one hidden layer the mean over what is left out is exact
    torch.testing.assert_close(torch.stack([one(x) for _ in range(4000)]).mean(dim=0), one.eval()(x), atol=0.05, rtol=0)


def test_layer_norm_stands_before_each_relu_and_nowhere_else():
    kinds = [type(layer).__name__ for layer in MLP(3, 2, (8, 8), layer_norm=True)]
    assert kinds == ["Linear", "LayerNorm", "ReLU", "Linear", "LayerNorm", "ReLU", "Linear"]
    linear, norm, *_ = MLP(3, 2, (8,), layer_norm=True)
    hidden = norm(linear(10.0 * torch.randn(5, 3)))
    torch.testing.assert_close(hidden.mean(dim=-1), torch.zeros(5), atol=1e-5, rtol=0)
    torch.testing.assert_close(hidden.var(dim=-1, unbiased=False), torch.ones(5), atol=1e-2, rtol=0)


def test_fourier_features_are_the_input_and_sines_and_cosines_of_its_leading_numbers():
    torch.manual_seed(0)
    features = FourierFeatures(3, 4, scale=2.0, seen=2)
    x = torch.randn(5, 3)
    phase = x[:, :2] @ features.frequencies
    torch.testing.assert_close(features(x), torch.cat([x, phase.sin(), phase.cos()], dim=-1))
    assert features(x).shape[-1] == features.output_dim == 11
    assert FourierFeatures(3, 4000, scale=2.0).frequencies.std().item() == pytest.approx(2.0, rel=0.05)


def test_in_bfloat16_the_last_layer_and_phases_keep_all_digits():
    """A value of 60 would be a multiple of 0.25: one skill of many in a maze brings less."""
    torch.manual_seed(0)
    for net, x in ((MLP(4, 2, [32]), torch.randn(5, 4)), (MLP(4, 2, [32], members=2), torch.randn(2, 5, 4))):
        with torch.no_grad():
            net[-1].bias += 60.0
        exact = net(x)
        with torch.autocast("cpu", torch.bfloat16):
            lowered = net(x)
        assert lowered.dtype == torch.float32
        assert 0 < (lowered - exact).abs().max() < 0.01
    features, x = FourierFeatures(2, 8, scale=20.0), 10.0 * torch.randn(5, 2)
    exact = features(x)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(features(x), exact)
