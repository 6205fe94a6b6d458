"""A decoder that learns online repeats what went better than expected; codes keep their meaning."""

import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.online.follower import Follower
from dds_lightning.online.replay import Replay
from dds_lightning.online.sac import SACModule
from dds_lightning.skill import SkillModule

WIDTH, A, K, B = 3, 2, 4, 256
SETTINGS = {"horizon": 5, "num_skills": K, "skill_dim": 8, "hidden_dim": 32, "encoder_heads": 2, "decoder_blocks": 1}


@pytest.fixture
def follower():
    torch.manual_seed(0)
    skill = SkillModule(WIDTH, A, **SETTINGS, dropout=0.1)
    skill.normaliser.fit(torch.zeros(WIDTH), torch.ones(WIDTH))
    skill.action_box.fit(-torch.ones(A), torch.ones(A))
    follower = Follower(dict(skill.hparams), 1e-3)
    follower.start(skill)
    return follower


def played(actions):
    codes = torch.arange(len(actions)) % K
    return {"actions": codes, "step_observations": torch.zeros(len(actions), WIDTH), "step_actions": actions}


def test_it_begins_as_the_skills_and_only_the_decoder_learns(follower):
    before = {name: value.clone() for name, value in follower.skill.state_dict().items()}
    learning = [name for name, p in follower.named_parameters() if p.requires_grad]
    assert learning
    assert all(name.startswith("skill.decoder.") for name in learning)
    follower.train()
    assert not any(module.training for module in follower.modules())
    optimiser = torch.optim.Adam([p for p in follower.parameters() if p.requires_grad], 1e-2)
    follower.loss(played(torch.rand(B, A)), torch.randn(B)).backward()
    optimiser.step()
    after = follower.skill.state_dict()
    assert {f"skill.{name}" for name, value in before.items() if not torch.equal(value, after[name])} == set(learning)


def test_the_loss_is_the_weighted_error_of_the_noise(follower):
    batch, advantages = played(torch.rand(B, A)), torch.randn(B)
    torch.manual_seed(1)
    found = follower.loss(batch, advantages)
    torch.manual_seed(1)
    decoder, vectors = follower.skill.decoder, follower.skill.bottleneck.vectors[batch["actions"]]
    error = decoder.loss(batch["step_actions"], batch["step_observations"], vectors).mean(dim=1)
    weights = (advantages / advantages.std(correction=0)).exp().clamp(max=20.0)
    assert torch.allclose(found, (weights * error).sum() / weights.sum())


def test_the_decoder_moves_to_what_went_better(follower):
    follower.train()  # which leaves it without dropout
    optimiser = torch.optim.Adam([p for p in follower.parameters() if p.requires_grad], 3e-3)
    for _ in range(300):
        actions = 2 * torch.rand(B, A) - 1
        optimiser.zero_grad()
        follower.loss(played(actions), 3 * actions[:, 0]).backward()  # the further right, the better
        optimiser.step()
    with torch.no_grad():
        acts = follower.skill.decode(torch.zeros(400, WIDTH), torch.arange(400) % K)
    expected = 1 / torch.tanh(torch.tensor(3 / 3**0.5)) - 3**0.5 / 3  # of a density exp(x a) on [-1, 1], x = 3 / spread
    assert acts[:, 0].mean() == pytest.approx(expected.item(), abs=0.15)
    assert acts[:, 1].mean() == pytest.approx(0.0, abs=0.15)


def test_the_replay_draws_only_steps_that_were_taken():
    replay = Replay(6, WIDTH, 0)
    replay.keep_steps(5, A)
    for number, steps in enumerate((5, 1, 3)):
        seen = [torch.full((WIDTH,), 10.0 * number + step).numpy() for step in range(steps)]
        acts = [torch.full((A,), -10.0 * number - step).numpy() for step in range(steps)]
        row = {"observations": seen[0], "actions": number, "rewards": 0.0, "discounts": 1.0, "dones": 0.0}
        replay.add(**row, next_observations=seen[-1], step_observations=seen, step_actions=acts, steps=steps)
    batch = replay.sample(500, torch.Generator().manual_seed(0))
    drawn = batch["step_observations"][:, 0]
    assert sorted(set(drawn.tolist())) == [0, 1, 2, 3, 4, 10, 20, 21, 22]
    assert torch.equal(batch["step_actions"][:, 0], -drawn)
    assert torch.equal((drawn / 10).floor().long(), batch["actions"])
    other = Replay(6, WIDTH, 0)
    other.load_state_dict(replay.state_dict())
    assert torch.equal(
        other.sample(9, torch.Generator().manual_seed(1))["step_actions"],
        replay.sample(9, torch.Generator().manual_seed(1))["step_actions"],
    )
    without = Replay(6, WIDTH, 0)
    without.add(**row, next_observations=seen[-1])
    with pytest.raises(UserError, match=r"model\.follow is above 0, but the checkpoint's replay has no steps"):
        replay.load_state_dict(without.state_dict())


def test_raw_actions_have_no_decoder():
    with pytest.raises(UserError, match=r"model\.follow is 0.1, expected 0: there are no skills"):
        SACModule(WIDTH, "raw", A, follow=0.1)
