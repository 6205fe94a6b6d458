"""Stages two and three: discrete IQL over codes, then a policy by advantage-weighted regression (section 4.3).

```
 (s, k, R, s', discount, done) ─► V(s) ◄─ expectile tau ─ min target Q(s, k)      equation 6
                                  Q(s, k) ◄─ R + discount (1 - done) V(s')        equation 8
                                  pi(k | s) ◄─ exp(alpha (Q - V)) log pi(k | s)   equation 9
```

One Adam minimises the sum of the losses: parameters are disjoint and targets carry a stop-gradient, so its step equals
those of three optimisers. (The original IQL updates V, the policy and Q in turn, each with the networks just updated.)

With so few codes, the policy that minimises equation 9 can also be written down, with beta the policy of the data:

```
 pi(k | s)  ~  beta(k | s) exp(alpha (Q(s, k) - V(s)))
```

``awr: closed_form`` learns beta from all data with equal weight and forms this product when it acts. Regression instead
learns the product from samples of uneven weight, of which few count: in AntMaze-Large 4 % (`effective_sample_size`).
"""

import warnings
from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple, get_args

import torch
from torch import Tensor

import dds_lightning.losses as losses
from dds_lightning.module import StageModule, planned_steps
from dds_lightning.nn.draws import categorical
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.mlp import MLP
from dds_lightning.nn.watch import complaints

Selection = Literal["sample", "greedy", "argmax_q"]
Solution = Literal["regression", "closed_form"]
Unit = Literal["reward", "spread"]
Loss = tuple[Tensor, dict[str, Tensor]]  # a scalar to minimise, and statistics to log beside it
STATISTICS = ("observation_mean", "observation_std", "code_share", "reward_range", "max_discount")


class Judged(NamedTuple):
    """A batch of semi-MDP transitions, and what the networks say about its states and codes."""

    batch: dict[str, Tensor]  # as in `PolicyModule`
    features: Tensor  # (B, F) embedded observations
    q: Tensor  # (B,) smaller target Q(s, k) of the code taken, without gradient
    v: Tensor  # (B,) V(s)


