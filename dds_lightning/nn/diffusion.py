"""Action decoders: skill vector and state to action, by denoising or directly (section 4.1, appendix A.1.2)."""

import math
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from dds_lightning.nn.decoder import Decoder
from dds_lightning.nn.dropout import Dropout

Sampler = Literal["ddpm", "ddim"]
Variance = Literal["posterior", "beta"]


def vp_betas(steps: int, beta_min: float = 0.1, beta_max: float = 10.0) -> Tensor:
    """Variance-preserving schedule (Song et al., 2021, discretised as in DDPM-style policies).

    ``1 - beta_t = exp(-beta_min / T - (beta_max - beta_min) (2 t - 1) / (2 T^2))`` for t = 1..T.

    Returns:
        (T,) beta_t in float64; T = 5 with 0.1..10 gives .196 .459 .636 .755 .835.
    """
    t = torch.arange(1, steps + 1, dtype=torch.float64)
    return 1.0 - torch.exp(-beta_min / steps - 0.5 * (beta_max - beta_min) * (2.0 * t - 1.0) / steps**2)


def sinusoidal_embedding(t: Tensor, dim: int) -> Tensor:
    """Sines and cosines of integer time steps: (B,) to (B, dim), dim even."""
    half = dim // 2
    frequencies = torch.exp(-math.log(10_000.0) * torch.arange(half, device=t.device) / max(half - 1, 1))
    phase = t.float()[:, None] * frequencies
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


class ResidualBlock(nn.Module):
    """Layer norm, expansion by four, ReLU, compression, added to the input."""

    def __init__(self, dim: int, dropout: float) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.LayerNorm(dim),
            Dropout(dropout),
            nn.Linear(dim, 4 * dim),
            nn.ReLU(),
            nn.Linear(4 * dim, dim),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, dim) to (B, dim)."""
        return x + self.net(x)


class ResidualMLP(nn.Module):
    """The layer-normalised residual backbone that both decoders share.

    Args:
        input_dim: Width of the concatenated input.
        output_dim: A.
        hidden_dim: Width of the blocks.
        blocks: Number of residual blocks.
        dropout: Rate inside the blocks.
    """

    def __init__(
        self, input_dim: int, output_dim: int, hidden_dim: int = 256, blocks: int = 4, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.input = nn.Linear(input_dim, hidden_dim)
        self.blocks = nn.Sequential(*(ResidualBlock(hidden_dim, dropout) for _ in range(blocks)))
        self.output = nn.Linear(hidden_dim, output_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, input_dim) to (B, output_dim)."""
        return self.output(self.blocks(self.input(x)))


