"""OPAL: offline RL over continuous skills (Ajay et al., 2020), here by IQL (Kostrikov et al., 2021).

```
 skills  z ~ q(z | tau), actions ~ pi(a | s, z)      the skill stage with a Gaussian bottleneck (OPAL, equation 1)
 L_V  = E[ |tau - 1(u < 0)| u^2 ],  u = min target Q(s, z) - V(s)                          IQL, equation 5
 L_Q  = E[ (R + gamma (1 - done) V(s') - Q(s, z))^2 ],  s' after the H steps of the skill  IQL, equation 6
 L_pi = -E[ min(exp(beta u), 100) log pi(z | s) ]                                          IQL, equation 7
```

OPAL relabels with draws from q and trains by CQL offline; here z is the mean of q, and the critic is IQL's. Its encoder
keeps close to a prior that depends on the state; ours to N(0, I).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

import dds_lightning.losses as losses
from dds_lightning.baselines.critics import Batch, CriticModule, Loss, TwinCritic, implicit
from dds_lightning.errors import UserError
from dds_lightning.nn.draws import normal
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import Normaliser

LOG_STD = (-5.0, 2.0)
"""Bounds of the policy's log standard deviation, IQL's."""


class LatentModule(CriticModule):
    """A stage that chooses among the continuous skills of a `LatentDataModule`, as a `DDSAgent` expects it."""

    num_skills = 0
    PREDICTION = "skill"
    skills: Normaliser

    def on_fit_start(self) -> None:
        """Take the statistics of observations and skills from the data, unless a checkpoint brought them."""
        if bool(self.normaliser.fitted):
            return
        names = ("observation_mean", "observation_std", "skill_mean", "skill_std")
        mean, std, skill_mean, skill_std = self.data_statistics(names, "fit it with a LatentDataModule").values()
        self.normaliser.fit(mean, std)
        self.skills.fit(skill_mean, skill_std)

    def choose(
        self,
        observations: Tensor,
        selection: Any = "sample",
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Choose a skill for each state.

        Args:
            observations: (B, O).
            selection: ``sample`` or ``greedy``.
            temperature: Not used: skills have no logits.
            generator: Random stream; the global one by default.

        Returns:
            (B, D) skills in the units of the skill model.

        Raises:
            UserError: The selection needs codes.
        """
        if selection not in ("sample", "greedy"):
            raise UserError(f"selection is '{selection}', expected sample or greedy: continuous skills have no codes")
        chosen = self.propose(self.embed(observations), selection == "greedy", generator)
        return self.skills.mean + self.skills.std * chosen

    def propose(self, states: Tensor, greedy: bool, generator: torch.Generator | None) -> Tensor:
        """Normalised skills (B, D) for embedded states (B, F)."""
        raise NotImplementedError

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Greedy skills (B, D) for the states of a batch."""
        return self.choose(batch["observations"], "greedy")


class OPAL(LatentModule):
    """IQL over continuous skills.

    Args:
        observation_dim: O, linked from the data on the command line.
        skill_dim: D, linked from the data.
        hidden_dims: Widths of V, Q and policy.
        tau: Expectile; IQL takes 0.7, and 0.9 on AntMaze.
        beta: Inverse temperature of the regression; IQL takes 3, 10 on AntMaze, 0.5 in the kitchen.
        weight_clip: Upper bound of the regression's weights.
        target_ema: Rate of the target critic.
        lr: Adam's learning rate.
        lr_schedule: ``constant``, or ``cosine`` decay to zero at ``max_steps``.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        skill_hash: Fingerprint of the skill model, linked from the data; null if unknown.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "opal"
    PARTS: ClassVar = {"critic": ("value", "critic"), "actor": ("actor",)}
    SHAPE = ("skill_dim", "hidden_dims", *FOURIER)

    def __init__(
        self,
        observation_dim: int,
        skill_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        tau: float = 0.7,
        beta: float = 3.0,
        weight_clip: float = 100.0,
        target_ema: float = 0.005,
        lr: float = 3e-4,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        skill_hash: str | None = None,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("tau", 0 < tau < 1, "in (0, 1)"),
            ("beta", beta >= 0, "0 or more"),
            ("weight_clip", weight_clip > 0, "positive"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
        ]
        self._refuse(rules)
        width, self.skills = self._make_embedding(self.hparams), Normaliser(skill_dim)
        self.value = MLP(width, 1, hidden_dims)
        self.critic = TwinCritic(width, skill_dim, hidden_dims)
        self.actor = MLP(width, skill_dim, hidden_dims)
        self.actor.register_parameter("log_std", nn.Parameter(torch.zeros(skill_dim)))  # the same in every state
        self._begin(init_from)

    def policy(self, states: Tensor) -> torch.distributions.Normal:
        """pi(z | s) over normalised skills, for embedded states (B, F)."""
        log_std: Any = self.actor.log_std
        return torch.distributions.Normal(self.actor(states), log_std.clamp(*LOG_STD).exp(), validate_args=False)

    def loss(self, batch: Batch) -> Loss:
        """IQL's equations 5 to 7, summed; their parameters are disjoint."""
        x, after = self.embed(batch["observations"]), self.embed(batch["next_observations"])
        z = self.skills(batch["actions"])
        terms = implicit(self.critic, self.value, x, after, batch, z, self.hparams.tau)
        advantages = terms.pop("advantages")
        weights = losses.awr_weights(advantages, self.hparams.beta, self.hparams.weight_clip)
        terms["actor_loss"] = losses.awr(self.policy(x).log_prob(z).sum(dim=-1), weights)
        spread = {"advantage_std": advantages.std(correction=0)}
        return self._sum(terms, {**spread, "effective_sample_size": losses.effective_sample_size(weights)})

    def followers(self, step: int) -> list[tuple[nn.Module, nn.Module, float]]:
        """The target critic moves after every step."""
        return [(self.critic.target, self.critic.online, self.hparams.target_ema)]

    def propose(self, states: Tensor, greedy: bool, generator: torch.Generator | None) -> Tensor:
        """The policy's mean or a draw."""
        policy = self.policy(states)
        if greedy:
            return policy.mean
        noise = normal(policy.mean.shape, states.device, generator)
        return policy.mean + policy.stddev * noise
