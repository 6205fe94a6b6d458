"""What networks see of an observation: normalised numbers, and Fourier features of them where a wall is thin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from dds_lightning.nn.mlp import FourierFeatures
from dds_lightning.nn.normaliser import Normaliser

FOURIER = ("fourier_features", "fourier_scale", "fourier_seen")
"""Settings of a module whose networks see Fourier features."""


class EmbeddingMixin:
    """Of a module that embeds observations (..., O) as (..., F), the same for all of its networks."""

    normaliser: Normaliser
    features: nn.Module
    embedding_dim: int

    def _make_embedding(self, h: Mapping[str, Any]) -> int:
        """Make `normaliser` and `features`.

        Args:
            h: The module's settings: `observation_dim`, and those of `FOURIER` where it has them.

        Returns:
            F.
        """
        self.embedding_dim = width = h["observation_dim"]
        self.normaliser, self.features = Normaliser(width), nn.Identity()
        count, scale, seen = (h.get(name, 0) for name in FOURIER)
        if count:
            self.features = FourierFeatures(width, count, scale, seen)
            self.embedding_dim = self.features.output_dim
        return self.embedding_dim

    def embed(self, observations: Tensor) -> Tensor:
        """Normalise observations (..., O) and append Fourier features: (..., F)."""
        embedded: Tensor = self.features(self.normaliser(observations))
        return embedded
