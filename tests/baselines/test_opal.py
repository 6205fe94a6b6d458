"""OPAL and LDCQ: the authors' losses on a fixed batch, and the toy of two modes over Gaussian skills."""

import numpy as np
import pytest
import torch

from datamodules.segments import SegmentDataModule
from datamodules.transitions import LatentDataModule
from dds_lightning.baselines.ldcq import LDCQ
from dds_lightning.baselines.methods import METHODS
from dds_lightning.baselines.opal import OPAL
from dds_lightning.errors import UserError
from dds_lightning.skill import SkillModule
from tests.baselines.toys import batch_of, dense, regret, train, two_modes

H = 2
SHAPE = {"skill_dim": 4, "hidden_dim": 32, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 2, "dropout": 0.0}


@pytest.fixture(scope="module")
def skills(tmp_path_factory):
    """A checkpoint of continuous skills of the toy."""
    torch.manual_seed(0)
    module = SkillModule(2, 1, H, bottleneck="gaussian", lr=2e-3, noise_scale=0.0, **SHAPE)
    train(module, SegmentDataModule.from_trajectories(two_modes(), horizon=H, batch_size=128), 300)
    path = tmp_path_factory.mktemp("skills") / "skill.ckpt"
    module.trainer.save_checkpoint(path)
    return str(path)


def data_of(skills):
    return LatentDataModule.from_trajectories(
        two_modes(), skill=skills, batch_size=128, gamma=0.9, discount="per_step", reward_scale="auto"
    )


def test_opals_losses_are_iqls_formulas():
    torch.manual_seed(0)
    module, batch = OPAL(3, 2, hidden_dims=[8, 8], tau=0.8, beta=2.0, weight_clip=1.5), batch_of()
    total, terms = module.loss(batch)
    s, z, after = batch["observations"], batch["actions"], batch["next_observations"]
    pair = torch.cat([s, z], -1)
    q = torch.minimum(*(dense(module.critic.target, pair, i) for i in (0, 1)))
    u = (q - module.value(s).squeeze(-1)).detach().numpy()
    y = (batch["rewards"] + 0.9 * (1 - batch["dones"]) * module.value(after).squeeze(-1)).detach()
    weight = np.minimum(np.exp(2.0 * u), 1.5)
    log_pi = -0.5 * ((z - module.actor(s)) ** 2 + np.log(2 * np.pi)).sum(dim=1).detach().numpy()  # std is 1 at first
    expected = {
        "value_loss": np.mean(np.where(u < 0, 0.2, 0.8) * u**2),
        "q_loss": sum(((dense(module.critic.online, pair, i) - y) ** 2).mean().item() for i in (0, 1)),
        "actor_loss": -np.mean(weight * log_pi),
    }
    for name, value in expected.items():
        assert terms[name].item() == pytest.approx(value, abs=1e-5), name
    assert total.item() == pytest.approx(sum(expected.values()), abs=1e-5)


def test_ldcqs_losses_are_the_authors_formulas():
    torch.manual_seed(0)
    module, batch = LDCQ(3, 2, hidden_dims=[8, 8], hidden_dim=8, blocks=1, prior_steps=1, backup_samples=3), batch_of()
    s, z, after = batch["observations"], batch["actions"], batch["next_observations"]
    torch.manual_seed(1)
    total, _ = module.loss(batch)
    torch.manual_seed(1)
    t, noise = torch.randint(10, (16,)), torch.randn(16, 2)
    kept = module.prior.alpha_bars[t, None]
    noisy = kept.sqrt() * z + (1 - kept).sqrt() * noise
    guess = (noisy - (1 - kept).sqrt() * module.prior.predict_noise(noisy, t, s, s[:, :0])) / kept.sqrt()  # z_hat
    prior_loss = ((kept / (1 - kept)).clamp(max=5.0) * (z - guess) ** 2).mean()
    assert total.item() == pytest.approx(prior_loss.item(), rel=1e-4)

    module.learning = module.learning_at(1)
    torch.manual_seed(1)
    total, _ = module.loss(batch)
    torch.manual_seed(1)
    wide = after.repeat_interleave(3, 0)
    proposed = module.prior.sample(wide, wide[:, :0])
    pair = torch.cat([wide, proposed], -1)
    best = torch.minimum(*(dense(module.critic.target, pair, i) for i in (0, 1))).view(16, 3).max(dim=1).values
    y = batch["rewards"] + 0.9 * (1 - batch["dones"]) * best
    q_loss = sum(((dense(module.critic.online, torch.cat([s, z], -1), i) - y) ** 2).mean() for i in (0, 1))
    assert total.item() == pytest.approx(q_loss.item(), abs=1e-5)


