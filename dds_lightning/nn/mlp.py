"""Multi-layer perceptrons, one or an ensemble of them at once, with optional layer norm and Fourier features."""

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from dds_lightning.nn.dropout import dropout


def in_full_precision(x: Tensor) -> AbstractContextManager[Any]:
    """Inside a training in bfloat16, leave it for an operation on `x` whose last digits count.

    A value of 60 would be a multiple of 0.25, and a phase of many turns would be noise.
    """
    lowered = torch.is_autocast_enabled(x.device.type)  # asked, because an export would keep the context
    return torch.autocast(x.device.type, enabled=False) if lowered else nullcontext()


class EnsembleLinear(nn.Module):
    """N independent linear layers as one batched product: (N, B, I) to (N, B, J)."""

    def __init__(self, members: int, input_dim: int, output_dim: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(input_dim)  # the start of nn.Linear
        self.weight = nn.Parameter(torch.empty(members, input_dim, output_dim).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(members, 1, output_dim).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Apply member n to x[n]."""
        if self.weight.shape[-1] == 1:  # one column as a batched product: 140 us for 256 rows of 256, as a sum 40 us
            return (x * self.weight.mT).sum(dim=-1, keepdim=True) + self.bias
        return torch.baddbmm(self.bias, x, self.weight)


class FourierFeatures(nn.Module):
    """Random sines and cosines of the input beside the input itself, so that a small network sees sharp edges.

    A plain ReLU network of two layers smooths a value function across a thin wall (Tancik et al., 2020). The
    frequencies are drawn once and kept as a buffer.

    Args:
        input_dim: Width of the input.
        features: Number of frequencies F; the output has input_dim + 2 F dimensions.
        scale: Standard deviation of the frequencies, in cycles per unit of normalised input times 2 pi.
        seen: How many leading numbers of the input the frequencies see; 0 for all of them.
    """

    SETTINGS: ClassVar = ("fourier_features", "fourier_scale", "fourier_seen")
    """What a module calls the settings of its layer of this kind."""
    frequencies: Tensor

    def __init__(self, input_dim: int, features: int, scale: float, seen: int = 0) -> None:
        super().__init__()
        self.register_buffer("frequencies", scale * torch.randn(seen or input_dim, features))
        self.output_dim = input_dim + 2 * features

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., I) to (..., I + 2 F)."""
        with in_full_precision(x):
            phase = x[..., : len(self.frequencies)] @ self.frequencies
        return torch.cat([x, phase.sin(), phase.cos()], dim=-1)


class MLP(nn.Sequential):
    """Linear layers with ReLU between them; ``members`` > 0 makes an ensemble with a leading axis.

    Args:
        input_dim: Width of the input.
        output_dim: Width of the output.
        hidden_dims: Widths of the hidden layers (the paper: 256, 256).
        layer_norm: Normalise before each ReLU.
        members: 0 for a plain network (..., I) to (..., J); N for an ensemble (N, B, I) to (N, B, J).
        dropout: Share of hidden numbers that are left out in a training step.
    """

    def __init__(
        self,
        input_dim: int,
        output_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        layer_norm: bool = False,
        members: int = 0,
        dropout: float = 0.0,
    ) -> None:
        def linear(i: int, j: int) -> nn.Module:
            return EnsembleLinear(members, i, j) if members else nn.Linear(i, j)

        layers: list[nn.Module] = []
        for hidden_dim in hidden_dims:
            layers.append(linear(input_dim, hidden_dim))
            if layer_norm:
                layers.append(nn.LayerNorm(hidden_dim))
            layers.append(nn.ReLU())
            input_dim = hidden_dim
        super().__init__(*layers, linear(input_dim, output_dim))
        self.dropout = dropout

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layers."""
        *hidden, last = self
        for layer in hidden:
            if isinstance(layer, nn.ReLU):  # no layer of its own, so that names in checkpoints stay
                x = dropout(x, self.dropout, self.training)  # before it: the same numbers, and one mask less to keep
            x = layer(x)
        with in_full_precision(x):
            out: Tensor = last(x.to(next(last.parameters()).dtype))
        return out
