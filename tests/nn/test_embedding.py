"""What networks see of an observation, and the ranges of settings that all networks share."""

import pytest
import torch

from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
from dds_lightning.baselines.idql import IDQL
from dds_lightning.baselines.opal import OPAL
from dds_lightning.errors import UserError
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.ranges import network_rules
from dds_lightning.policy import PolicyModule

FEATURES = dict(zip(FOURIER, (8, 2.0, 2), strict=True))


def test_fourier_features_are_sines_and_cosines_of_the_normalised_numbers_that_are_seen():
    module = BehaviourCloning(3, 1, [8], **FEATURES)
    module.normaliser.fit(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 2.0, 2.0]))
    x = torch.randn(5, 3)
    unit = (x - torch.tensor([1.0, 2.0, 3.0])) / 2
    phase = unit[:, :2] @ module.features.frequencies
    assert torch.allclose(module.embed(x), torch.cat([unit, phase.sin(), phase.cos()], -1))
    assert module.embedding_dim == 3 + 16
    assert module(x).shape == (5, 1)


def test_without_them_networks_see_the_normalised_numbers():
    module = BehaviourCloning(3, 1, [8])
    assert module.embedding_dim == 3
    assert not [name for name in module.state_dict() if name.startswith("features")]


@pytest.mark.parametrize("make", [lambda **more: IDQL(4, 2, [8], **more), lambda **more: OPAL(4, 2, [8], **more)])
def test_critics_read_the_embedding(make):
    module = make(**FEATURES)
    assert module.critic.online[0].weight.shape == (2, 4 + 16 + 2, 8)
    assert module.value[0].in_features == 4 + 16


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hidden_dims": [8, 0]}, r"model\.hidden_dims is \[8, 0\], expected widths of at least 1"),
        ({"hidden_dim": 0}, r"model\.hidden_dim is 0, expected at least 1"),
        ({"blocks": -1}, r"model\.blocks is -1, expected at least 1"),
        ({"dropout": 2.0}, r"model\.dropout is 2\.0, expected in \[0, 1\)"),
        ({"fourier_features": -1}, r"model\.fourier_features is -1, expected 0 \(none\) or more"),
        ({"fourier_scale": 0.0}, r"model\.fourier_scale is 0\.0, expected positive"),
        ({"fourier_seen": 5}, r"model\.fourier_seen is 5, expected in \[0, 4\]"),
    ],
)
def test_settings_outside_their_range_are_named(settings, message):
    with pytest.raises(UserError, match=message):
        IDQL(4, 2, **settings)


def test_settings_that_no_network_shares_have_no_rule():
    assert network_rules({"tau": 7.0, "dropout": 0.1}) == [("dropout", True, "in [0, 1)")]


def test_a_policys_networks_read_the_same_embedding():
    assert PolicyModule(4, 3, [8], **FEATURES).actor[0].in_features == 4 + 16
