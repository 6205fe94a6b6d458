"""What turns a skill and a state into actions: the protocol of every decoder (section 4.1)."""

from typing import Any, Self

import torch
from torch import Tensor, nn

from dds_lightning.nn.draws import normal


class Decoder(nn.Module):
    """A model of actions in [-1, 1], given normalised observations and skill vectors.

    A new one is a subclass with `build`, `loss` and `denoise`, `draws` where it is random, and a row in
    `skill.DECODERS`.

    Args:
        action_dim: A.
    """

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        self.action_dim = action_dim

    @classmethod
    def build(cls, settings: Any) -> Self:
        """Build it from the settings of a `SkillModule`."""
        raise NotImplementedError

    def loss(self, actions: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """What training minimises.

        Args:
            actions: (B, A) in [-1, 1].
            observations: (B, O) normalised.
            skills: (B, D).

        Returns:
            (B, A), not yet reduced: the sum over H and A stands beside the terms of the bottleneck.
        """
        raise NotImplementedError

    @property
    def draws(self) -> int:
        """N, Gaussians that one action takes; 0 for a deterministic decoder."""
        return 0

    def denoise(self, noise: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """`sample` with given noise: a function of its arguments, which is also what gets exported.

        Args:
            noise: (`draws`, B, A), the noise scale included.
            observations: (B, O) normalised.
            skills: (B, D).

        Returns:
            (B, A).
        """
        raise NotImplementedError

    def sample(
        self,
        observations: Tensor,
        skills: Tensor,
        noise_scale: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw actions (section 4.4).

        Args:
            observations: (B, O) normalised.
            skills: (B, D).
            noise_scale: Factor on every Gaussian that is drawn; 1 is the model's distribution, less is closer to its
                mode, 0 is deterministic.
            generator: Random stream; the global one by default.

        Returns:
            (B, A).
        """
        size = (len(observations), self.action_dim)
        drawn = [normal(size, observations.device, generator) for _ in range(self.draws)]
        noise = torch.stack(drawn) if drawn else observations.new_zeros(0, *size)
        return self.denoise(noise_scale * noise, observations, skills)