def test_ldcqs_proposals_are_spread_as_the_data():
    prior = LDCQ(3, 1, hidden_dims=[8], hidden_dim=8, blocks=1, diffusion_steps=5).prior
    prior.predict_noise = lambda noisy, t, *_: (1 - prior.alpha_bars[t, None]).sqrt() * noisy  # exact for N(0, 1)
    drawn = prior.sample(torch.zeros(20_000, 3), torch.zeros(20_000, 0), generator=torch.Generator().manual_seed(0))
    assert drawn.std().item() == pytest.approx(0.897, abs=0.01)  # 0.675 with the posterior's variance


def test_the_actions_of_the_data_are_the_encoders_means(skills):
    data = data_of(skills)
    batch = next(iter(data.train_dataloader()))
    assert batch["actions"].shape == (128, 4)
    model, first = SkillModule.load(skills), two_modes().episode(0)
    segment = [torch.from_numpy(np.array(first[name][:H]))[None] for name in ("observations", "actions")]
    assert torch.allclose(data.choices()[0], model.encode_segments(*segment).vectors[0], atol=1e-5)
    rewards = (first["rewards"][0] + 0.9 * first["rewards"][1]) * data.relabelling.affine(two_modes(), H)[0]
    loader = data._loader(np.arange(1))
    assert next(iter(loader))["rewards"].item() == pytest.approx(rewards, rel=1e-5)


SMALL = {"prior_steps": 250, "samples": 32, "backup_samples": 4, "hidden_dim": 32, "blocks": 2, "diffusion_steps": 5}


@pytest.mark.parametrize(("kind", "settings"), [(OPAL, {"beta": 3.0}), (LDCQ, SMALL)])
def test_they_find_the_mode_that_pays(kind, settings, skills, tmp_path):
    torch.manual_seed(0)
    data = data_of(skills)
    module = kind(2, 4, [64, 64], lr=2e-3, skill_hash=data.skill_hash, **settings)
    train(module, data, 500)
    module.trainer.save_checkpoint(tmp_path / "last.ckpt")
    agent = METHODS[kind.STAGE].play({"skill": skills, kind.STAGE: str(tmp_path / "last.ckpt")})
    assert regret(agent) < 0.15


def test_discrete_skills_are_refused(tmp_path):
    module = SkillModule(2, 1, H, lr=1e-3, num_skills=4, **SHAPE)
    train(module, SegmentDataModule.from_trajectories(two_modes(20), horizon=H, batch_size=32), 1)
    module.trainer.save_checkpoint(tmp_path / "vq.ckpt")
    with pytest.raises(UserError, match=r"whose skills are discrete.*--model.bottleneck=gaussian"):
        LatentDataModule.from_trajectories(two_modes(20), skill=str(tmp_path / "vq.ckpt"))
    with pytest.raises(UserError, match=r"data\.skill is missing"):
        LatentDataModule()


def test_a_training_that_would_leave_the_critic_no_step_is_refused(skills):
    module = LDCQ(2, 4, [8], prior_steps=5, hidden_dim=8, blocks=1, diffusion_steps=2)
    with pytest.raises(UserError, match=r"model\.prior_steps is 5, expected less than the 5 steps"):
        train(module, data_of(skills), 5)
