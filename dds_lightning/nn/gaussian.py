"""The continuous skill space that the paper compares against: a Gaussian bottleneck in the manner of beta-VAE."""

from typing import Any, Self

import torch
from torch import Tensor

import dds_lightning.losses as losses
from dds_lightning.nn.bottleneck import Bottleneck, Skill, Term


class GaussianBottleneck(Bottleneck):
    """Split (B, 2 D) encoder outputs into mean and log-variance and draw skills from them.

    Args:
        kl_weight: Weight of the KL divergence from N(0, I).
    """

    widths = 2

    def __init__(self, kl_weight: float = 0.01) -> None:
        super().__init__()
        self.kl_weight = kl_weight

    @classmethod
    def build(cls, settings: Any) -> Self:
        """As `Bottleneck.build`."""
        return cls(settings.kl_weight)

    def forward(self, encodings: Tensor) -> Skill:
        """Skills of encodings (B, 2 D): a reparameterised draw while training, the mean otherwise."""
        mean, log_variance = encodings.float().chunk(2, dim=-1)
        log_variance = log_variance.clamp(-10.0, 4.0)  # keeps exp() finite in the first steps
        vectors = mean
        if self.training:
            vectors = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        return Skill(vectors, None, {"kl": Term(losses.gaussian_kl(mean, log_variance), self.kl_weight)})
