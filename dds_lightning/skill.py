"""Stage one: encoder, codebook and decoder learn skills together (section 4.1, equations 10 to 14).

```
 s_1..s_H, a_1..a_H ──► encoder ──► E(tau) ──► codebook ──► z_k ──┐         (B, H, O), (B, H, A) ─► (B, D)
                                       ▲  straight-through   ▲    ▼
                                       └── commitment ──┴ codebook   decoder(z_k, s_i) ──► a_i, every i of H
```
"""

import warnings
from collections.abc import Iterable
from itertools import islice
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.module import StageModule, planned_steps
from dds_lightning.nn.bottleneck import Bottleneck, Skill
from dds_lightning.nn.codebook import Codebook, CodebookInit
from dds_lightning.nn.decoder import Decoder
from dds_lightning.nn.diffusion import DiffusionDecoder, MLPDecoder, Sampler
from dds_lightning.nn.encoder import ENCODERS
from dds_lightning.nn.gaussian import GaussianBottleneck
from dds_lightning.nn.normaliser import ActionBox, Normaliser
from dds_lightning.nn.optimiser import forget_moments
from dds_lightning.nn.settled import SettledCodes
from dds_lightning.nn.usage import SegmentMetrics
from dds_lightning.saving.fingerprint import of_skills

START_BATCHES = 64
"""Batches whose encodings start the codebook by k-means."""
BOTTLENECKS: dict[str, type[Bottleneck]] = {"vq": Codebook, "gaussian": GaussianBottleneck}
DECODERS: dict[str, type[Decoder]] = {"diffusion": DiffusionDecoder, "mlp": MLPDecoder}
Batch = dict[str, Tensor]


