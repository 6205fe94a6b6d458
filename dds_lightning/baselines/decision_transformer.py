"""Decision Transformer by d3rlpy: actions from returns still wanted, states and actions so far (Chen et al., 2021).

```
 (R_1, s_1, a_1, ..., R_t, s_t) -> a_t,   L = E[ || a - a_hat ||^2 ],   R_{t+1} = R_t - r_t       section 3, algorithm 1
```
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dds_lightning.baselines.d3 import Batch, D3Module, library
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.rollout.actors import Acted


class DecisionTransformer(D3Module):
    """Decision Transformer over the sequences of a `SequenceDataModule`; defaults are the authors' for locomotion.

    Returns are divided by the greatest of the data (the authors divide by 1000).

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        horizon: Steps that the transformer looks back at, the present one included; linked from the data.
        hidden_dim: Width.
        layers: Blocks.
        heads: Attention heads.
        dropout: Rate everywhere.
        max_steps: Length of the longest episode; later steps count as this one.
        target: Return that is asked for, in the range of those of the data: 0 the least, 1 the greatest.
        weight_decay: AdamW's.
        clip_grad_norm: Greatest norm of the gradient.
        warmup_steps: Steps of linear warm-up.
        lr: Learning rate.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.
    """

    STAGE, CONFIG = "dt", "DecisionTransformerConfig"
    SHAPE = ("horizon", "hidden_dim", "layers", "max_steps", *FOURIER)
    OF_DATA = ("return_range", "reward_affine")
    return_range: Tensor
    reward_affine: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        horizon: int = 20,
        hidden_dim: int = 128,
        layers: int = 3,
        heads: int = 1,
        dropout: float = 0.1,
        max_steps: int = 1000,
        target: float = 1.0,
        weight_decay: float = 1e-4,
        clip_grad_norm: float = 0.25,
        warmup_steps: int = 10_000,
        lr: float = 1e-4,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["init_from"])
        self.register_buffer("return_range", torch.tensor([0.0, 1.0]))
        self.register_buffer("reward_affine", torch.tensor([1.0, 0.0]))
        rules = [
            ("horizon", horizon >= 1, "at least 1"),
            ("heads", heads >= 1 and hidden_dim % heads == 0, f"a divisor of hidden_dim={hidden_dim}"),
            ("max_steps", max_steps >= 1, "at least 1"),
            ("warmup_steps", warmup_steps >= 1, "at least 1"),
        ]
        self._refuse(rules)
        d3 = library()
        optimiser = d3.optimizers.AdamWFactory(
            weight_decay=weight_decay,
            clip_grad_norm=clip_grad_norm,
            lr_scheduler_factory=d3.optimizers.WarmupSchedulerFactory(warmup_steps=warmup_steps),
        )
        dropouts = dict.fromkeys(("attn_dropout", "resid_dropout", "embed_dropout"), dropout)
        shape = {"context_size": horizon, "max_timestep": max_steps, "num_layers": layers, "num_heads": heads}
        encoder = d3.models.VectorEncoderFactory([hidden_dim], exclude_last_activation=True)
        self._build(
            init_from,
            learning_rate=lr,
            optim_factory=optimiser,
            encoder_factory=encoder,
            **shape,
            **dropouts,
        )

    def on_fit_start(self) -> None:
        """Use the data's statistics, unless a checkpoint provided them."""
        known = bool(self.normaliser.fitted) and self.init_from is None
        super().on_fit_start()
        if not known:
            found = self.data_statistics(self.OF_DATA, "fit it with a SequenceDataModule")
            for name, value in found.items():
                getattr(self, name).copy_(value)

    @property
    def unit(self) -> Tensor:
        """What returns are divided by."""
        return self.return_range.abs().amax().clamp_min(1e-6)

    def torch_batch(self, batch: Batch) -> Any:
        """Our sequences as d3rlpy's, in units of the network."""
        rewards = batch["rewards"][..., None]
        return library().torch_utility.TorchTrajectoryMiniBatch(
            observations=self.embed(batch["observations"]),
            actions=self.action_box.to_unit(batch["actions"]),
            rewards=rewards,
            returns_to_go=(batch["returns"] / self.unit)[..., None],
            terminals=torch.zeros_like(rewards),
            timesteps=self.counted(batch["steps"]),
            masks=torch.ones_like(batch["rewards"]),
            device=str(self.device),
        )

    def counted(self, steps: Tensor) -> Tensor:
        """Numbers of steps as d3rlpy counts, from 1 to `max_steps`."""
        return (steps + 1).clamp_max(self.hparams.max_steps)

    def unit_actions(self, observations: Tensor) -> Tensor:
        """Not from states alone.

        Raises:
            NotImplementedError: Always; see `follow`.
        """
        raise NotImplementedError("a Decision Transformer acts on sequences")

    @torch.no_grad()
    def follow(self, states: Tensor, actions: Tensor, returns: Tensor, steps: Tensor, mask: Tensor) -> Tensor:
        """Unit actions (B, L, A) from embedded states (B, L, O), unit actions, returns, steps and mask (B, L)."""
        network: Any = self.networks["transformer"]
        out: Tensor = network(states, actions, (returns / self.unit)[..., None], self.counted(steps), 1.0 - mask)
        return out

    def evaluate(self, batch: Batch, stage: str) -> None:
        """Log how far the actions are from the data's on held-out episodes."""
        error = (self._taken(batch) - self.action_box.to_unit(batch["actions"])).square().mean()
        self.log(f"{stage}/action_mse", error, batch_size=len(batch["actions"]), sync_dist=True)

    def _taken(self, batch: Batch) -> Tensor:
        states, actions = self.embed(batch["observations"]), self.action_box.to_unit(batch["actions"])
        return self.follow(states, actions, batch["returns"], batch["steps"], torch.ones_like(batch["returns"]))

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Actions (B, A) for the last steps of the sequences of a batch."""
        return self.action_box.from_unit(self._taken(batch)[:, -1])


class TransformerActor:
    """A Decision Transformer as an `Actor`: it remembers the last steps, and what is still wanted.

    Args:
        module: The trained module.
    """

    def __init__(self, module: DecisionTransformer) -> None:
        self.module = module.eval()
        self.reset(1)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget everything."""
        h, length = self.module.hparams, self.module.hparams.horizon
        low, high = self.module.return_range.cpu()
        self._wanted = float(low + h.target * (high - low))
        self._states = torch.zeros(num_envs, length, self.module.embedding_dim)
        self._actions = torch.zeros(num_envs, length, h.action_dim)
        self._returns, self._mask = torch.zeros(num_envs, length), torch.zeros(num_envs, length)
        self._steps = torch.zeros(num_envs, length, dtype=torch.long)
        self._rest = torch.full((num_envs,), self._wanted)
        self._clock = torch.zeros(num_envs, dtype=torch.long)

    @torch.inference_mode()
    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]) -> Acted:
        """As `Actor.act`."""
        module, live = self.module, torch.from_numpy(rows)
        began = live[torch.from_numpy(np.asarray(restarted))]
        self._mask[began], self._rest[began], self._clock[began] = 0.0, self._wanted, 0
        x = module.embed(torch.from_numpy(np.ascontiguousarray(observations, np.float32)).to(module.device))
        now: Sequence[tuple[Tensor, Tensor | float]] = (
            (self._states, x.cpu()),
            (self._actions, torch.zeros(len(live), self._actions.shape[-1])),
            (self._returns, self._rest[live]),
            (self._steps, self._clock[live]),
            (self._mask, torch.ones(len(live))),
        )
        for past, present in now:
            past[live] = torch.cat([past[live, 1:], torch.as_tensor(present)[:, None]], dim=1)
        seen = (past[live].to(module.device) for past, _ in now)
        unit = module.follow(*seen)[:, -1]
        self._actions[live, -1] = unit.cpu()
        self._clock[live] += 1
        return Acted(module.action_box.from_unit(unit).float().cpu().numpy())

    def paid(self, rewards: NDArray[np.float32], rows: NDArray[np.intp]) -> None:
        """Want less by what was earned."""
        scale, shift = self.module.reward_affine.cpu()
        self._rest[torch.from_numpy(rows)] -= scale * (torch.from_numpy(rewards) + shift)


def of_transformer(checkpoints: Mapping[str, str]) -> TransformerActor:
    """The actor of a checkpoint of the stage ``dt``."""
    return TransformerActor(DecisionTransformer.load(checkpoints["dt"]))
