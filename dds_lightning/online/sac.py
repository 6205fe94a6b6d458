"""Soft actor-critic over codes, continuous skills or raw actions (section 5.3): one module, three action spaces.

```
 (s, x, R, s', discount, done) ─► Q_n(s, x) ◄─ R + discount (1 - done) (E[Q'(s', x')] - backup alpha E[log pi])
                                  pi(x | s) ◄─ alpha E[log pi] - E[Q(s, x)]
                                  alpha     ◄─ -alpha (E[log pi] + target entropy)
```

x is a code k, a skill vector z or an action a; R and discount are those of relabelling. Over codes the expectations are
exact sums, over numbers they are one sample. Q' is the target network.

One Adam minimises the sum of the three losses: their parameters are disjoint, so its step equals that of three
optimisers that act at once. (CleanRL and stable-baselines3 let the policy see the critic that was just updated.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import one_hot

import dds_lightning.losses as losses
from dds_lightning.errors import UserError
from dds_lightning.module import StageModule, adam, is_log_step
from dds_lightning.nn.draws import categorical
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.normaliser import ActionBox
from dds_lightning.online.follower import Follower
from dds_lightning.online.heads import BoxHead, CodeHead
from dds_lightning.online.novelty import Novelty
from dds_lightning.online.offline import one_start, start_offline

Space = Literal["discrete", "continuous", "raw"]
Pessimism = Literal["min", "mean"]


class SACModule(StageModule):
    """Soft actor-critic in an environment of skills.

    A training batch is ``{"observations": (B, O), "actions": (B,) codes or (B, D), "rewards": (B,),
    "next_observations": (B, O), "discounts": (B,), "dones": (B,)}``. `configs/paper/online.yaml` has the paper's
    settings (table 6).

    Args:
        observation_dim: O, linked from the data on the command line.
        space: ``discrete`` codes, ``continuous`` skills or ``raw`` actions, linked from the data.
        choices: K codes, D numbers of a skill or A numbers of an action, linked from the data.
        hidden_dims: Widths of critics and policy.
        layer_norm: Normalise before each ReLU of the critics (not in the paper; RLPD's).
        fourier_features: Frequencies that all networks see beside the observation; 0 for none (the paper).
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        critics: Number of critics N.
        pessimism: Take the ``min`` or the ``mean`` of the critics.
        backup_entropy: Whether the policy's entropy is part of the critics' target (the paper's SAC). Without it
            discrete SAC is stable (arXiv 2509.09838; RLPD and SUPE leave it out on AntMaze too).
        temperature: Alpha at the start (table 6: 0.1).
        target_entropy: Entropy that alpha is adjusted for: a share of log K over codes (K counts those with support),
            a share of -D over numbers; null keeps alpha fixed.
        target_ema: Rate of the target network (table 6: 0.005).
        actor_start: Optimiser step from which the policy learns; before, only the critics do. For a policy from offline
            data, whose critics must see the environment first.
        lr: Adam's learning rate.
        lr_schedule: ``constant`` (the paper) or ``cosine`` decay to zero at ``max_steps``.
        init_from: ``.ckpt`` or published directory of an online training whose weights to start from.
        offline: ``.ckpt`` or published directory of an offline policy (`dds policy fit`) over the same codes: its
            policy and its critics are where this training starts. One in closed form is taught to the actor in the
            states of the prior data.
        follow: Learning rate of the skills' decoder; 0 lets the skills stand still. Above, the decoder repeats what
            went better than the critics expected (`dds_lightning.online.follower`).
        optimism: Weight of the novelty in the rewards of prior data whose rewards are not known, in learning rewards.
        prior_unknown: Whether there are such data, linked from the data.
        skill_hash: Fingerprint of the skill model whose skills these are, linked from the data; null for raw actions.
        skill_settings: Settings of that model, linked from the data; kept where its decoder learns.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "online"
    PREDICTION = "choice"
    OF_DECODER = True
    OPTIONAL = ("follower",)  # which then begins as data.skill
    PARTS: ClassVar = {"critic": ("critic", "target_critic"), "actor": ("actor",)}
    SHAPE = ("space", "choices", "hidden_dims", "layer_norm", "critics", *FOURIER)
    support_mask: Tensor
    target_entropy: Tensor

    def __init__(
        self,
        observation_dim: int,
        space: Space,
        choices: int,
        hidden_dims: Sequence[int] = (256, 256),
        layer_norm: bool = False,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        critics: int = 2,
        pessimism: Pessimism = "min",
        backup_entropy: bool = False,
        temperature: float = 0.1,
        target_entropy: float | None = 0.3,
        target_ema: float = 0.005,
        actor_start: int = 0,
        lr: float = 3e-4,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        init_from: str | None = None,
        offline: str | None = None,
        optimism: float = 1.0,
        follow: float = 0.0,
        prior_unknown: bool = False,
        skill_hash: str | None = None,
        skill_settings: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        with_skills, skill_settings = skill_settings is not None, skill_settings if follow else None
        self.save_hyperparameters(ignore=["init_from", "offline"])
        discrete = space == "discrete"
        entropy = target_entropy is None or not discrete or 0 <= target_entropy <= 1
        rules = [
            ("choices", choices >= (2 if discrete else 1), "2 codes or more, or 1 number or more"),
            ("critics", critics >= 1, "at least 1"),
            ("temperature", temperature > 0, "positive"),
            ("target_entropy", entropy, "null or a share of log K in [0, 1]"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
            ("actor_start", actor_start >= 0, "0 or more"),
            ("optimism", optimism >= 0, "0 or more"),
            ("follow", follow >= 0, "0 or more"),
            ("follow", with_skills or not follow, "0: there are no skills whose decoder could learn"),
        ]
        self._refuse(rules)
        self.num_skills = choices if discrete else 0
        width = self._make_embedding(self.hparams)
        self.action_box = ActionBox(0 if discrete else choices)
        self.actor = (CodeHead if discrete else BoxHead)(width, choices, hidden_dims)
        shape = (width + self.actor.takes, self.actor.outputs, hidden_dims, layer_norm, critics)
        self.critic, self.target_critic = MLP(*shape), MLP(*shape)
        self.target_critic.load_state_dict(self.critic.state_dict())
        self.target_critic.requires_grad_(False)
        self.novelty = Novelty(width + choices, hidden_dims) if prior_unknown else None
        self.follower = Follower(skill_settings, follow) if skill_settings else None
        self.log_alpha = nn.Parameter(torch.tensor(math.log(temperature)), requires_grad=target_entropy is not None)
        self.register_buffer("target_entropy", torch.zeros(()))
        self.value_range = torch.tensor([-torch.inf, torch.inf])  # what comes is not known: no value is impossible
        self.register_buffer("support_mask", torch.ones(self.num_skills, dtype=torch.bool))
        self._offline = one_start(offline, init_from)
        self._begin(init_from)
        self.settle_entropy()

    # ---------------------------------------------------------------- choosing

    @property
    def starts_offline(self) -> bool:
        """Whether the policy knows something before the first update, so that it need not begin at random."""
        return self._offline is not None or self.init_from is not None

    @property
    def skill_hash(self) -> str | None:
        """Fingerprint of the skill model whose skills it chooses, as their decoder is now: it belongs to that one."""
        return super().skill_hash if self.follower is None else self.follower.skill.fingerprint()

    @property
    def discrete(self) -> bool:
        """Whether the choice is among codes."""
        return self.num_skills > 0

    def logits(self, observations: Tensor) -> Tensor:
        """Unnormalised log pi(k | s) of a policy over codes: (B, O) to (B, K)."""
        assert isinstance(self.actor, CodeHead), "numbers have no logits"
        return self.actor.logits(self.embed(observations), self.support_mask)

    def q(self, observations: Tensor) -> Tensor:
        """The target critics' value of every code: (B, O) to (B, K)."""
        return self._judge_target(self.embed(observations))

    def v(self, observations: Tensor) -> Tensor:
        """Value of the policy, ``E[Q]`` under the target critics: (B, O) to (B,)."""
        return self.actor.expect(self.embed(observations), self.support_mask, self._judge_target).q

    def codes(
        self,
        observations: Tensor,
        selection: Literal["sample", "greedy", "argmax_q"] = "sample",
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Choose a code for each state, as `PolicyModule.codes`: (B, O) to (B,)."""
        if selection != "sample":
            scores = self.q(observations) if selection == "argmax_q" else self.logits(observations)
            return scores.masked_fill(~self.support_mask, -torch.inf).argmax(dim=-1)
        return categorical((self.logits(observations) / temperature).softmax(dim=-1), generator)

    def choose(
        self,
        observations: Tensor,
        selection: Any = "sample",
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Choose a skill or an action for each state.

        Args:
            observations: (B, O).
            selection: ``sample`` from the policy, ``greedy`` its mode; over codes also ``argmax_q``.
            temperature: Of sampling among codes.
            generator: Random stream; the global one by default.

        Returns:
            (B,) int64 codes, or (B, D) skills or actions in their own units.

        Raises:
            UserError: The selection needs codes.
        """
        if isinstance(self.actor, CodeHead):
            return self.codes(observations, selection, temperature, generator)
        if selection not in ("sample", "greedy"):
            raise UserError(f"selection is '{selection}', expected sample or greedy: {self.hparams.space} has no codes")
        features = self.embed(observations)
        sampled = selection == "sample"
        unit = self.actor.sample(features, generator)[0] if sampled else self.actor.moments(features)[0].tanh()
        return self.action_box.from_unit(unit)

    # ---------------------------------------------------------------- learning

    @property
    def alpha(self) -> Tensor:
        """The temperature of the policy's entropy."""
        return self.log_alpha.exp()

    def settle_entropy(self) -> None:
        """Let the setting decide the target entropy, whatever weights were loaded, and for the codes with support."""
        self.target_entropy.copy_((self.hparams.target_entropy or 0.0) * self.actor.entropy_unit(self.support_mask))

    def _values(self, critic: nn.Module, inputs: Tensor) -> Tensor:
        """Inputs (B, F or F + D) to the values of every critic (N, B, K or 1)."""
        return critic(inputs.expand(self.hparams.critics, *inputs.shape))

    def _agree(self, values: Tensor) -> Tensor:
        """The joint verdict of the critics, their least or mean value: (N, B, ...) to (B, ...)."""
        return values.amin(dim=0) if self.hparams.pessimism == "min" else values.mean(dim=0)

    def _judge_target(self, inputs: Tensor) -> Tensor:
        """The target critics' joint verdict: (B, F or F + D) to (B, K or 1)."""
        return self._agree(self._values(self.target_critic, inputs))

    def _judge_frozen(self, inputs: Tensor) -> Tensor:
        """The critics' joint verdict; gradients reach the inputs and not the critics."""
        weights = {name: value.detach() for name, value in self.critic.named_parameters()}
        return self._agree(functional_call(self.critic, weights, inputs.expand(self.hparams.critics, *inputs.shape)))

    def loss(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Sum of the losses of critics, policy and temperature; its terms and their statistics, detached."""
        features = self.embed(batch["observations"])  # (B, F)
        terms: dict[str, Tensor] = {}
        if self.novelty is not None:  # before the labels, whose unit the first batch sets
            transition = self._transition(batch, features)
            terms["novelty_loss"] = self.novelty.loss(batch, transition)
        with torch.no_grad():
            after = self.embed(batch["next_observations"])
            follow = self.actor.expect(after, self.support_mask, self._judge_target)
            next_v = follow.q - (self.alpha * follow.log_pi if self.hparams.backup_entropy else 0.0)
            rewards, dones = batch["rewards"], batch["dones"]
            if self.novelty is not None:
                rewards, dones = self.novelty.label(batch, transition, self.hparams.optimism)
            target = losses.td_target(rewards, batch["discounts"], dones, next_v)
        taken = features
        if not self.discrete:
            taken = torch.cat([features, self.action_box.to_unit(batch["actions"])], dim=-1)
        values = self._values(self.critic, taken)  # (N, B, K or 1)
        q = self.actor.of_taken(values, batch["actions"])  # (N, B)
        terms["q_loss"] = losses.td(q, target)
        learns = "actor" in self.learning
        with torch.set_grad_enabled(learns and torch.is_grad_enabled()):
            # Over codes the values of all choices are there already; over numbers the policy makes a new choice.
            judge = (lambda _: self._agree(values.detach())) if self.discrete else self._judge_frozen
            now = self.actor.expect(features, self.support_mask, judge)
            terms["actor_loss"] = (self.alpha.detach() * now.log_pi - now.q).mean()
            terms["temperature_loss"] = -(self.alpha * (now.log_pi.detach() + self.target_entropy)).mean()
        if self.follower is not None and learns and "step_actions" in batch:
            terms["decoder_loss"] = self.follower.loss(batch, target - self._agree(q.detach()))
        waiting = () if learns else ("actor_loss", "temperature_loss")
        total = torch.stack([term for name, term in terms.items() if name not in waiting]).sum()
        info = {"q_mean": q.mean(), "q_min": q.min(), "q_max": q.max(), "alpha": self.alpha, **terms}
        info["entropy"] = -now.log_pi.mean()
        return total, {name: value.detach() for name, value in info.items()}

    def _transition(self, batch: dict[str, Tensor], features: Tensor) -> Tensor:
        """State and choice as one vector, (B, F + K or D)."""
        taken = batch["actions"]
        choice = one_hot(taken, self.num_skills) if self.discrete else self.action_box.to_unit(taken)
        return torch.cat([features, choice], dim=-1)

    def learning_at(self, step: int) -> tuple[str, ...]:
        """The critics, and from ``actor_start`` on the policy."""
        return self.trained_parts if step >= self.hparams.actor_start else ("critic",)

    def on_fit_start(self) -> None:
        """Take the units and the skills to follow from the data, and policy and critics from offline training."""
        if self.follower is not None:
            data: Any = self.trainer.datamodule  # type: ignore[attr-defined]
            self.follower.refuse_prior_alone(data)
            self.follower.start(data.skill)
        if not bool(self.normaliser.fitted):
            names = ["observation_mean", "observation_std"] + ([] if self.discrete else ["action_low", "action_high"])
            found = self.data_statistics(names, "fit it with an OnlineDataModule")
            self.normaliser.fit(found["observation_mean"], found["observation_std"])
            if not self.discrete:
                self.action_box.fit(found["action_low"], found["action_high"])
            if self._offline is not None:
                prior = getattr(getattr(self.trainer, "datamodule", None), "prior", None)
                start_offline(self, self._offline, None if prior is None else prior.observations)

    def configure_optimizers(self) -> Any:
        """Adam over everything that learns, the decoder at its own rate."""
        if self.follower is None:
            return super().configure_optimizers()
        return adam(self.follower.groups(self), self.hparams.lr, self.hparams.lr_schedule, 0, self)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        total, self.terms = self.loss(batch)
        self.log_training(total)
        return total

    def log_training(self, total: Tensor, more: Any = dict) -> None:
        """Log the losses, and how the episodes went that were collected."""
        super().log_training(total, more)
        collected = getattr(getattr(self.trainer, "datamodule", None), "collected", None)
        if collected is not None and is_log_step(self):
            self.log_dict({f"online/{name}": float(value) for name, value in collected().items()})

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        """Move the target critics towards the critics."""
        target: list[Tensor] = list(self.target_critic.parameters())
        torch._foreach_lerp_(target, list(self.critic.parameters()), self.hparams.target_ema)

    def predict_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """The policy's mode for the states of a batch."""
        return self.choose(batch["observations"], "greedy")
