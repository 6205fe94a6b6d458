"""LDCQ: latent diffusion constrained Q-learning (Venkatraman et al., 2023).

```
 skills  z ~ q(z | tau)                     the skill stage with a Gaussian bottleneck (equation 3)
 L_prior = E[ min(SNR(t), 5) || z - z_hat(z_t, t, s) ||^2 ]                          equation 6
 L_Q = E[ (R + gamma (1 - done) max_i min_j target Q_j(s', z_i) - Q(s, z))^2 ],  z_i ~ prior(. | s')   equation 7
 acts with argmax_i Q(s, z_i),  z_i ~ prior(. | s)                                   equation 8
```

The network predicts noise, and ``|| z - z_hat ||^2 = || eps - eps_hat ||^2 / SNR(t)``, so the prior's loss is the same.
Departures: z is the mean of q, T follows our decoder's schedule, and the data are drawn evenly, without priorities.
The authors' code takes the skill that is best for one target critic, and there the smaller of both values; here the
smaller of both is taken for every skill, and then the best. Their encoder keeps close to a prior that depends on the
state, ours to N(0, I); they take skills as they are, here each dimension is divided by its spread. They discount by
gamma^H on locomotion (`data.discount: per_step`), and by gamma a skill, 0.995, in mazes and the kitchen (`per_skill`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

import dds_lightning.losses as losses
from dds_lightning.baselines.critics import Batch, Loss, TwinCritic, proposals, take
from dds_lightning.baselines.opal import LatentModule
from dds_lightning.errors import UserError
from dds_lightning.module import planned_steps
from dds_lightning.nn.diffusion import DiffusionDecoder
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.normaliser import Normaliser


class LDCQ(LatentModule):
    """A diffusion prior over continuous skills, then Q-learning among what it proposes.

    Args:
        observation_dim: O, linked from the data on the command line.
        skill_dim: D, linked from the data.
        hidden_dims: Widths of Q.
        prior_steps: Steps of the prior; those that remain up to ``max_steps`` go to Q on the frozen prior.
        samples: Skills proposed in a state when acting.
        backup_samples: Skills proposed in the next state for the target.
        snr_clip: Greatest weight of a noise level in the prior's loss.
        hidden_dim: Width of the prior.
        blocks: Its residual blocks.
        diffusion_steps: T.
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

    STAGE = "ldcq"
    PARTS: ClassVar = {"prior": ("prior",), "critic": ("critic",)}
    SHAPE = ("skill_dim", "hidden_dims", "hidden_dim", "blocks", "diffusion_steps", *FOURIER)

    def __init__(
        self,
        observation_dim: int,
        skill_dim: int,
        hidden_dims: Sequence[int] = (256, 256, 256),
        prior_steps: int = 500_000,
        samples: int = 100,
        backup_samples: int = 10,
        snr_clip: float = 5.0,
        hidden_dim: int = 256,
        blocks: int = 4,
        diffusion_steps: int = 10,
        target_ema: float = 0.005,
        lr: float = 5e-4,
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
            ("prior_steps", prior_steps >= 0, "0 or more"),
            ("samples", samples >= 1, "at least 1"),
            ("backup_samples", backup_samples >= 1, "at least 1"),
            ("snr_clip", snr_clip > 0, "positive"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
        ]
        self._refuse(rules)
        width, self.skills = self._make_embedding(self.hparams), Normaliser(skill_dim)
        shape = (width, skill_dim, 0, hidden_dim, blocks, 0.0, diffusion_steps)
        self.prior = DiffusionDecoder(*shape, clip=False, variance="beta")  # skills lie in no box
        self.critic = TwinCritic(width, skill_dim, hidden_dims)
        self._begin(init_from)

    def loss(self, batch: Batch) -> Loss:
        """Equation 6 in the first ``prior_steps`` steps, equation 7 after."""
        x, z = self.embed(batch["observations"]), self.skills(batch["actions"])
        if "prior" in self.learning:
            return self._sum({"prior_loss": self.prior_loss(x, z)}, {})
        q = self.critic.both(x, z)
        return self._sum({"q_loss": losses.td(q, self._target(batch))}, {"q_mean": q.mean()})

    def on_fit_start(self) -> None:
        """As of a `LatentModule`; refuse a training that would end before the critic's began."""
        last, first = planned_steps(self.trainer), self.hparams.prior_steps
        if 0 <= last <= first:
            raise UserError(
                f"model.prior_steps is {first}, expected less than the {last} steps of the training: "
                "the critic learns in those that follow, and it chooses"
            )
        super().on_fit_start()

    def learning_at(self, step: int) -> tuple[str, ...]:
        """First the prior, then the critic."""
        return ("prior",) if step < self.hparams.prior_steps else ("critic",)

    def prior_loss(self, states: Tensor, skills: Tensor) -> Tensor:
        """Equation 6 for embedded states (B, F) and skills (B, D), the mean over B and D."""
        t = torch.randint(self.prior.diffusion_steps, (len(skills),), device=skills.device)
        noise = torch.randn_like(skills)
        kept = self.prior.alpha_bars[t, None]
        snr = kept / (1.0 - kept)  # (B, 1)
        noisy = kept.sqrt() * skills + (1.0 - kept).sqrt() * noise
        error = (self.prior.predict_noise(noisy, t, states, states[:, :0]) - noise).square()
        return (snr.clamp_max(self.hparams.snr_clip) / snr * error).mean()

    @torch.no_grad()
    def _target(self, batch: Batch) -> Tensor:
        states = self.embed(batch["next_observations"])
        _, q = proposals(self.prior, self.critic, states, self.hparams.backup_samples)
        return losses.td_target(batch["rewards"], batch["discounts"], batch["dones"], q.amax(dim=-1))

    def followers(self, step: int) -> list[tuple[nn.Module, nn.Module, float]]:
        """The target critic moves after every step."""
        return [(self.critic.target, self.critic.online, self.hparams.target_ema)]

    def propose(self, states: Tensor, greedy: bool, generator: torch.Generator | None) -> Tensor:
        """The best of the prior's proposals, or one of them."""
        count = self.hparams.samples if greedy else 1
        proposed, q = proposals(self.prior, self.critic, states, count, generator)
        return take(proposed, q.argmax(dim=-1))
