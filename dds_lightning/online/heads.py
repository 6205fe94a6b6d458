"""Policies of the three action spaces: a choice among K codes, or numbers in a box."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from dds_lightning.nn.draws import normal
from dds_lightning.nn.mlp import MLP

Selection = Literal["sample", "greedy"]
LOG_STD = (-20.0, 2.0)
"""Bounds of the log standard deviation, stable-baselines3's."""


class Expected(NamedTuple):
    """What the policy expects in a state."""

    q: Tensor
    """(B,) the critics' value of its choice."""
    log_pi: Tensor
    """(B,) log-likelihood of its choice, minus the entropy where the expectation is exact."""


class CodeHead(nn.Module):
    """A categorical policy over K codes; its expectations are sums over all codes, not samples.

    Args:
        features: Width F of the input.
        codes: K.
        hidden_dims: Widths of the hidden layers.
    """

    outputs: int
    takes = 0
    """Numbers of an action that the critic reads beside the features: it has one output for each code instead."""

    def __init__(self, features: int, codes: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.outputs = codes
        self.net = MLP(features, codes, hidden_dims)

    def expect(self, features: Tensor, support: Tensor, critic: Callable[[Tensor], Tensor]) -> Expected:
        """Expected value and negative entropy: ``sum_k pi(k|s) Q(s, k)``, ``sum_k pi(k|s) log pi(k|s)``.

        Args:
            features: (B, F).
            support: (K,) whether a code may be chosen.
            critic: (N, B, F) to (B, K).
        """
        log_pi = self.logits(features, support).log_softmax(dim=-1)
        pi = log_pi.exp()  # (B, K)
        log_pi = log_pi.masked_fill(~support, 0.0)  # 0 log 0 is 0
        return Expected((pi * critic(features)).sum(dim=-1), (pi * log_pi).sum(dim=-1))

    @staticmethod
    def entropy_unit(support: Tensor) -> Tensor:
        """The most that the entropy can be, the log of how many codes of (K,) may be chosen: ()."""
        return support.sum().double().log()

    def logits(self, features: Tensor, support: Tensor) -> Tensor:
        """Unnormalised log pi(k | s): (B, F) to (B, K)."""
        return self.net(features).masked_fill(~support, -torch.inf)

    @staticmethod
    def of_taken(values: Tensor, actions: Tensor) -> Tensor:
        """Values (N, B, K) of the codes (B,) that were taken: (N, B)."""
        return values.gather(-1, actions.expand(len(values), -1).unsqueeze(-1)).squeeze(-1)


class BoxHead(nn.Module):
    """A squashed Gaussian policy over the cube [-1, 1]^D; its expectations are one reparameterised sample.

    Args:
        features: Width F of the input.
        numbers: D.
        hidden_dims: Widths of the hidden layers.
    """

    outputs = 1

    def __init__(self, features: int, numbers: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.takes = numbers
        self.net = MLP(features, 2 * numbers, hidden_dims)

    def expect(self, features: Tensor, support: Tensor, critic: Callable[[Tensor], Tensor]) -> Expected:
        """Value and log-likelihood of a sample; `support` is not used.

        Args:
            features: (B, F).
            support: Not used.
            critic: (B, F + D) to (B, 1).
        """
        action, log_pi = self.sample(features)
        return Expected(critic(torch.cat([features, action], dim=-1)).squeeze(-1), log_pi)

    def sample(self, features: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Draw actions (B, D) and their log-likelihood (B,).

        The density of ``a = tanh(u)`` is that of u divided by ``1 - a^2``, whose logarithm is written such that it
        stays finite at the walls of the cube.
        """
        mean, std = self.moments(features)
        noise = normal(mean.shape, mean.device, generator)
        u = mean + std * noise
        log_normal = -0.5 * noise.square() - std.log() - 0.5 * math.log(2 * math.pi)
        log_slope = 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))
        return u.tanh(), (log_normal - log_slope).sum(dim=-1)

    def entropy_unit(self, support: Tensor) -> Tensor:
        """What SAC adjusts the temperature for, -D: (); `support` is not used."""
        return torch.tensor(-float(self.takes), device=support.device)

    def moments(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation before squashing, (B, D) each."""
        mean, log_std = self.net(features).chunk(2, dim=-1)
        return mean, log_std.clamp(*LOG_STD).exp()

    @staticmethod
    def of_taken(values: Tensor, actions: Tensor) -> Tensor:
        """Values (N, B, 1) of the actions that were taken: (N, B)."""
        return values.squeeze(-1)
