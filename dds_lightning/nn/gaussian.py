"""The continuous skill space that the paper compares against: a Gaussian bottleneck in the manner of beta-VAE."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

import dds_lightning.losses as losses


class GaussianSkill(NamedTuple):
    """A batch of continuous skills."""

    vectors: Tensor
    """(B, D) reparameterised draw while training, the mean otherwise."""
    mean: Tensor
    """(B, D)."""
    kl: Tensor
    """Scalar KL divergence from N(0, I); not yet weighted."""


class GaussianBottleneck(nn.Module):
    """Split (B, 2 D) encoder outputs into mean and log-variance and draw from them."""

    def forward(self, encodings: Tensor) -> GaussianSkill:
        """Draw skills from encodings (B, 2 D)."""
        mean, log_variance = encodings.float().chunk(2, dim=-1)
        log_variance = log_variance.clamp(-10.0, 4.0)  # keeps exp() finite in the first steps
        vectors = mean
        if self.training:
            vectors = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        return GaussianSkill(vectors, mean, losses.gaussian_kl(mean, log_variance))
