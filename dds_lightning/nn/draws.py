"""Random numbers from a stream that may be on another device than the networks: a simulator's is on the processor."""

from collections.abc import Sequence

import torch
from torch import Tensor


def normal(size: Sequence[int], device: torch.device, generator: torch.Generator | None) -> Tensor:
    """Standard normal numbers of a size, on a device."""
    at = device if generator is None else generator.device
    return torch.randn(tuple(size), device=at, generator=generator).to(device)


def categorical(probabilities: Tensor, generator: torch.Generator | None) -> Tensor:
    """One index for each row: (B, K) to (B,)."""
    at = probabilities.device if generator is None else generator.device
    return torch.multinomial(probabilities.to(at), 1, generator=generator).squeeze(-1).to(probabilities.device)