class DiffusionDecoder(Decoder):
    """Noise prediction network and its samplers; actions live in [-1, 1].

    Args:
        observation_dim: O.
        action_dim: A.
        skill_dim: D.
        hidden_dim: Width of the backbone.
        blocks: Residual blocks.
        dropout: Rate inside the blocks.
        diffusion_steps: T.
        beta_min: Start of the VP schedule.
        beta_max: End of the VP schedule.
        time_dim: Width of the time embedding.
        sampler: ``ddpm`` draws from the posterior, ``ddim`` follows the deterministic path (Song et al., 2020).
        clip: Keep the predicted x0 in [-1, 1] at every step.
        net: The noise prediction network, of the concatenated input; by default the residual backbone.
        variance: Of the noise that ``ddpm`` adds in a step: that of the ``posterior``, exact where x0 is a point, or
            ``beta``, exact where x0 is N(0, 1) (Ho et al., 2020, section 3.2). Of N(0, 1), T = 5 steps and a perfect
            network give a standard deviation of 0.67 with the former, 0.90 with the latter.
    """

    betas: Tensor
    alpha_bars: Tensor
    time_table: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        skill_dim: int,
        hidden_dim: int = 256,
        blocks: int = 4,
        dropout: float = 0.1,
        diffusion_steps: int = 5,
        beta_min: float = 0.1,
        beta_max: float = 10.0,
        time_dim: int = 16,
        sampler: Sampler = "ddpm",
        clip: bool = True,
        net: nn.Module | None = None,
        variance: Variance = "posterior",
    ) -> None:
        super().__init__(action_dim)
        self.diffusion_steps, self.sampler = diffusion_steps, sampler
        self.clip, self.variance = clip, variance
        width = action_dim + time_dim + skill_dim + observation_dim
        self.net = net or ResidualMLP(width, action_dim, hidden_dim, blocks, dropout)
        betas = vp_betas(diffusion_steps, beta_min, beta_max)
        self.register_buffer("betas", betas.float())
        self.register_buffer("alpha_bars", torch.cumprod(1.0 - betas, dim=0).float())
        times = torch.arange(1, diffusion_steps + 1)
        self.register_buffer("time_table", sinusoidal_embedding(times, time_dim))

    @classmethod
    def build(cls, settings: Any) -> Self:
        """As `Decoder.build`."""
        h = settings
        schedule = (h.diffusion_steps, h.beta_min, h.beta_max, h.time_dim)
        return cls(*_backbone(h), *schedule, h.sampler, h.clip_actions)

    def predict_noise(self, noisy: Tensor, t: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """epsilon_psi(x_t, t, z, s): noisy (B, A), t (B,) in 0..T-1, observations (B, O), skills (B, D) to (B, A)."""
        return self.net(torch.cat([noisy, self.time_table[t], skills, observations], dim=-1))

    def loss(self, actions: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """Squared error of the predicted noise (equation 5), one t and one epsilon a row; see `Decoder.loss`."""
        t = torch.randint(self.diffusion_steps, (len(actions),), device=actions.device)
        noise = torch.randn_like(actions)
        alpha_bar = self.alpha_bars[t, None]  # (B, 1)
        noisy = alpha_bar.sqrt() * actions + (1.0 - alpha_bar).sqrt() * noise
        return (self.predict_noise(noisy, t, observations, skills) - noise).square()

    @property
    def draws(self) -> int:
        """Number of Gaussians that one action takes: the first, and for ``ddpm`` one after every step but the last."""
        return self.diffusion_steps if self.sampler == "ddpm" else 1

    def denoise(self, noise: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """T steps from Gaussian noise to actions (section 4.4), in [-1, 1] when ``clip`` is set."""
        draws = iter(noise)
        x = next(draws)
        for i in reversed(range(self.diffusion_steps)):
            t = torch.full((x.shape[0],), i, device=x.device)  # `len` would fix the batch when exporting
            predicted = self.predict_noise(x, t, observations, skills)
            alpha_bar = self.alpha_bars[i]
            x0 = (x - (1.0 - alpha_bar).sqrt() * predicted) / alpha_bar.sqrt()
            if self.clip:
                x0 = x0.clamp(-1.0, 1.0)
            if i == 0:
                return x0
            previous = self.alpha_bars[i - 1]
            if self.sampler == "ddim":
                # The noise that leads to the clipped x0, so that the path ends there.
                predicted = (x - alpha_bar.sqrt() * x0) / (1.0 - alpha_bar).sqrt()
                x = previous.sqrt() * x0 + (1.0 - previous).sqrt() * predicted
                continue
            beta = self.betas[i]
            mean = (previous.sqrt() * beta * x0 + (1.0 - beta).sqrt() * (1.0 - previous) * x) / (1.0 - alpha_bar)
            variance = beta if self.variance == "beta" else beta * (1.0 - previous) / (1.0 - alpha_bar)
            x = mean + variance.sqrt() * next(draws)
        raise AssertionError("unreachable: the loop returns at i = 0")


class MLPDecoder(Decoder):
    """The diffusion decoder's backbone as a plain regressor, for the architecture ablation (section 5.4).

    Args:
        observation_dim: O.
        action_dim: A.
        skill_dim: D.
        hidden_dim: Width of the backbone.
        blocks: Residual blocks.
        dropout: Rate inside the blocks.
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        skill_dim: int,
        hidden_dim: int = 256,
        blocks: int = 4,
        dropout: float = 0.1,
    ) -> None:
        super().__init__(action_dim)
        self.net = ResidualMLP(skill_dim + observation_dim, action_dim, hidden_dim, blocks, dropout)

    @classmethod
    def build(cls, settings: Any) -> Self:
        """As `Decoder.build`."""
        return cls(*_backbone(settings))

    def loss(self, actions: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """Squared error of the action (equation 13, first term); see `Decoder.loss`."""
        return (self.sample(observations, skills) - actions).square()

    def denoise(self, noise: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """Predict actions (B, A); ``noise`` (0, B, A) is empty."""
        return self.net(torch.cat([skills, observations], dim=-1)).tanh()


def _backbone(settings: Any) -> tuple[int, int, int, int, int, float]:
    """The arguments that both decoders have in common, from the settings of a `SkillModule`."""
    h = settings
    return h.observation_dim, h.action_dim, h.skill_dim, h.hidden_dim, h.decoder_blocks, h.dropout