class PolicyModule(StageModule):
    """Discrete IQL and AWR over the codes of a relabelled data set.

    A training batch is ``{"observations": (B, O), "codes": (B,), "rewards": (B,), "next_observations": (B, O),
    "discounts": (B,), "dones": (B,)}``. The defaults are the paper's (table 7); where the paper is silent (``alpha``,
    ``weight_clip``) they are IQL's.

    Args:
        observation_dim: O, linked from the data on the command line.
        num_skills: K, linked from the data.
        hidden_dims: Widths of value, Q and policy networks.
        layer_norm: Normalise before each ReLU of value and Q networks.
        fourier_features: Frequencies that value, Q and policy networks see beside the observation; 0 for none. They
            let a small network see a thin wall early (named departure from the paper).
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see, for example 2 for a position that comes
            before many joints: a moving leg must not hide where the robot is. 0 for all.
        tau: Expectile of the value loss.
        alpha: Temperature of AWR; larger follows the critic more closely.
        alpha_unit: Unit of the advantages: of the learning ``reward`` (the paper), or their ``spread``, the standard
            deviation of advantages over the data, so that the policy does not depend on the rewards' scale.
        weight_clip: Upper bound of the AWR weights; not used by ``closed_form``, whose weights are equal.
        awr: ``regression`` on the codes of the data (the paper), or ``closed_form``, the policy that the regression
            would find with infinite data (named departure from the paper); `alpha` may then change at any time.
        beta_floor: With ``closed_form``, codes to which the policy of the data gives less than this in a state are
            not chosen there: their Q was hardly learnt.
        beta_ratio: The same for codes to which it gives less than this share of what it gives the likeliest code, as
            discrete BCQ does (Fujimoto et al., 2019); 0 leaves none out, 1 all but that one.
        dropout: Share of the policy network's hidden numbers left out in a training step: few data are learnt by heart.
        target_ema: Rate of the target network.
        extraction: ``after`` trains the critic for ``critic_steps``, then the policy on the frozen critic (the
            paper); ``joint`` trains them together.
        critic_steps: Steps of the critic with ``after``; the remaining steps up to ``max_steps`` go to the policy.
        support: Codes seen less often than this share of the data are never chosen.
        lr: Adam's learning rate.
        lr_schedule: ``constant`` (the paper) or ``cosine`` decay to zero at ``max_steps``.
        warmup_steps: Steps of linear warm-up.
        init_from: ``.ckpt`` or published directory whose weights to start from (`dds_lightning.finetune`), for new
            rewards or a new goal; ``data.skill`` must have the codes that this policy was trained with.
        trainable: ``all``, ``critic`` (V and Q) or ``actor``; the rest does not change by a bit.
        lr_scale: Factor on ``lr`` by part, such as ``{actor: 0.1}``; 1 for a part that is not named.
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.
        watch: Steps between two checks whether the critic left the range that rewards and discounts allow.
        skill_hash: Fingerprint of the skill model whose codes these are, linked from the data; null if unknown.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "policy"
    PARTS: ClassVar = {"critic": ("value", "critic", "target_critic"), "actor": ("actor",)}
    # `awr` belongs to the weights: with `closed_form` the actor is beta.
    SHAPE = ("num_skills", "hidden_dims", "layer_norm", "awr", *FOURIER)
    OF_DATA = ("support_mask", "value_range", "advantage_spread")
    support_mask: Tensor
    value_range: Tensor
    advantage_spread: Tensor

    def __init__(
        self,
        observation_dim: int,
        num_skills: int,
        hidden_dims: Sequence[int] = (256, 256),
        layer_norm: bool = False,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        tau: float = 0.7,
        alpha: float = 3.0,
        alpha_unit: Unit = "reward",
        weight_clip: float = 100.0,
        awr: Solution = "regression",
        beta_floor: float = 0.01,
        beta_ratio: float = 0.0,
        dropout: float = 0.0,
        target_ema: float = 0.005,
        extraction: Literal["after", "joint"] = "after",
        critic_steps: int = 1_000_000,
        support: float = 0.001,
        lr: float = 1e-4,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        warmup_steps: int = 0,
        init_from: str | None = None,
        trainable: list[str] | str = "all",
        lr_scale: dict[str, float] | None = None,
        refit_normaliser: bool = False,
        watch: int = 500,
        skill_hash: str | None = None,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("num_skills", num_skills >= 2, "at least 2: with one code there is nothing to choose"),
            ("tau", 0 < tau < 1, "in (0, 1)"),
            ("alpha", alpha >= 0, "0 or more"),
            ("alpha_unit", alpha_unit in get_args(Unit), " or ".join(get_args(Unit))),
            ("weight_clip", weight_clip > 0, "positive"),
            ("awr", awr in get_args(Solution), " or ".join(get_args(Solution))),
            ("beta_floor", 0 <= beta_floor < 1 / num_skills, f"in [0, 1/{num_skills})"),
            ("beta_ratio", 0 <= beta_ratio <= 1, "in [0, 1]"),
            ("target_ema", 0 < target_ema <= 1, "in (0, 1]"),
            ("support", 0 <= support < 1 / num_skills, f"in [0, 1/{num_skills})"),
        ]
        self._refuse(rules)
        self.num_skills = num_skills
        width = self._make_embedding(self.hparams)
        self.value = MLP(width, 1, hidden_dims, layer_norm)
        self.critic = MLP(width, num_skills, hidden_dims, layer_norm, members=2)
        self.target_critic = MLP(width, num_skills, hidden_dims, layer_norm, members=2)
        self.target_critic.load_state_dict(self.critic.state_dict())
        self.target_critic.requires_grad_(False)
        self.actor = MLP(width, num_skills, hidden_dims, dropout=dropout)
        self.register_buffer("support_mask", torch.ones(num_skills, dtype=torch.bool))
        self.register_buffer("value_range", torch.tensor([-torch.inf, torch.inf]))
        if alpha_unit == "spread":
            self.register_buffer("advantage_spread", torch.ones(()))  # a running mean over training batches
        self._begin(init_from)

    def v(self, observations: Tensor) -> Tensor:
        """V(s): (B, O) to (B,)."""
        return self.value(self.embed(observations)).squeeze(-1)

    def q(self, observations: Tensor) -> Tensor:
        """The smaller of the two target critics for every code: (B, O) to (B, K)."""
        return self._target_q(self.embed(observations))

    def logits(self, observations: Tensor) -> Tensor:
        """Unnormalised log pi(k | s): (B, O) to (B, K); -inf for codes without support in the data."""
        features = self.embed(observations)
        scores = self.actor(features).masked_fill(~self.support_mask, -torch.inf)
        if self.hparams.awr == "regression":
            return scores
        beta = scores.softmax(dim=-1)
        scores = scores + self.inverse_temperature * (self._target_q(features) - self.value(features))
        least = (self.hparams.beta_ratio * beta.amax(dim=-1, keepdim=True)).clamp_min(self.hparams.beta_floor)
        return scores.masked_fill(beta < least, -torch.inf)

    def codes(
        self,
        observations: Tensor,
        selection: Selection = "sample",
        temperature: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Choose a code for each state.

        Args:
            observations: (B, O).
            selection: ``sample`` from pi, ``greedy`` argmax of pi, ``argmax_q`` of the target critic.
            temperature: Divides the logits before sampling; below 1 is nearer to greedy.
            generator: Random stream; the global one by default.

        Returns:
            (B,) int64, only codes that the data support.
        """
        if selection == "argmax_q":
            return self.q(observations).masked_fill(~self.support_mask, -torch.inf).argmax(dim=-1)
        logits = self.logits(observations)
        if selection == "greedy":
            return logits.argmax(dim=-1)
        return categorical((logits / temperature).softmax(dim=-1), generator)

    @property
    def inverse_temperature(self) -> Tensor | float:
        """Factor on advantages in the exponent of equation 9: `alpha` in the unit of the learning rewards."""
        alpha: float = self.hparams.alpha
        return alpha if self.hparams.alpha_unit == "reward" else alpha / self.advantage_spread.clamp_min(1e-6)

    def _target_q(self, features: Tensor) -> Tensor:
        """Features (B, F) to the smaller target Q of every code (B, K)."""
        return self.target_critic(features.expand(2, *features.shape)).amin(dim=0)

    def learning_at(self, step: int) -> tuple[str, ...]:
        """The parts that learn: with ``after`` first the critic, then the actor."""
        if self.hparams.extraction == "joint" or len(self.trained_parts) == 1:
            return self.trained_parts
        return ("critic",) if step < self.hparams.critic_steps else ("actor",)

    def value_loss(self, judged: Judged) -> Loss:
        """Equation 6: V(s) as an expectile of the smaller target Q."""
        return losses.expectile(judged.q - judged.v, self.hparams.tau), {}

    def critic_loss(self, judged: Judged) -> Loss:
        """Equation 8: TD error of both Q(s, k), summed."""
        batch, features = judged.batch, judged.features
        with torch.no_grad():
            next_v = self.v(batch["next_observations"])
            target = losses.td_target(batch["rewards"], batch["discounts"], batch["dones"], next_v)
        q = self.critic(features.expand(2, *features.shape))  # (2, B, K)
        taken = batch["codes"].expand(2, -1).unsqueeze(-1)  # (2, B, 1)
        return losses.td(q.gather(-1, taken).squeeze(-1), target), {}

    def actor_loss(self, judged: Judged) -> Loss:
        """Equation 9: regression on the codes of the data, weighted by exp(alpha (Q - V)).

        With ``closed_form`` all weights are equal: the actor learns the policy of the data.
        """
        h, codes = self.hparams, judged.batch["codes"]
        log_pi = self.actor(judged.features).log_softmax(dim=-1).gather(-1, codes[:, None]).squeeze(-1)  # (B,)
        if h.awr == "closed_form":
            return losses.awr(log_pi, torch.ones_like(log_pi)), {"clipped_share": log_pi.new_zeros(())}
        weights = losses.awr_weights((judged.q - judged.v).detach(), self.inverse_temperature, h.weight_clip)
        clipped = (weights >= h.weight_clip).float().mean()
        used = losses.effective_sample_size(weights)
        return losses.awr(log_pi, weights), {"clipped_share": clipped, "effective_sample_size": used}

    def loss(self, batch: dict[str, Tensor]) -> Loss:
        """Sum of the losses that learn in this step; its terms and their statistics, detached."""
        features = self.embed(batch["observations"])  # (B, F)
        with torch.no_grad():
            q = self._target_q(features).gather(-1, batch["codes"][:, None]).squeeze(-1)  # (B,)
        v = self.value(features).squeeze(-1)  # (B,)
        judged = Judged(batch, features, q, v)
        terms = {"value_loss": self.value_loss, "q_loss": self.critic_loss} if "critic" in self.learning else {}
        terms |= {"actor_loss": self.actor_loss} if "actor" in self.learning else {}
        total = features.new_zeros(())
        info = {"v_mean": v.mean(), "v_min": v.min(), "v_max": v.max(), "q_mean": q.mean()}
        info["advantage_std"] = (q - v).std(correction=0)
        for name, term in terms.items():
            value, statistics = term(judged)
            total = total + value
            info |= {**statistics, name: value}
        return total, {name: value.detach() for name, value in info.items()}

    def on_fit_start(self) -> None:
        """Take statistics, code support and possible values from the relabelled data."""
        self.refuse_frozen_without_weights()
        fitted = bool(self.normaliser.fitted)
        if fitted and self.init_from is None:
            return  # this training continues
        statistics = self.data_statistics(STATISTICS, "fit it with a RelabeledDataModule, or call fit_statistics(...)")
        if fitted:  # by the checkpoint that it starts from
            statistics |= {"observation_mean": self.normaliser.mean, "observation_std": self.normaliser.std}
        self.fit_statistics(**statistics)

    def fit_statistics(
        self,
        observation_mean: Tensor,
        observation_std: Tensor,
        code_share: Tensor,
        reward_range: tuple[float, float],
        max_discount: float,
    ) -> None:
        """Set the normaliser, the mask of supported codes and the range in which values are possible.

        Args:
            observation_mean: (O,).
            observation_std: (O,).
            code_share: (K,) share of each code in the data.
            reward_range: Smallest and largest reward of a semi-MDP transition.
            max_discount: Largest discount of a value that follows a transition.
        """
        self.normaliser.fit(observation_mean, observation_std)
        self.support_mask.copy_(code_share >= max(self.hparams.support, 1e-12))
        if max_discount < 1.0:
            low, high = (reward / (1.0 - max_discount) for reward in reward_range)
            self.value_range.copy_(torch.tensor([min(low, 0.0), max(high, 0.0)]))

    def on_train_start(self) -> None:
        """Warn where the training ends before the policy's turn comes."""
        last = planned_steps(self.trainer)
        if last > 0 and "actor" in self.trained_parts and "actor" not in self.learning_at(last - 1):
            remedy = "lower it, raise trainer.max_steps, or give model.extraction=joint"
            found = f"model.critic_steps is {self.hparams.critic_steps:,}, and the training ends at step {last:,}"
            warnings.warn(f"{found}: the policy will have learnt nothing; {remedy}", stacklevel=1)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        total, self.terms = self.loss(batch)
        if self.hparams.alpha_unit == "spread":  # at first the mean of all batches, then of the last few hundred
            self.advantage_spread.lerp_(self.term_of_all("advantage_std"), max(0.005, 1.0 / (1 + self.global_step)))
        self.log_training(total)
        if self.global_step % self.hparams.watch == 0:
            for message in complaints(self.terms, self.value_range, self.hparams.weight_clip):
                warnings.warn(f"step {self.global_step}: {message}", stacklevel=1)
        return total

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        """Move the target critic towards the critic."""
        if "critic" in self.trained_parts:
            weights: list[Tensor] = list(self.critic.parameters())
            torch._foreach_lerp_(list(self.target_critic.parameters()), weights, self.hparams.target_ema)

    def evaluate(self, batch: dict[str, Tensor], stage: str) -> None:
        """Log the losses on held-out transitions, and how the policy compares with the data."""
        _, info = self.loss(batch)
        log_pi = self.logits(batch["observations"]).log_softmax(dim=-1)
        info["code_accuracy"] = (log_pi.argmax(dim=-1) == batch["codes"]).float().mean()
        info["entropy"] = -torch.special.xlogy(log_pi.exp(), log_pi.exp()).sum(dim=-1).mean()
        self.log_dict({f"{stage}/{k}": x for k, x in info.items()}, batch_size=len(batch["codes"]), sync_dist=True)

    def predict_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Greedy codes (B,) for the states of a batch."""
        return self.codes(batch["observations"], "greedy")
