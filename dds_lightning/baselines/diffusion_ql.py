"""Diffusion-QL: a diffusion policy that imitates the data and climbs Q (Wang et al., 2022).

```
 L_pi = L_d - eta E[ Q(s, a_0) ] / E[ |Q(s, a_0)| ]      equations 3 and 4; a_0 by T denoising steps with gradient
 L_Q  = E[ (r + gamma (1 - done) min_j target Q_j(s', a') - Q_i(s, a))^2 ],  a' ~ target pi      equation 5
```

As in the authors' code, one of the two Q climbs, drawn by a fair coin, and the other gives the scale of the gradient.
They update Q first, then pi with the new Q; here one Adam takes both steps at once. They also clip gradients, each
network's by a norm of its own (1 to 10 on D4RL); `--trainer.gradient_clip_val` clips the norm of both together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

import dds_lightning.losses as losses
from dds_lightning.baselines.critics import Batch, CriticModule, Loss, TwinCritic, draw, proposals, take, with_target
from dds_lightning.nn.diffusion import DiffusionDecoder
from dds_lightning.nn.draws import categorical
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.normaliser import ActionBox


class DiffusionQL(CriticModule):
    """Diffusion Q-learning over single steps.

    Defaults are the authors' for D4RL, with our decoder's backbone (layer norm, ReLU) in place of theirs (Mish).

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of Q.
        eta: Weight of the Q term; the authors take 1 for locomotion, 0.005 for kitchen, 0.5 to 4.5 for AntMaze.
        backup_samples: Actions of the target policy in the target; with more than 1 the greatest target value counts
            (the authors take 10 on AntMaze).
        samples: Actions proposed when acting, one of which is drawn by the softmax of the target Q.
        temperature: Divides Q in that softmax, so it depends on the unit of rewards: with ``reward_scale`` c instead of
            the rewards as they are, c chooses as the authors do.
        hidden_dim: Width of the policy.
        blocks: Its residual blocks.
        dropout: Rate inside these.
        diffusion_steps: T.
        target_ema: Rate of the targets of critic and policy.
        actor_ema_every: Steps between two moves of the target policy.
        actor_ema_start: Step before which it does not move.
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

    STAGE = "dql"
    PARTS: ClassVar = {"critic": ("critic",), "actor": ("actor", "target_actor")}
    SHAPE = ("hidden_dims", "hidden_dim", "blocks", "diffusion_steps", *FOURIER)
    PREDICTION = "action"

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256, 256),
        eta: float = 1.0,
        backup_samples: int = 1,
        samples: int = 50,
        temperature: float = 1.0,
        hidden_dim: int = 256,
        blocks: int = 3,
        dropout: float = 0.0,
        diffusion_steps: int = 5,
        target_ema: float = 0.005,
        actor_ema_every: int = 5,
        actor_ema_start: int = 1000,
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
            ("eta", eta >= 0, "0 or more"),
            ("backup_samples", backup_samples >= 1, "at least 1"),
            ("samples", samples >= 1, "at least 1"),
            ("temperature", temperature > 0, "positive"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
            ("actor_ema_every", actor_ema_every >= 1, "at least 1"),
        ]
        self._refuse(rules)
        width = self._make_embedding(self.hparams)
        self.action_box = ActionBox(action_dim)
        self.critic = TwinCritic(width, action_dim, hidden_dims)
        shape = (width, action_dim, 0, hidden_dim, blocks, dropout, diffusion_steps)
        self.actor, self.target_actor = with_target(lambda: DiffusionDecoder(*shape))
        self._begin(init_from)

    def loss(self, batch: Batch) -> Loss:
        """Equations 3 to 5, summed; what climbs Q leaves Q as it is."""
        x, chosen = self.embed(batch["observations"]), self.action_box.to_unit(batch["actions"])
        new = draw(self.actor, x, 1)[1]
        values = self.critic.judge(x, new)  # (2, B)
        terms = {
            "q_loss": losses.td(self.critic.both(x, chosen), self._target(batch)),
            "denoising": self.actor.loss(chosen, x, x[:, :0]).mean(),
            "climb": self.hparams.eta * climb(values, int(torch.rand(()) < 0.5)),
        }
        return self._sum(terms, {"q_mean": values.mean()})

    @torch.no_grad()
    def _target(self, batch: Batch) -> Tensor:
        count = self.hparams.backup_samples
        wide, actions = draw(self.target_actor, self.embed(batch["next_observations"]), count)
        after = self.critic.targets(wide, actions).view(2, -1, count).amax(dim=-1).amin(dim=0)
        return losses.td_target(batch["rewards"], batch["discounts"], batch["dones"], after)

    def followers(self, step: int) -> list[tuple[nn.Module, nn.Module, float]]:
        """The critic moves after every step, the policy after some."""
        h = self.hparams
        moved: list[tuple[nn.Module, nn.Module, float]] = [(self.critic.target, self.critic.online, h.target_ema)]
        if step >= h.actor_ema_start and step % h.actor_ema_every == 0:
            moved.append((self.target_actor, self.actor, h.target_ema))
        return moved

    def act(self, observations: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Actions (B, A) for observations (B, O)."""
        x = self.embed(observations)
        proposed, q = proposals(self.actor, self.critic, x, self.hparams.samples, generator)
        index = categorical((q / self.hparams.temperature).softmax(dim=-1), generator)
        return self.action_box.from_unit(take(proposed, index))

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Actions (B, A) for the states of a batch."""
        return self.act(batch["observations"])


def climb(values: Tensor, which: int) -> Tensor:
    """``-E[Q_which] / E[|Q_other|]`` of values (2, B), the scale without gradient."""
    return -values[which].mean() / values[1 - which].abs().mean().detach()
