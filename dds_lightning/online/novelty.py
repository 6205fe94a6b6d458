"""Optimistic rewards for prior data whose rewards are not known (ExPLORe, SUPE): learned reward plus novelty.

```
 (s, x) ─┬─► reward, termination     learned from what was collected
         ├─► prediction ─┐
         └─► random net ─┴─ error    large where nothing was collected yet: random network distillation
```
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss

from dds_lightning.nn.mlp import MLP

CODE_DIM = 32
"""Width of the random network's output."""


class Novelty(nn.Module):
    """Rewards, terminations and novelty of transitions.

    Args:
        input_dim: Width of a state's features and a choice together.
        hidden_dims: Widths of the hidden layers.
    """

    first: Tensor

    def __init__(self, input_dim: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.outcome = MLP(input_dim, 2, hidden_dims)  # reward, logit of a termination
        self.predictor = MLP(input_dim, CODE_DIM, hidden_dims)
        self.random = MLP(input_dim, CODE_DIM, hidden_dims)
        self.random.requires_grad_(False)
        self.register_buffer("first", torch.zeros(()))  # mean error before anything was learnt

    def error(self, x: Tensor) -> Tensor:
        """Squared error of the prediction: (B, I) to (B,)."""
        return (self.predictor(x) - self.random(x)).square().mean(dim=-1)

    def loss(self, batch: Mapping[str, Tensor], x: Tensor) -> Tensor:
        """Loss of all three on the transitions that were collected here.

        Args:
            batch: ``known`` (B,) says which; ``rewards`` and ``dones`` (B,).
            x: (B, I) states and choices.
        """
        x, rewards, dones = (column[batch["known"]] for column in (x, batch["rewards"], batch["dones"]))
        error = self.error(x).mean()
        if self.training and not bool(self.first):
            self.first.copy_(error.detach())
        reward, end = self.outcome(x).unbind(dim=-1)
        return error + mse_loss(reward, rewards) + binary_cross_entropy_with_logits(end, dones)

    @torch.no_grad()
    def label(self, batch: Mapping[str, Tensor], x: Tensor, optimism: float) -> tuple[Tensor, Tensor]:
        """Rewards and terminations (B,), optimistic ones where the data do not say them; arguments as of `loss`.

        The novelty is in units of the error at the beginning: 1 where nothing was learnt, 0 where everything was. Call
        `loss` on the first batch before, which finds that unit.
        """
        reward, end = self.outcome(x).unbind(dim=-1)
        bright = reward + optimism * self.error(x) / self.first.clamp_min(1e-12)
        known = batch["known"]
        return torch.where(known, batch["rewards"], bright), torch.where(known, batch["dones"], (end > 0).float())
