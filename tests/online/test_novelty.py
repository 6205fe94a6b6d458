"""Optimistic labels: the reward that was learned where one has been, and a bonus where one has not."""

import pytest
import torch

from dds_lightning.online.novelty import Novelty
from dds_lightning.online.sac import SACModule


@pytest.fixture(scope="module")
def trained():
    """Trained on states in [0, 1]: the reward is the first number, the end is where the second is above 0.5."""
    torch.manual_seed(0)
    novelty = Novelty(2, [64, 64])
    optimizer = torch.optim.Adam([p for p in novelty.parameters() if p.requires_grad], lr=3e-3)
    for _ in range(600):
        x = torch.rand(128, 2)
        batch = {"known": torch.ones(128, dtype=torch.bool), "rewards": x[:, 0], "dones": (x[:, 1] > 0.5).float()}
        loss = novelty.loss(batch, x)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return novelty.eval()


def label(novelty, x, optimism):
    unknown = {"known": torch.zeros(len(x), dtype=torch.bool), "rewards": torch.zeros(len(x))}
    return novelty.label({**unknown, "dones": torch.zeros(len(x))}, x, optimism)


def test_rewards_and_terminations_are_learned(trained):
    x = torch.tensor([[0.2, 0.1], [0.8, 0.9], [0.5, 0.2], [0.3, 0.8]])
    reward, end = label(trained, x, 0.0)
    assert torch.allclose(reward, x[:, 0], atol=0.05)
    assert end.tolist() == [0, 1, 0, 1]


def test_the_bonus_is_near_zero_where_one_was_and_large_where_not(trained):
    near, far = torch.rand(200, 2), 3.0 + torch.rand(200, 2)
    bonus = [label(trained, x, 1.0)[0] - label(trained, x, 0.0)[0] for x in (near, far)]
    assert bonus[0].mean() < 0.05
    assert bonus[1].mean() > 10 * bonus[0].mean()
    twice = label(trained, far, 2.0)[0] - label(trained, far, 0.0)[0]
    assert torch.allclose(twice, 2 * bonus[1], rtol=1e-4)


def test_the_random_network_never_changes(trained):
    assert all(not weights.requires_grad for weights in trained.random.parameters())


def test_unknown_rewards_are_replaced_and_known_ones_are_not():
    torch.manual_seed(0)
    module = SACModule(3, "discrete", 4, hidden_dims=[8], prior_unknown=True, optimism=0.5)
    batch = {"observations": torch.randn(6, 3), "actions": torch.randint(4, (6,)), "rewards": torch.full((6,), 9.0)}
    batch |= {"next_observations": torch.randn(6, 3), "discounts": torch.ones(6), "dones": torch.ones(6)}
    batch["known"] = torch.arange(6) < 3
    module.train()
    _, terms = module.loss(batch)
    assert terms["novelty_loss"] > 0
    x = module._transition(batch, module.embed(batch["observations"]))
    rewards, dones = module.novelty.label(batch, x, 0.5)
    assert rewards[:3].tolist() == [9.0] * 3
    assert (rewards[3:] < 3).all()
    assert dones[:3].tolist() == [1.0] * 3
    changed = {**batch, "rewards": torch.where(batch["known"], batch["rewards"], -100.0)}
    torch.manual_seed(1)
    same = module.loss(changed)[1]["q_loss"]
    torch.manual_seed(1)
    assert same == module.loss(batch)[1]["q_loss"]


def test_the_first_target_is_as_small_as_all_others():
    """A first bonus without a unit would be about 1e10, and Adam's second moment would then hold the critics still."""
    torch.manual_seed(0)
    module = SACModule(3, "discrete", 4, hidden_dims=[16], prior_unknown=True).train()
    batch = {"observations": torch.randn(64, 3), "actions": torch.randint(4, (64,)), "rewards": -torch.ones(64)}
    batch |= {"next_observations": torch.randn(64, 3), "discounts": torch.full((64,), 0.9), "dones": torch.zeros(64)}
    batch["known"] = torch.arange(64) < 32
    _, terms = module.loss(batch)
    assert terms["q_loss"] < 2 * 4**2  # two critics; a reward near 0 and a bonus near 1
    x = module._transition(batch, module.embed(batch["observations"]))
    with torch.no_grad():
        assert module.novelty.first == module.novelty.error(x[:32]).mean()
