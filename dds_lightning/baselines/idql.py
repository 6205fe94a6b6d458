"""IDQL: an IQL critic re-weights what a diffusion model of the data's actions proposes (Hansen-Estruch et al., 2023).

```
 L_V = E[ |tau - 1(u < 0)| u^2 ],  u = min target Q(s, a) - V(s)              equation 3, with the expectile
 L_Q = E[ (r + gamma V(s') - Q(s, a))^2 ]                                     equation 4
 L_mu = E[ || eps - eps_mu(sqrt(abar_t) a + sqrt(1 - abar_t) eps, t, s) ||^2 ]   equation 9
 a ~ w_i,  a_i ~ mu(. | s),  w_i ~ tau if Q(s, a_i) > V(s) else 1 - tau       algorithm 2
```

The authors' evaluation takes the best of the N samples (`selection: argmax`); the weights above are the paper's policy.
Samples are drawn with noise of variance beta_t, as theirs; at each step the predicted action is kept in the box, in
their code the noisy one. `lr_schedule` is that of all networks, in their code of the diffusion model alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from dds_lightning.baselines.critics import (
    Batch,
    CriticModule,
    Loss,
    TwinCritic,
    implicit,
    proposals,
    take,
    with_target,
)
from dds_lightning.nn.diffusion import DiffusionDecoder
from dds_lightning.nn.draws import categorical
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import ActionBox


class IDQL(CriticModule):
    """Implicit diffusion Q-learning over single steps.

    Defaults are the authors': networks, learning rate, N and both moving averages of their D4RL runs.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of V and Q.
        tau: Expectile; the authors take 0.7, and 0.9 on AntMaze.
        samples: N, actions proposed in each state.
        selection: How one of them is taken: ``argmax`` of Q, or ``weighted`` at random.
        hidden_dim: Width of the diffusion model.
        blocks: Its residual blocks.
        dropout: Rate inside these.
        diffusion_steps: T.
        target_ema: Rate of the target critic.
        actor_ema: Rate of the diffusion model that acts.
        lr: Adam's learning rate.
        lr_schedule: ``constant``, or ``cosine`` decay to zero at ``max_steps``.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "idql"
    PARTS: ClassVar = {"critic": ("value", "critic"), "actor": ("actor", "target_actor")}
    SHAPE = ("hidden_dims", "hidden_dim", "blocks", "diffusion_steps", *FOURIER)
    PREDICTION = "action"

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        tau: float = 0.7,
        samples: int = 64,
        selection: Literal["argmax", "weighted"] = "argmax",
        hidden_dim: int = 256,
        blocks: int = 3,
        dropout: float = 0.1,
        diffusion_steps: int = 5,
        target_ema: float = 0.005,
        actor_ema: float = 0.001,
        lr: float = 3e-4,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("tau", 0 < tau < 1, "in (0, 1)"),
            ("samples", samples >= 1, "at least 1"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
            ("actor_ema", 0 < actor_ema <= 1, "in (0, 1]"),
        ]
        self._refuse(rules)
        width = self._make_embedding(self.hparams)
        self.action_box = ActionBox(action_dim)
        self.value = MLP(width, 1, hidden_dims)
        self.critic = TwinCritic(width, action_dim, hidden_dims)
        shape = (width, action_dim, 0, hidden_dim, blocks, dropout, diffusion_steps)
        self.actor, self.target_actor = with_target(lambda: DiffusionDecoder(*shape, variance="beta"))
        self._begin(init_from)

    def loss(self, batch: Batch) -> Loss:
        """Equations 3, 4 and 9, summed; their parameters are disjoint."""
        x, after = self.embed(batch["observations"]), self.embed(batch["next_observations"])
        chosen = self.action_box.to_unit(batch["actions"])
        terms = implicit(self.critic, self.value, x, after, batch, chosen, self.hparams.tau)
        advantages = terms.pop("advantages")
        terms["denoising"] = self.actor.loss(chosen, x, x[:, :0]).sum(dim=-1).mean()
        return self._sum(terms, {"advantage_std": advantages.std(correction=0)})

    def followers(self, step: int) -> list[tuple[nn.Module, nn.Module, float]]:
        """Both averages move after every step."""
        h = self.hparams
        return [
            (self.critic.target, self.critic.online, h.target_ema),
            (self.target_actor, self.actor, h.actor_ema),
        ]

    def weights(self, q: Tensor, v: Tensor) -> Tensor:
        """The implicit policy's weights of proposals, not normalised: tau where Q > V, else 1 - tau."""
        return torch.where(q > v, self.hparams.tau, 1.0 - self.hparams.tau)

    def act(self, observations: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Actions (B, A) for observations (B, O)."""
        h, x = self.hparams, self.embed(observations)
        proposed, q = proposals(self.target_actor, self.critic, x, h.samples, generator)
        index = q.argmax(dim=-1)
        if h.selection == "weighted":
            index = categorical(self.weights(q, self.value(x)), generator)
        return self.action_box.from_unit(take(proposed, index))

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Actions (B, A) for the states of a batch."""
        return self.act(batch["observations"])
