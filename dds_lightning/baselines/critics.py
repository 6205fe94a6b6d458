"""What the baselines with a critic share: twin Q networks over continuous choices, and how they train."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.func import functional_call

import dds_lightning.losses as losses
from dds_lightning.module import StageModule
from dds_lightning.nn.diffusion import DiffusionDecoder
from dds_lightning.nn.mlp import MLP

Batch = dict[str, Tensor]
Network = TypeVar("Network", bound=nn.Module)
Loss = tuple[Tensor, dict[str, Tensor]]  # a scalar to minimise, and what to log


def with_target(make: Callable[[], Network]) -> tuple[Network, Network]:
    """A network, and one with the same weights that no gradient moves."""
    network, target = make(), make()
    target.load_state_dict(network.state_dict())
    target.requires_grad_(False)
    return network, target


class TwinCritic(nn.Module):
    """Two Q networks over state and choice, and their slowly moving targets.

    Args:
        state_dim: Width F of an embedded observation.
        choice_dim: Width C of an action in [-1, 1] or a skill.
        hidden_dims: Widths of the hidden layers.
    """

    def __init__(self, state_dim: int, choice_dim: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.online, self.target = with_target(lambda: MLP(state_dim + choice_dim, 1, hidden_dims, members=2))

    def both(self, states: Tensor, choices: Tensor) -> Tensor:
        """Values (2, B) of choices (B, C) in embedded states (B, F)."""
        return self.online(_pair(states, choices)).squeeze(-1)

    def targets(self, states: Tensor, choices: Tensor) -> Tensor:
        """As `both`, of the targets."""
        return self.target(_pair(states, choices)).squeeze(-1)

    def least(self, states: Tensor, choices: Tensor) -> Tensor:
        """The smaller target value, (B,)."""
        return self.targets(states, choices).amin(dim=0)

    def judge(self, states: Tensor, choices: Tensor) -> Tensor:
        """As `both`; gradients reach the choices and not the critics."""
        weights = {name: value.detach() for name, value in self.online.named_parameters()}
        return functional_call(self.online, weights, _pair(states, choices)).squeeze(-1)


def _pair(states: Tensor, choices: Tensor) -> Tensor:
    both = torch.cat([states, choices], dim=-1)
    return both.expand(2, *both.shape)


def implicit(
    critic: TwinCritic, value: nn.Module, x: Tensor, after: Tensor, batch: Batch, chosen: Tensor, tau: float
) -> dict[str, Tensor]:
    """IQL's two losses for value and critic (Kostrikov et al., 2021, equations 5 and 6).

    ```
    L_V = E[ |tau - 1(u < 0)| u^2 ],  u = min target Q(s, a) - V(s)
    L_Q = E[ (r + gamma (1 - done) V(s') - Q(s, a))^2 ], summed over both Q
    ```

    Args:
        critic: Q.
        value: V, (B, F) to (B, 1).
        x: (B, F) embedded states.
        after: (B, F) embedded next states.
        batch: Rewards, discounts and dones, (B,) each.
        chosen: (B, C) the data's choices.
        tau: Expectile.

    Returns:
        Both losses, and the advantage ``u`` (B,) without gradient.
    """
    with torch.no_grad():
        q = critic.least(x, chosen)
        target = losses.td_target(batch["rewards"], batch["discounts"], batch["dones"], value(after).squeeze(-1))
    v = value(x).squeeze(-1)
    return {
        "value_loss": losses.expectile(q - v, tau),
        "q_loss": losses.td(critic.both(x, chosen), target),
        "advantages": (q - v).detach(),
    }


def draw(
    decoder: DiffusionDecoder, states: Tensor, count: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Draw `count` choices in each state from a diffusion model without skills.

    Returns:
        The states, (B count, F), each repeated, and the choices, (B count, C).
    """
    wide = states.repeat_interleave(count, dim=0)
    return wide, decoder.sample(wide, wide[:, :0], generator=generator)


def proposals(
    decoder: DiffusionDecoder, critic: TwinCritic, states: Tensor, count: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Draw `count` choices in each state, as `draw`, and judge them.

    Returns:
        The choices, (B, count, C), and their smaller target values, (B, count).
    """
    wide, choices = draw(decoder, states, count, generator)
    return choices.view(len(states), count, -1), critic.least(wide, choices).view(len(states), count)


def take(options: Tensor, index: Tensor) -> Tensor:
    """The option (B, C) at `index` (B,) of options (B, N, C)."""
    return options[torch.arange(len(options), device=options.device), index]


class CriticModule(StageModule):
    """A stage that minimises a sum of losses by one Adam and moves targets after each step.

    A subclass has `loss`, `act` or `choose`, and says in `followers` which networks follow which, and how fast.
    """

    def loss(self, batch: Batch) -> Loss:
        """The sum of the losses that learn in this step, and its terms, detached."""
        raise NotImplementedError

    def followers(self, step: int) -> list[tuple[nn.Module, nn.Module, float]]:
        """Targets, what they follow, and the rate at which they do after optimiser step `step`."""
        raise NotImplementedError

    def _sum(self, terms: dict[str, Tensor], more: dict[str, Tensor]) -> Loss:
        total = torch.stack(list(terms.values())).sum()
        return total, {name: value.detach() for name, value in {**terms, **more}.items()}

    def on_fit_start(self) -> None:
        """Use the data's statistics, unless a checkpoint provided them."""
        self.fit_units()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        total, self.terms = self.loss(batch)
        self.log_training(total)
        return total

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        """Move the targets."""
        for target, online, rate in self.followers(step):
            moved: list[Tensor] = list(target.parameters())
            torch._foreach_lerp_(moved, list(online.parameters()), rate)

    def evaluate(self, batch: Batch, stage: str) -> None:
        """Log the losses on held-out episodes."""
        total, info = self.loss(batch)
        named = {f"{stage}/{name}": value for name, value in {"loss": total, **info}.items()}
        self.log_dict(named, batch_size=len(batch["actions"]), sync_dist=True)
