"""Decision Diffuser: plan states by diffusion for a wanted return, act by inverse dynamics (Ajay et al., 2022).

```
 x = (s_1, ..., s_H), s_1 the present state, y the return to go scaled to [0, 1]
 L = E[ || eps - eps_theta(x_k, (1 - b) y + b none, k) ||^2 ] + E[ || a - f(s, s') ||^2 ],  b ~ Bernoulli(p)  equation 8
 eps_hat = eps(x_k, none, k) + w (eps(x_k, y, k) - eps(x_k, none, k))                                        equation 6
 a = f(s_1, s_2)                                                                                             equation 5
```

The present state is given and not diffused, as in the authors' code. Departures: a plan is diffused as its differences
from the present state, each divided by its spread in the data, so that the next state, which alone decides the action,
is as fine as the last; the temporal U-Net is our decoder's network over the whole plan; T and the noise follow our
decoder's schedule, in place of 200 steps; plans lie within an episode (theirs reach beyond its end, filled with zeros);
and a termination costs nothing (theirs 100 on Hopper, of returns of 400).
"""

from __future__ import annotations

import itertools
from typing import ClassVar, Literal

import torch
from torch import Tensor

from dds_lightning.baselines.critics import Batch
from dds_lightning.module import StageModule
from dds_lightning.nn.diffusion import DiffusionDecoder
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import MIN_STD, ActionBox

BATCHES = 20
"""Batches in which the spread of plans is measured."""


class PlanDiffusion(DiffusionDecoder):
    """A diffusion model of plans with guidance; its skills (B, 3) are return, whether it is told, and the weight w."""

    def predict_noise(self, noisy: Tensor, t: Tensor, observations: Tensor, skills: Tensor) -> Tensor:
        """Equation 6 where a weight is given: skills (B, 3); with (B, 2) the network alone, to learn by."""
        wanted = skills[:, :2]
        told = super().predict_noise(noisy, t, observations, wanted)
        if skills.shape[1] == 2:
            return told
        free = super().predict_noise(noisy, t, observations, torch.zeros_like(wanted))
        return free + skills[:, 2:] * (told - free)


class DecisionDiffuser(StageModule):
    """Plans of H states for a wanted return.

    A training batch is that of a `SequenceDataModule`.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        horizon: H, at least 2; linked from the data. The authors take 100.
        hidden_dim: Width of the plan network and of the inverse dynamics.
        blocks: Residual blocks of the former.
        diffusion_steps: T.
        untold: p, share of plans that learn without their return.
        guidance: w.
        target: Return that is asked for, in the range of those that plans of the data start with: 0 the least, 1 the
            greatest.
        noise_scale: Factor on the noise when planning (the authors' low temperature).
        lr: Adam's learning rate.
        lr_schedule: ``constant``, or ``cosine`` decay to zero at ``max_steps``.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "dd"
    PARTS: ClassVar = {"plans": ("plans",), "inverse": ("inverse",)}
    SHAPE = ("horizon", "hidden_dim", "blocks", "diffusion_steps")
    OF_DATA = ("return_range", "plan_spread")
    PREDICTION = "action"
    return_range: Tensor
    plan_spread: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        horizon: int = 20,
        hidden_dim: int = 256,
        blocks: int = 3,
        diffusion_steps: int = 20,
        untold: float = 0.25,
        guidance: float = 1.2,
        target: float = 0.9,
        noise_scale: float = 0.5,
        lr: float = 2e-4,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("horizon", horizon >= 2, "at least 2: the present state and the next"),
            ("untold", 0 <= untold < 1, "in [0, 1)"),
            ("noise_scale", noise_scale >= 0, "0 or more"),
        ]
        self._refuse(rules)
        self._make_embedding(self.hparams)
        self.action_box = ActionBox(action_dim)
        self.plans = PlanDiffusion(
            observation_dim,
            (horizon - 1) * observation_dim,
            2,
            hidden_dim,
            blocks,
            dropout=0.0,
            diffusion_steps=diffusion_steps,
            clip=False,
        )
        self.inverse = MLP(2 * observation_dim, action_dim, [hidden_dim, hidden_dim])
        self.register_buffer("return_range", torch.tensor([0.0, 1.0]))
        self.register_buffer("plan_spread", torch.ones(horizon - 1, observation_dim))
        self._begin(init_from)

    def on_fit_start(self) -> None:
        """Use the data's statistics, unless a checkpoint provided them."""
        fitted = bool(self.normaliser.fitted)
        self.fit_units()
        if not fitted or self.init_from is not None:
            found = self.data_statistics(["return_to_go_range"], "use a SequenceDataModule")
            self.return_range.copy_(found["return_to_go_range"])
            batches = itertools.islice(self.training_batches(), BATCHES)
            ahead = torch.cat([self.ahead(self.normaliser(batch["observations"])) for batch in batches])
            self.plan_spread.copy_(ahead.square().mean(dim=0).sqrt().clamp_min(MIN_STD))

    @staticmethod
    def ahead(states: Tensor) -> Tensor:
        """Where a plan leads from its first state: normalised states (B, H, O) to differences (B, H - 1, O)."""
        return states[:, 1:] - states[:, :1]

    def scaled(self, returns: Tensor) -> Tensor:
        """Returns to go in [0, 1], where 1 is the greatest that a plan of the data starts with."""
        low, high = self.return_range
        return (returns - low) / (high - low).clamp_min(1e-6)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Equation 8, each term a mean over rows and widths, halved as in the authors' code."""
        x = self.normaliser(batch["observations"])  # (B, H, O)
        told = (torch.rand(len(x), 1, device=x.device) >= self.hparams.untold).float()
        wanted = torch.cat([self.scaled(batch["returns"][:, :1]) * told, told], dim=-1)
        plan = (self.ahead(x) / self.plan_spread).flatten(1)
        denoising = 0.5 * self.plans.loss(plan, x[:, 0], wanted).mean()
        taken = self.action_box.to_unit(batch["actions"][:, :-1])  # (B, H - 1, A)
        inverse = 0.5 * (self._between(x[:, :-1], x[:, 1:]) - taken).square().mean()
        return denoising + inverse, {"denoising": denoising.detach(), "inverse": inverse.detach()}

    def _between(self, states: Tensor, after: Tensor) -> Tensor:
        """Unit actions (..., A) that lead from states (..., O) to the next."""
        return self.inverse(torch.cat([states, after], dim=-1))

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        total, self.terms = self.loss(batch)
        self.log_training(total)
        return total

    def evaluate(self, batch: Batch, stage: str) -> None:
        """Log the losses on held-out episodes."""
        total, info = self.loss(batch)
        named = {f"{stage}/{name}": value for name, value in {"loss": total, **info}.items()}
        self.log_dict(named, batch_size=len(batch["actions"]), sync_dist=True)

    def plan(self, observations: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The next H - 1 states (B, H - 1, O), normalised, from observations (B, O)."""
        h, x = self.hparams, self.normaliser(observations)
        asked = torch.tensor([h.target, 1.0, h.guidance], device=x.device).expand(len(x), 3)
        drawn = self.plans.sample(x, asked, h.noise_scale, generator).view(len(x), h.horizon - 1, -1)
        return x[:, None] + self.plan_spread * drawn

    def act(self, observations: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Actions (B, A) for observations (B, O)."""
        planned = self.plan(observations, generator)
        return self.action_box.from_unit(self._between(self.normaliser(observations), planned[:, 0]))

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Actions (B, A) for the first states of a batch."""
        return self.act(batch["observations"][:, 0])
