"""Diffusion-QL: the authors' losses on a fixed batch, and the toy of two modes."""

import pytest
import torch

from datamodules.transitions import TransitionDataModule
from dds_lightning.baselines.actors import ModuleActor
from dds_lightning.baselines.diffusion_ql import DiffusionQL, climb
from tests.baselines.toys import batch_of, dense, regret, train, two_modes


@pytest.mark.parametrize("count", [1, 4])
def test_the_losses_are_the_authors_formulas(count):
    torch.manual_seed(0)
    module, batch = DiffusionQL(3, 2, [8, 8], hidden_dim=8, eta=2.0, backup_samples=count), batch_of()
    torch.manual_seed(1)
    total, terms = module.loss(batch)
    s, a, after = batch["observations"], batch["actions"], batch["next_observations"]
    torch.manual_seed(1)  # the same draws in the same order
    new = module.actor.sample(s, s[:, :0])
    wide = after.repeat_interleave(count, 0)
    next_actions = module.target_actor.sample(wide, wide[:, :0])
    values = [dense(module.critic.target, torch.cat([wide, next_actions], -1), i).view(16, count) for i in (0, 1)]
    q_next = torch.minimum(values[0].max(dim=1).values, values[1].max(dim=1).values)
    y = batch["rewards"] + 0.9 * (1 - batch["dones"]) * q_next
    q_loss = sum(((dense(module.critic.online, torch.cat([s, a], -1), i) - y) ** 2).mean() for i in (0, 1))
    t, noise = torch.randint(5, (16,)), torch.randn(16, 2)
    abar = module.actor.alpha_bars[t, None]
    guess = module.actor.predict_noise(abar.sqrt() * a + (1 - abar).sqrt() * noise, t, s, s[:, :0])
    denoising = ((noise - guess) ** 2).mean()
    q = [dense(module.critic.online, torch.cat([s, new], -1), i) for i in (0, 1)]
    heads = torch.rand(()) < 0.5
    first, other = (q[1], q[0]) if heads else (q[0], q[1])
    policy = -2.0 * first.mean() / other.abs().mean()
    for name, value in {"q_loss": q_loss, "denoising": denoising, "climb": policy}.items():
        assert terms[name].item() == pytest.approx(value.item(), abs=1e-5), name
    assert total.item() == pytest.approx((q_loss + denoising + policy).item(), abs=1e-5)


def test_climbing_moves_the_policy_and_leaves_the_critic():
    torch.manual_seed(0)
    module, batch = DiffusionQL(3, 2, [8, 8], hidden_dim=8), batch_of()
    actions = torch.zeros(16, 2, requires_grad=True)
    climb(module.critic.judge(batch["observations"], actions), 0).backward()
    assert actions.grad.abs().sum() > 0
    assert all(p.grad is None for p in module.critic.parameters())


def test_the_target_policy_waits_and_moves_every_fifth_step():
    module = DiffusionQL(3, 2, actor_ema_start=10, actor_ema_every=5)
    assert [len(module.followers(step)) for step in (5, 10, 11, 15)] == [1, 2, 1, 2]


def test_the_choice_among_proposals_does_not_depend_on_the_unit_of_rewards(monkeypatch):
    torch.manual_seed(0)
    module, x = DiffusionQL(3, 2, [8, 8], hidden_dim=8, blocks=1), torch.randn(64, 3)
    q = torch.tensor([0.0, 2.0, 4.0]).expand(64, 3)
    actions = torch.tensor([-1.0, 0.0, 1.0])[None, :, None].expand(64, 3, 2)

    def chosen(scale: float, temperature: float) -> torch.Tensor:
        monkeypatch.setattr("dds_lightning.baselines.diffusion_ql.proposals", lambda *_: (actions, scale * q))
        module.hparams.temperature = temperature
        return module.act(x, torch.Generator().manual_seed(0))

    as_recorded = chosen(1.0, 1.0)
    assert torch.equal(as_recorded, chosen(0.01, 0.01))
    assert (as_recorded == 1.0).float().mean() > 0.75  # e^4 / (1 + e^2 + e^4) is 0.87
    assert (chosen(0.01, 1.0) == 1.0).float().mean() < 0.5  # 0.34: hardly a choice any more


def test_it_finds_the_mode_that_pays():
    torch.manual_seed(0)
    data = TransitionDataModule.from_trajectories(two_modes(), batch_size=128, gamma=0.9, reward_scale="auto")
    module = DiffusionQL(2, 1, [64, 64], hidden_dim=64, blocks=2, samples=16, lr=1e-3, actor_ema_start=50)
    train(module, data, 500)
    assert regret(ModuleActor(module)) < 0.1  # it may climb beyond the mode
