"""Collection and updates in turn: what is due is collected, then comes a batch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.online.collector import Collector
from dds_lightning.online.replay import Replay

EPOCH = 1000
"""Batches of an epoch; only progress lines and `check_val_every_n_epoch` see it."""


class OnlineLoader:
    """Batches from the replay and the prior data; the policy of the module in training collects in between.

    Args:
        data: The `OnlineDataModule`.
    """

    def __init__(self, data: Any) -> None:
        h, task = data.hparams, data.task
        self.data, self.seed = data, int(h.seed)
        mapped = task.maze_map is not None
        size = (len(task.maze_map), len(task.maze_map[0])) if task.maze_map else (0, 0)
        envs = [data.make_env() for _ in range(h.num_envs)]
        self.collector = Collector(envs, self.seed, task.xy_to_cell if mapped else None, size)
        codes = data.choices if data.space == "discrete" else None
        self.replay = Replay(h.replay_size, data.observation_dim, 0 if codes else data.choices, codes)
        self.generator = torch.Generator().manual_seed(self.seed)
        self.updates = 0
        self.random: bool | None = None  # whether it begins with random choices; the module knows

    def __len__(self) -> int:
        """Batches of an epoch."""
        return EPOCH

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """The next batches of a stream without end."""
        for _ in range(EPOCH):
            self._collect_what_is_due()
            self.updates += 1
            yield self._batch()

    def _collect_what_is_due(self) -> None:
        """Collect until the environment steps so far allow one more update."""
        h = self.data.hparams
        if (follower := self._module().follower) is not None:
            self.replay.keep_steps(self.data.horizon, self.data.task.action_dim)
            for env in self.collector.envs:
                env.skill = follower.skill
        while self.collector.steps < h.random_steps or self.updates + 1 > self._allowed():
            self.collector.collect(self.replay, self._choose)

    def _allowed(self) -> float:
        h = self.data.hparams
        return h.updates * (self.collector.steps - h.random_steps)

    def _choose(self, observations: NDArray[np.float32], generator: torch.Generator) -> NDArray[Any]:
        """The policy's choices for observations (E, O), random ones at the beginning."""
        h, module = self.data.hparams, self._module()
        if self.random is None:
            self.random = not module.starts_offline
        if self.random and self.collector.steps < h.random_steps:
            shape = (len(observations),)
            if self.data.space == "discrete":
                return torch.randint(self.data.choices, shape, generator=generator).numpy()
            unit = 2.0 * torch.rand(*shape, self.data.choices, generator=generator) - 1.0
            return module.action_box.from_unit(unit.to(module.device)).cpu().numpy()
        with torch.no_grad():
            x = torch.from_numpy(observations).to(module.device)
            return module.choose(x, generator=generator).cpu().numpy()

    def _module(self) -> Any:
        assert self.data.trainer is not None
        return self.data.trainer.lightning_module

    def _batch(self) -> dict[str, Tensor]:
        h, prior = self.data.hparams, self.data.prior
        count = self.data.prior_rows
        batch = self.replay.sample(h.batch_size - count, self.generator)
        if prior is not None and count:
            past = prior.batch(torch.randint(len(prior), (count,), generator=self.generator))
            past["actions"] = past.pop("codes")
            batch |= {name: torch.cat([batch[name], column]) for name, column in past.items()}
        if self.data.prior_unknown:
            batch["known"] = torch.arange(h.batch_size) < h.batch_size - count
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next batch depends on, the weights of the policy aside."""
        return {
            "replay": self.replay.state_dict(),
            "collector": self.collector.state_dict(),
            "generator": self.generator.get_state(),
            "updates": self.updates,
            "random": self.random,
            "task": self.data.task.name,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken.

        Raises:
            UserError: It is the replay of another task, or damaged.
        """
        if state["task"] != self.data.task.name:
            raise UserError(
                f"data.task is {self.data.task.name}, but the checkpoint's replay is of task {state['task']}: give "
                "that task, or start anew"
            )
        self.replay.load_state_dict(state["replay"])
        self.collector.load_state_dict(state["collector"])
        self.generator.set_state(state["generator"])
        self.updates, self.random = state["updates"], state["random"]
