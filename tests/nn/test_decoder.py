"""What every decoder offers, whether it draws noise or not."""

from types import SimpleNamespace

import pytest
import torch

from dds_lightning.skill import DECODERS

SETTINGS = SimpleNamespace(
    **{"observation_dim": 4, "action_dim": 2, "skill_dim": 3, "hidden_dim": 8, "decoder_blocks": 1, "dropout": 0.0},
    **{"diffusion_steps": 3, "beta_min": 0.1, "beta_max": 10.0, "time_dim": 4, "sampler": "ddpm", "clip_actions": True},
)


@pytest.fixture(params=DECODERS)
def decoder(request):
    torch.manual_seed(0)
    return DECODERS[request.param].build(SETTINGS).eval()


def test_a_sample_is_its_noise_denoised(decoder):
    observations, skills = torch.randn(5, 4), torch.randn(5, 3)
    drawn = decoder.sample(observations, skills, 0.5, torch.Generator().manual_seed(1))
    stream = torch.Generator().manual_seed(1)
    noise = [torch.randn(5, 2, generator=stream) for _ in range(decoder.draws)]
    noise = 0.5 * torch.stack(noise) if noise else torch.zeros(0, 5, 2)
    assert drawn.shape == (5, 2)
    assert torch.equal(drawn, decoder.denoise(noise, observations, skills))
    assert drawn.abs().max() <= 1.0


def test_the_loss_has_a_number_for_every_action_and_its_gradient_reaches_the_skills(decoder):
    skills = torch.randn(5, 3, requires_grad=True)
    error = decoder.loss(torch.rand(5, 2) * 2 - 1, torch.randn(5, 4), skills)
    assert error.shape == (5, 2)
    assert (error >= 0).all()
    error.sum().backward()
    assert (skills.grad.abs().sum(dim=1) > 0).all()


def test_without_noise_it_repeats_itself(decoder):
    observations, skills = torch.randn(5, 4), torch.randn(5, 3)
    assert torch.equal(decoder.sample(observations, skills, 0.0), decoder.sample(observations, skills, 0.0))