class SkillModule(StageModule):
    """Learn K discrete skills from segments of H steps.

    A training batch is ``{"observations": (B, H, O), "actions": (B, H, A)}`` in the environment's own units;
    normalisation is part of the module. With ``"starts"`` (B,), the row of the data where each segment starts, segments
    are encoded only once after their codes have stopped changing. The defaults are the paper's (tables 4, 5 and 6),
    save ``codebook_init`` and ``restart_threshold``, whose paper-like values are ``uniform`` and 0.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        horizon: H, steps a skill lasts; linked from the data.
        num_skills: K, at least 2.
        skill_dim: D.
        encoder: ``transformer`` (the paper) or ``gru`` of the same size.
        decoder: ``diffusion`` (the paper) or ``mlp``, the same backbone as a regressor.
        bottleneck: ``vq`` for discrete skills, ``gaussian`` for the continuous comparison.
        hidden_dim: Width of encoder and decoder.
        encoder_layers: Transformer or GRU layers.
        encoder_heads: Attention heads.
        decoder_blocks: Residual blocks of the decoder.
        dropout: Rate in encoder and decoder.
        diffusion_steps: T.
        beta_min: Start of the VP schedule.
        beta_max: End of the VP schedule.
        time_dim: Width of the time embedding.
        sampler: ``ddpm`` or ``ddim``.
        noise_scale: Factor on the noise drawn while acting (1: the model's own distribution).
        clip_actions: Keep the predicted x0 in the action box while sampling.
        reconstruction: ``sum`` over H and A as in equation 13, or ``mean``. It sets the weight of the denoising loss
            relative to the codebook terms.
        commitment: Beta of equation 14.
        kl_weight: Weight of the KL term of the Gaussian bottleneck.
        codebook_init: ``kmeans`` of encodings before the first step, ``uniform`` in +-1/K (VQ-VAE), or ``normal``.
        codebook_ema: Decay of an EMA codebook; null trains the vectors by the codebook loss.
        restart_threshold: A code used less than this share of 1/K is dead and restarts from the data; 0 never. With
            ``init_from``, 0 keeps a policy that was trained on the old codes: codes that the new data do not use would
            restart too, and mean something else.
        restart_every: Steps between two searches for dead codes.
        restart_until: Share of the training, or of `freeze_codes_after`, after which no code restarts any more.
        freeze_codes_after: Optimiser step after which encoder and codebook stand still and the decoder alone learns,
            at less than half the cost of a step; null lets all learn to the end (the paper).
        lr: Adam's learning rate.
        lr_schedule: ``constant`` (the paper) or ``cosine`` decay to zero at ``max_steps``.
        warmup_steps: Steps of linear warm-up.
        init_from: ``.ckpt`` or published directory whose weights to start from (`dds_lightning.finetune`).
        trainable: ``all``, or some of ``encoder``, ``codebook`` and ``decoder``; the rest does not change by a bit.
        lr_scale: Factor on ``lr`` by part, such as ``{encoder: 0.1}``; 1 for a part that is not named.
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.

    Raises:
        UserError: A setting is outside its range; the message names it.
    """

    STAGE = "skill"
    PARTS: ClassVar = {"encoder": ("encoder",), "codebook": ("bottleneck",), "decoder": ("decoder",)}
    SHAPE = (
        *("horizon", "bottleneck", "num_skills", "skill_dim", "encoder", "decoder", "hidden_dim", "encoder_layers"),
        *("encoder_heads", "decoder_blocks", "diffusion_steps", "beta_min", "beta_max", "time_dim"),
    )

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        horizon: int = 10,
        num_skills: int = 16,
        skill_dim: int = 128,
        encoder: Literal["transformer", "gru"] = "transformer",
        decoder: Literal["diffusion", "mlp"] = "diffusion",
        bottleneck: Literal["vq", "gaussian"] = "vq",
        hidden_dim: int = 256,
        encoder_layers: int = 4,
        encoder_heads: int = 8,
        decoder_blocks: int = 4,
        dropout: float = 0.1,
        diffusion_steps: int = 5,
        beta_min: float = 0.1,
        beta_max: float = 10.0,
        time_dim: int = 16,
        sampler: Sampler = "ddpm",
        noise_scale: float = 1.0,
        clip_actions: bool = True,
        reconstruction: Literal["sum", "mean"] = "sum",
        commitment: float = 0.25,
        kl_weight: float = 0.01,
        codebook_init: CodebookInit = "kmeans",
        codebook_ema: float | None = None,
        restart_threshold: float = 0.1,
        restart_every: int = 100,
        restart_until: float = 0.7,
        freeze_codes_after: int | None = None,
        lr: float = 5e-5,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        warmup_steps: int = 0,
        init_from: str | None = None,
        trainable: list[str] | str = "all",
        lr_scale: dict[str, float] | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        only_codebook = trainable in ("codebook", ["codebook"])
        self.save_hyperparameters(ignore=["init_from"])
        rules = [
            ("num_skills", num_skills >= 2, "at least 2: with one code the policy has nothing to choose"),
            ("horizon", horizon >= 1, "at least 1"),
            ("encoder_heads", hidden_dim % encoder_heads == 0, f"a divisor of hidden_dim={hidden_dim}"),
            ("time_dim", time_dim % 2 == 0, "an even number: half sines, half cosines"),
            ("noise_scale", noise_scale >= 0, "0 or more"),
            ("freeze_codes_after", freeze_codes_after is None or freeze_codes_after >= 1, "null or at least 1"),
            ("codebook_ema", codebook_ema is None or 0 < codebook_ema < 1, "null or in (0, 1)"),
            ("trainable", not only_codebook or bottleneck == "vq", f"all: a {bottleneck} bottleneck has no codebook"),
            ("trainable", not only_codebook or codebook_ema is None, "more, or codebook_ema: null to give it a loss"),
        ]
        self._refuse(rules)
        space = BOTTLENECKS[bottleneck]
        self.horizon, self.num_skills = horizon, num_skills
        self.discrete = space.discrete
        self.normaliser = Normaliser(observation_dim)
        self.action_box = ActionBox(action_dim)
        shape = (horizon, hidden_dim, encoder_layers, encoder_heads, dropout)
        self.encoder = ENCODERS[encoder](observation_dim + action_dim, space.widths * skill_dim, *shape)
        self.bottleneck = space.build(self.hparams)
        self.decoder = DECODERS[decoder].build(self.hparams)
        self.metrics = SegmentMetrics(num_skills if self.discrete else None)
        self._settled = SettledCodes()
        self._last_restart = float("inf")  # step of this training
        self._batch: Batch = {}  # of the step in progress: dead codes restart from it
        self._begin(init_from)

    def encode_segments(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Skill:
        """Run encoder and bottleneck.

        Args:
            observations: (B, H, O) in the environment's units.
            actions: (B, H, A) in the environment's units.
            lengths: (B,) steps really taken, for segments cut short by a termination.
        """
        return self.bottleneck(self._encodings(observations, actions, lengths))

    def _encodings(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Encoder outputs E(tau) of segments, as in `encode_segments`."""
        sequence = torch.cat([self.normaliser(observations), self.action_box.to_unit(actions)], dim=-1)
        return self.encoder(sequence, lengths)

    def loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor], Skill]:
        """Equation 14: denoising loss plus the terms of the bottleneck.

        Returns:
            The scalar to minimise, its detached terms by name (not weighted), and the skills of the batch.
        """
        observations, actions = batch["observations"], batch["actions"]  # (B, H, O), (B, H, A)
        skill = self._settled.skills(self, batch) or self.encode_segments(observations, actions)
        error = self.decoder.loss(
            self.action_box.to_unit(actions).flatten(0, 1),  # (B H, A)
            self.normaliser(observations).flatten(0, 1),  # (B H, O)
            skill.vectors.repeat_interleave(actions.shape[1], dim=0),  # (B H, D)
        )
        total = error.mean() * (actions[0].numel() if self.hparams.reconstruction == "sum" else 1)
        terms = {"denoising": total.detach()}
        for name, term in skill.terms.items():
            total = total + term.weight * term.value
            terms[name] = term.value.detach()
        return total, terms, skill

    def configure_callbacks(self) -> list[SettledCodes]:
        """Give each training a memory of its own for codes that stand still."""
        self._settled = SettledCodes()
        return [self._settled]

    def encode(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Code of each segment, k = argmin ||E(tau) - z_j||: shapes as in `encode_segments`, result (B,) int64.

        Raises:
            UserError: The skills are continuous.
        """
        codes = self.encode_segments(observations, actions, lengths).codes
        if codes is None:
            kind = self.hparams.bottleneck
            raise UserError(f"bottleneck is {kind}: its skills have no codes; train with bottleneck: vq")
        return codes

    def decode(
        self,
        observations: Tensor,
        skills: Tensor,
        noise_scale: float | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Draw actions (B, A), in the environment's units and inside its box.

        Args:
            observations: (B, O).
            skills: Codes (B,) or vectors (B, D).
            noise_scale: Factor on the decoder's noise; None takes the model's setting.
            generator: Random stream; the global one by default.
        """
        scale = self.hparams.noise_scale if noise_scale is None else noise_scale
        unit = self.decoder.sample(self.normaliser(observations), self.vectors(skills), scale, generator)
        return self.action_box.from_unit(unit)

    def vectors(self, skills: Tensor) -> Tensor:
        """Skill vectors (B, D) of codes (B,); vectors are returned as they are."""
        return skills if skills.is_floating_point() else self.bottleneck.lookup(skills)

    @property
    def draws(self) -> int:
        """N, Gaussians that the decoder draws for one action."""
        return self.decoder.draws

    def decode_from(self, observations: Tensor, skills: Tensor, noise: Tensor) -> Tensor:
        """`decode` with given noise (N, B, A), the noise scale included: a function of its arguments."""
        unit = self.decoder.denoise(noise, self.normaliser(observations), self.vectors(skills))
        return self.action_box.from_unit(unit)

    def on_fit_start(self) -> None:
        """Take the data's statistics and start the bottleneck, unless a checkpoint brought both."""
        self.refuse_frozen_without_weights()
        self.fit_units()
        self.bottleneck.start(lambda: self._encodings_of(islice(self.training_batches(), START_BATCHES)))
        self.agree(self.bottleneck)

    def on_train_start(self) -> None:
        """Freeze the codes again in a training that goes on, and see until when codes may restart."""
        self._freeze_codes(self.global_step)
        ends = (planned_steps(self.trainer), self.hparams.freeze_codes_after or -1)
        self._last_restart = self.hparams.restart_until * min((end for end in ends if end > 0), default=float("inf"))

    def _freeze_codes(self, step: int) -> None:
        """Let the decoder alone learn from `freeze_codes_after` on."""
        after = self.hparams.freeze_codes_after
        self.hold(("encoder", "bottleneck") if after is not None and step >= after else ())

    @torch.no_grad()
    def _encodings_of(self, batches: Iterable[Batch]) -> Tensor:
        """Encoder outputs (N, D) of a few batches, in evaluation mode."""
        was_training, there = self.training, self.device
        self.eval()
        found = [self._encodings(batch["observations"].to(there), batch["actions"].to(there)) for batch in batches]
        self.train(was_training)
        return torch.cat(found)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """One optimiser step's loss."""
        self._batch = batch
        total, self.terms, _ = self.loss(batch)
        self.log_training(total, self.bottleneck.health)
        return total

    def after_step(self, step: int) -> None:
        """Restart dead codes until the codebook has to settle, and freeze the codes in time."""
        h = self.hparams
        self._freeze_codes(step)
        due = h.restart_threshold > 0 and step % h.restart_every == 0
        if due and step <= self._last_restart and "codebook" in self.trained_parts:
            self._restart_dead_codes(step)

    def _restart_dead_codes(self, step: int) -> None:
        """Move codes that are hardly used to where this batch needs them."""
        generator = torch.Generator().manual_seed(step)
        threshold = self.hparams.restart_threshold
        moved = self.bottleneck.revive(lambda: self._encodings_of([self._batch]), threshold, generator)
        rows = self.agree(self.bottleneck, list(moved.values()))
        optimizer: Any = self.optimizers()
        forget_moments(optimizer, dict(zip(moved, rows, strict=True)))

    def evaluate(self, batch: Batch, stage: str) -> None:
        """Log the loss, and update reconstruction error in action units (by sampling) and codebook usage."""
        total, terms, skill = self.loss(batch)
        observations, actions = batch["observations"], batch["actions"]
        vectors = skill.vectors.repeat_interleave(actions.shape[1], dim=0)  # (B H, D)
        sampled = self.decode(observations.flatten(0, 1), vectors, noise_scale=1.0)
        self.metrics.update(sampled, actions.flatten(0, 1), skill.codes)
        log = {f"{stage}/{name}": value for name, value in {"loss": total, **terms}.items()}
        self.log_dict(log, batch_size=len(actions), sync_dist=True)

    def on_validation_epoch_start(self) -> None:
        """Reset the metrics here: `Trainer.validate` leaves inference tensors, which a fit must not change."""
        self.metrics.reset()

    on_test_epoch_start = on_validation_epoch_start

    def on_validation_epoch_end(self) -> None:
        """Log the epoch's reconstruction error and codebook health."""
        self._log_epoch("val")

    def on_test_epoch_end(self) -> None:
        """As `on_validation_epoch_end`."""
        self._log_epoch("test")

    def _log_epoch(self, stage: str) -> None:
        log = {f"{stage}/{name}": value for name, value in self.metrics.compute().items()}
        self.log_dict(log, prog_bar=True, sync_dist=True)

    def on_fit_end(self) -> None:
        """Warn where most of the codebook is idle."""
        used = int(self.bottleneck.health().get("codes_used", self.num_skills))
        if 2 * used < self.num_skills:
            remedy = "Keep codebook_init=kmeans and restart_threshold above 0, lower lr, or ask for fewer skills"
            warnings.warn(f"only {used} of {self.num_skills} codes are in use. {remedy}", stacklevel=1)

    def fingerprint(self) -> str:
        """Of the codes, and of all weights: see `dds_lightning.saving.fingerprint`."""
        return of_skills(self.state_dict(), self.hparams)

    def predict_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        """Codes (B,) of a batch of segments."""
        return self.encode(batch["observations"], batch["actions"], batch.get("lengths"))
