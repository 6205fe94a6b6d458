"""Decision Diffuser: the authors' losses on a fixed batch, guidance, and the toy of two modes."""

import pytest
import torch

from datamodules import transitions
from datamodules.relabelling import returns_to_go
from datamodules.transitions import SequenceDataModule
from dds_lightning.baselines.actors import ModuleActor
from dds_lightning.baselines.decision_diffuser import DecisionDiffuser
from tests.baselines.toys import regret, train, two_modes


def sequences(size: int = 16, horizon: int = 4) -> dict[str, torch.Tensor]:
    stream = torch.Generator().manual_seed(0)
    return {
        "observations": torch.randn(size, horizon, 3, generator=stream),
        "actions": torch.rand(size, horizon, 2, generator=stream) * 2 - 1,
        "returns": torch.rand(size, horizon, generator=stream) * 4,
    }


def small(**settings) -> DecisionDiffuser:
    return DecisionDiffuser(3, 2, horizon=4, hidden_dim=8, blocks=2, diffusion_steps=5, **settings)


def test_the_losses_are_the_authors_formulas():
    torch.manual_seed(0)
    module, batch = small(untold=0.5), sequences()
    module.return_range.copy_(torch.tensor([1.0, 3.0]))
    module.plan_spread.copy_(torch.tensor([0.5, 1.0, 2.0])[:, None].expand(3, 3))
    torch.manual_seed(1)
    total, terms = module.loss(batch)
    torch.manual_seed(1)
    told = (torch.rand(16, 1) >= 0.5).float()
    assert 0 < told.mean() < 1
    y = (batch["returns"][:, :1] - 1.0) / 2.0
    x = batch["observations"]
    ahead = ((x[:, 1:] - x[:, :1]) / torch.tensor([0.5, 1.0, 2.0])[:, None]).reshape(16, 9)
    t, noise = torch.randint(5, (16,)), torch.randn(16, 9)
    kept = module.plans.alpha_bars[t, None]
    noisy = kept.sqrt() * ahead + (1 - kept).sqrt() * noise
    seen = torch.cat([noisy, module.plans.time_table[t], y * told, told, x[:, 0]], -1)
    denoising = 0.5 * ((noise - module.plans.net(seen)) ** 2).mean()
    inverse = 0.5 * ((batch["actions"][:, :3] - module.inverse(torch.cat([x[:, :3], x[:, 1:]], -1))) ** 2).mean()
    assert terms["denoising"].item() == pytest.approx(denoising.item(), rel=1e-5)
    assert terms["inverse"].item() == pytest.approx(inverse.item(), rel=1e-5)
    assert total.item() == pytest.approx((denoising + inverse).item(), rel=1e-5)


def test_guidance_goes_beyond_what_the_return_changes():
    torch.manual_seed(0)
    plans = small().plans
    noisy, t, s = torch.randn(5, 9), torch.zeros(5, dtype=torch.long), torch.randn(5, 3)
    y = torch.tensor([0.9, 1.0]).expand(5, 2)
    told, free = (plans.predict_noise(noisy, t, s, one) for one in (y, torch.zeros_like(y)))
    guided = plans.predict_noise(noisy, t, s, torch.cat([y, torch.full((5, 1), 1.2)], -1))
    assert (told - free).abs().max() > 1e-4
    assert torch.allclose(guided, free + 1.2 * (told - free), atol=1e-6)


def test_every_step_of_a_plan_sees_the_present():
    torch.manual_seed(0)
    plans = DecisionDiffuser(3, 2, horizon=20).plans
    present = torch.randn(1, 3, requires_grad=True)
    noise = plans.predict_noise(torch.randn(1, 57), torch.zeros(1, dtype=torch.long), present, torch.ones(1, 2))
    (slope,) = torch.autograd.grad(noise[0, -3:].sum(), present)
    assert slope.abs().min() > 0


def test_returns_to_go_and_steps_are_those_of_the_episodes():
    data = SequenceDataModule.from_trajectories(two_modes(20), horizon=4, batch_size=8, gamma=0.9, reward_scale=2.0)
    batch = next(iter(data.train_dataloader()))
    rewards, returns, steps = batch["rewards"], batch["returns"], batch["steps"]
    assert torch.allclose(returns[:, 0], rewards[:, 0] + 0.9 * returns[:, 1], atol=1e-5)
    assert torch.equal(steps[:, 1:] - steps[:, :-1], torch.ones(8, 3, dtype=torch.long))
    last = steps[:, -1] == 7
    assert torch.allclose(returns[last, -1], rewards[last, -1])
    paid = 2.0 * batch["observations"][..., 1] * batch["actions"][..., 0]
    assert torch.allclose(rewards, paid, atol=1e-5)


def test_returns_to_go_are_summed_up_once(monkeypatch):
    calls = []
    monkeypatch.setattr(transitions, "returns_to_go", lambda *given: calls.append(1) or returns_to_go(*given))
    data = SequenceDataModule.from_trajectories(two_modes(20), horizon=4, batch_size=8)
    data.statistics()
    data.train_dataloader()
    data.val_dataloader()
    assert len(calls) == 1


def test_it_plans_for_the_mode_that_pays():
    torch.manual_seed(0)
    data = SequenceDataModule.from_trajectories(two_modes(), horizon=4, batch_size=128, gamma=1.0, reward_scale="auto")
    module = DecisionDiffuser(2, 1, 4, hidden_dim=32, blocks=2, diffusion_steps=8, lr=2e-3)
    train(module, data, 600)
    assert regret(ModuleActor(module)) < 0.25  # of 0.6; it asks for 0.9 of the best return, at every step
    start = torch.tensor([[0.0, 1.0]]).expand(200, 2)
    ahead = module.plan(start)[:, 0] * module.normaliser.std + module.normaliser.mean - start
    assert 0.06 < ahead[:, 0].mean() < 0.18  # a step of the mode that pays goes 0.12 ahead
    assert ahead[:, 1].abs().max() < 0.05  # and who pays stays


def test_a_return_of_one_is_the_greatest_that_a_plan_starts_with():
    data = two_modes(20)  # episodes of 8 steps
    data.rewards[:] = 0.0
    data.rewards[data.step_offsets[1:] - 1] = 128.0
    module = SequenceDataModule.from_trajectories(data, horizon=4, gamma=0.5)
    found = module.statistics()
    assert found["return_range"].tolist() == [1.0, 1.0]  # 128 / 2^7 at the start of an episode
    assert found["return_to_go_range"].tolist() == [1.0, 16.0]  # the last plan starts 3 steps before the end
    firsts = torch.cat([batch["returns"][:, 0] for batch in module.train_dataloader()])
    assert firsts.max() == 16.0  # a target of 1 is one that the network has seen
