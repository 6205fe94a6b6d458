"""The schedule against the published numbers, the samplers against a distribution that is known."""

import pytest
import torch

from dds_lightning.nn.diffusion import DiffusionDecoder, MLPDecoder, sinusoidal_embedding, vp_betas


def test_vp_schedule_of_the_paper():
    betas = vp_betas(5, 0.1, 10.0)
    assert betas.tolist() == pytest.approx([0.196, 0.459, 0.636, 0.755, 0.835], abs=6e-4)
    assert torch.cumprod(1 - betas, 0).tolist() == pytest.approx([0.804, 0.435, 0.159, 0.039, 0.0064], abs=6e-4)


def test_time_embedding_starts_with_sines_and_ends_with_cosines():
    table = sinusoidal_embedding(torch.tensor([0, 1]), 16)
    assert table.shape == (2, 16)
    assert table[0].tolist() == [0.0] * 8 + [1.0] * 8
    assert table[1, 0].item() == pytest.approx(0.841471, abs=1e-5)


MODE = 0.9


def exact_decoder(steps: int) -> DiffusionDecoder:
    """The denoiser that knows the distribution: E[x0 | x_t] of two equally likely modes is a tanh."""
    decoder = DiffusionDecoder(1, 1, 2, hidden_dim=8, blocks=1, dropout=0.0, diffusion_steps=steps).eval()

    def predict_noise(noisy, t, observations, skills):
        alpha_bar = decoder.alpha_bars[t, None]
        x0 = MODE * torch.tanh(MODE * alpha_bar.sqrt() * noisy / (1 - alpha_bar))
        return (noisy - alpha_bar.sqrt() * x0) / (1 - alpha_bar).sqrt()

    decoder.predict_noise = predict_noise
    return decoder


@pytest.fixture(scope="module")
def trained():
    """A decoder trained on actions that are -0.9 or +0.9 with equal chance, and 1000 states to ask it for."""
    torch.manual_seed(0)
    decoder = DiffusionDecoder(1, 1, 2, hidden_dim=48, blocks=2, dropout=0.0)
    optimizer = torch.optim.Adam(decoder.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 700)
    state, skill = torch.zeros(256, 1), torch.zeros(256, 2)
    for _ in range(700):
        actions = MODE * (2.0 * torch.randint(2, (256, 1)) - 1.0)
        optimizer.zero_grad()
        decoder.loss(actions, state, skill).mean().backward()
        optimizer.step()
        schedule.step()
    return decoder.eval(), torch.zeros(2000, 1), torch.zeros(2000, 2)


def shares(decoder, state, skill, sampler) -> tuple[float, float]:
    """Share of the samples right of 0, and share within 0.15 of a mode."""
    decoder.sampler = sampler
    with torch.no_grad():
        samples = decoder.sample(state, skill, generator=torch.Generator().manual_seed(1)).flatten()
    near = ((samples.abs() - MODE).abs() < 0.15).float().mean().item()
    return (samples > 0).float().mean().item(), near


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_samplers_reproduce_both_modes_as_well_as_five_steps_can(trained, sampler):
    decoder, state, skill = trained
    right, near = shares(decoder, state, skill, sampler)
    exact_right, exact_near = shares(exact_decoder(5), state, skill, sampler)
    assert right == pytest.approx(0.5, abs=0.05)
    assert exact_right == pytest.approx(0.5, abs=0.05)
    assert near == pytest.approx(exact_near, abs=0.07)
    assert near > 0.6  # a regressor would answer 0, between the modes: none


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_five_steps_blur_what_fifty_steps_resolve(trained, sampler):
    """The last of T = 5 steps starts from noise of 0.49 in units of x0 and answers the mean given that."""
    _, state, skill = trained
    assert shares(exact_decoder(5), state, skill, sampler)[1] < 0.9
    assert shares(exact_decoder(50), state, skill, sampler)[1] > 0.98


def standard_normal_draws(decoder: DiffusionDecoder) -> torch.Tensor:
    """20,000 draws with the denoiser that knows that x0 is N(0, 1): E[epsilon | x_t] is sqrt(1 - alpha_bar) x_t."""
    decoder.predict_noise = lambda noisy, t, *_: (1 - decoder.alpha_bars[t, None]).sqrt() * noisy
    nothing = torch.zeros(20_000, 0)
    return decoder.sample(nothing, nothing, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("variance", "spread"), [("posterior", 0.675), ("beta", 0.897)])
def test_five_steps_with_a_perfect_network_keep_this_much_of_a_normal_distribution(variance, spread):
    decoder = DiffusionDecoder(0, 1, 0, hidden_dim=8, blocks=1, clip=False, variance=variance)
    assert standard_normal_draws(decoder).std().item() == pytest.approx(spread, abs=0.01)


def test_a_regressor_answers_between_the_modes():
    torch.manual_seed(0)
    decoder = MLPDecoder(1, 1, 2, hidden_dim=16, blocks=1, dropout=0.0)
    optimizer = torch.optim.Adam(decoder.parameters(), lr=1e-2)
    state, skill = torch.zeros(256, 1), torch.zeros(256, 2)
    actions = 0.6 * (2.0 * (torch.arange(256)[:, None] % 2) - 1.0)
    for _ in range(100):
        optimizer.zero_grad()
        decoder.loss(actions, state, skill).mean().backward()
        optimizer.step()
    assert decoder.sample(state, skill).abs().max().item() < 0.05


def test_no_noise_is_deterministic_and_less_noise_spreads_less(trained):
    decoder, state, skill = trained
    decoder.sampler = "ddpm"
    with torch.no_grad():
        assert torch.equal(decoder.sample(state, skill, 0.0), decoder.sample(state, skill, 0.0))
        assert decoder.sample(state, skill, 0.0).std().item() < 1e-6
        spread = decoder.sample(state, skill, 1.0, torch.Generator().manual_seed(2)).std().item()
    assert spread == pytest.approx(0.79, abs=0.06)


def test_the_same_stream_gives_the_same_actions_and_leaves_the_global_one_alone(trained):
    decoder, state, skill = trained
    before = torch.random.get_rng_state()
    with torch.no_grad():
        a = decoder.sample(state, skill, generator=torch.Generator().manual_seed(3))
        b = decoder.sample(state, skill, generator=torch.Generator().manual_seed(3))
    assert torch.equal(a, b)
    assert torch.equal(before, torch.random.get_rng_state())


def test_clipping_keeps_every_sample_in_the_box():
    torch.manual_seed(0)
    decoder = DiffusionDecoder(1, 2, 2, hidden_dim=16, blocks=1).eval()
    state, skill = torch.randn(200, 1), torch.randn(200, 2)
    with torch.no_grad():
        assert decoder.sample(state, skill).abs().max().item() <= 1.0
        decoder.clip = False
        assert decoder.sample(state, skill).abs().max().item() > 1.0


def test_the_loss_of_a_perfect_noise_predictor_is_zero():
    decoder = DiffusionDecoder(1, 1, 1, hidden_dim=8, blocks=1, dropout=0.0)
    actions = torch.full((64, 1), 0.3)

    def oracle(noisy, t, observations, skills):
        alpha_bar = decoder.alpha_bars[t, None]
        return (noisy - alpha_bar.sqrt() * actions[: len(noisy)]) / (1 - alpha_bar).sqrt()

    decoder.predict_noise = oracle
    assert decoder.loss(actions, torch.zeros(64, 1), torch.zeros(64, 1)).max().item() < 1e-9
    samples = decoder.sample(torch.zeros(64, 1), torch.zeros(64, 1))
    torch.testing.assert_close(samples, actions, atol=1e-5, rtol=0)
