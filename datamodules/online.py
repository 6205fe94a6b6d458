"""The data of online training: collection and updates in turn, beside prior data where there are some.

```
 env ─► SkillEnv ─► replay ──┬─► batch ─► update
  ▲                          │
  └──── policy ◄─── trainer  └─ prior data, relabelled (half of each batch)
```
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import lightning.pytorch as pl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.loader import refuse_other_rounds
from datamodules.relabelled import RelabeledDataModule
from datamodules.relabelling import Relabelling
from datamodules.robots import load_skills
from datamodules.semi_mdp import Relabelled
from dds_lightning.errors import UserError
from dds_lightning.online.collector import Collector
from dds_lightning.online.replay import Replay
from dds_lightning.online.skill_env import BOUND, SkillEnv
from dds_lightning.tasks import Task, get_task

EPOCH = 1000
"""Batches of an epoch; only progress lines and `check_val_every_n_epoch` see it."""


class OnlineDataModule(pl.LightningDataModule):
    """Transitions that the policy in training collects with skills, as batches of `SACModule`.

    Before each update as many decisions are made as `updates` asks for. All of it (replay, episodes in progress, random
    streams) is in the checkpoint, so that a training that continues collects the same transitions.

    Args:
        task: Name of a task (`dds tasks`).
        skill: Skill checkpoint: a `.ckpt` or a published directory; discrete or Gaussian. With ``actions: raw`` it
            may be left out; given, its statistics normalise the observations.
        actions: ``skills`` takes those of the skill model; ``raw`` acts without.
        data: Prior data (discrete skills only), for example ``local:DIR``; null starts without.
        prior_share: Share of prior data in a batch.
        prior_rewards: Whether the prior rewards are ``known``, or ``unknown``: then they are labelled while training,
            optimistically (`model.optimism`).
        cache: Folder of the relabelled prior data, as of `RelabeledDataModule`.
        batch_size: Transitions per batch.
        updates: Optimiser steps per environment step (a skill of H steps brings H times as many).
        random_steps: Environment steps with random choices before the first update.
        num_envs: Environments side by side; their skills share one decoder batch.
        replay_size: Decisions that are kept.
        bound: The box of continuous skills reaches from -bound to bound.
        noise_scale: Factor on the decoder's noise while collecting; null takes the skill model's.
        seed: Seed of episodes, choices and batches. On the command line it follows ``--seed_everything``; null means 0.
        **relabelling: Fields of `Relabelling`: gamma, discount, stride, reward_scale, reward_shift.

    Raises:
        UserError: A setting is outside its range, or task and skills do not fit each other.
    """

    hparams: Any

    def __init__(
        self,
        task: str | None = None,
        skill: str | None = None,
        actions: Literal["skills", "raw"] = "skills",
        data: str | None = None,
        prior_share: float = 0.5,
        prior_rewards: Literal["known", "unknown"] = "known",
        cache: str | None = None,
        batch_size: int = 256,
        updates: float = 0.2,
        random_steps: int = 4000,
        num_envs: int = 8,
        replay_size: int = 1_000_000,
        bound: float = BOUND,
        noise_scale: float | None = None,
        seed: int | None = None,
        **relabelling: Any,
    ) -> None:
        super().__init__()
        seed = seed or 0
        self.relabelling = Relabelling(**relabelling)
        relabelling.update(self.relabelling.settings())
        self.save_hyperparameters()
        if task is None:
            raise UserError("data.task is missing: give the name of a task (`dds tasks` lists them)")
        if skill is None and actions == "skills":
            raise UserError("data.skill is missing: give a skill checkpoint (.ckpt or directory), or data.actions raw")
        self.task: Task = get_task(task)
        self.refuse_settings(self.hparams)
        self.model = None if skill is None else load_skills(skill, self.task)
        self.skill = self.model if actions == "skills" else None
        self.space = "raw" if self.skill is None else "discrete" if self.skill.discrete else "continuous"
        if data is not None and self.space != "discrete":
            raise UserError(
                f"data.data is {data}, but {self.space} choices have no codes: prior data need discrete skills"
            )
        self.observation_dim = self.task.observation_dim
        self.choices = self.task.action_dim
        if self.skill is not None:
            self.choices = int(self.skill.hparams["num_skills" if self.skill.discrete else "skill_dim"])
        self.skill_hash = None if self.skill is None else self.skill.fingerprint()
        self.skill_settings = None if self.skill is None else dict(self.skill.hparams)
        self.prior_unknown = prior_rewards == "unknown"
        self.horizon = 1 if self.skill is None else self.skill.horizon
        self.prior: Relabelled | None = None
        self.loader: OnlineLoader | None = None
        self._prior_module: RelabeledDataModule | None = None
        if data is not None:
            asked = self.relabelling.settings()
            self._prior_module = RelabeledDataModule(task, data, skill, cache=cache, validation_fraction=0, **asked)

    @staticmethod
    def refuse_settings(settings: Mapping[str, Any]) -> None:
        """Refuse settings outside their range, whatever the task and the skills.

        Args:
            settings: All of the settings, by name.

        Raises:
            UserError: Names the first setting that is not allowed.
        """
        prior, share, known = settings["data"], settings["prior_share"], settings["prior_rewards"] == "known"
        auto = "auto" in (settings["reward_scale"], settings["reward_shift"])
        number = "a number or null, as data.reward_shift: what is collected later is not known yet"
        fewer = "known, or a smaller data.prior_share: rewards are learnt from what is collected"
        noise = settings["noise_scale"]
        rules = [
            ("reward_scale", not auto, number),
            ("prior_share", 0 <= share <= 1, "a share in [0, 1]"),
            ("prior_rewards", known or prior is not None, "known: there are no prior data (data.data)"),
            ("prior_rewards", known or _prior_rows(settings) < settings["batch_size"], fewer),
            ("batch_size", settings["batch_size"] >= 1, "at least 1"),
            ("updates", settings["updates"] > 0, "positive"),
            ("random_steps", settings["random_steps"] >= 1, "at least 1: the first batch needs transitions"),
            ("num_envs", settings["num_envs"] >= 1, "at least 1"),
            ("bound", settings["bound"] > 0, "positive"),
            ("noise_scale", noise is None or noise >= 0, "null or 0 or more"),
        ]
        for name, fine, expected in rules:
            if not fine:
                raise UserError(f"data.{name} is {settings[name]}, expected {expected}")

    @property
    def batch_size(self) -> int:
        """B."""
        return int(self.hparams.batch_size)

    @property
    def prior_rows(self) -> int:
        """How many transitions of a batch are prior data, the last ones."""
        return _prior_rows(self.hparams)

    def make_env(self) -> SkillEnv:
        """The task's environment, acted on by skills."""
        h, settled = self.hparams, self.relabelling.for_task(self.task)
        scale: Any = settled.reward_scale
        shift: Any = settled.reward_shift
        return SkillEnv(
            self.task.make_env(),
            self.skill,
            gamma=settled.gamma,
            discount=settled.discount,
            reward_scale=scale,
            reward_shift=shift,
            noise_scale=h.noise_scale,
            bound=h.bound,
        )

    def prepare_data(self) -> None:
        """Relabel the prior data, unless that was done before."""
        if self._prior_module is not None:
            self._prior_module.prepare_data()

    def setup(self, stage: str | None = None) -> None:
        """Build the environments, so that what does not fit is found before the first file is written."""
        if stage != "fit":
            raise UserError("online training has no held-out data: measure the agent with `dds evaluate`")
        if self.trainer is not None:
            refuse_other_rounds(self.trainer)
        if self.loader is not None:
            return
        if self._prior_module is not None:
            self._prior_module.setup()
            self.prior = self._prior_module.transitions
        self.loader = OnlineLoader(self)

    def statistics(self) -> dict[str, Tensor]:
        """Normalisation of observations: the skill model's, or none; bounds of the choices where they are numbers."""
        width = self.observation_dim
        units = {"observation_mean": torch.zeros(width), "observation_std": torch.ones(width)}
        if self.model is not None:
            units = {"observation_mean": self.model.normaliser.mean, "observation_std": self.model.normaliser.std}
        if self.space == "discrete":
            return units
        assert self.loader is not None, "setup('fit') comes first"
        box: Any = self.loader.collector.envs[0].action_space
        return {**units, "action_low": torch.from_numpy(box.low), "action_high": torch.from_numpy(box.high)}

    def collected(self) -> dict[str, float]:
        """How the episodes went that were collected, see `Collector.summary`."""
        return {} if self.loader is None else self.loader.collector.summary()

    def train_dataloader(self) -> OnlineLoader:
        """Batches without end, each after the decisions that are due before it."""
        assert self.loader is not None, "setup('fit') comes first"
        return self.loader

    def val_dataloader(self) -> list[Any]:
        """None: what counts is how the policy plays."""
        return []

    def state_dict(self) -> dict[str, Any]:
        """Which prior data the training has."""
        return {"prior": None if self._prior_module is None else self._prior_module.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Refuse to go on with other prior data, with some where there were none, or without.

        Raises:
            UserError: They differ.
        """
        there = state_dict["prior"]
        if self._prior_module is not None and there is not None:
            self._prior_module.load_state_dict(there)
        elif self._prior_module is not None or there is not None:
            was = "none" if there is None else there["name"]
            raise UserError(
                f"data.data is {self.hparams.data or 'not given'}, but the checkpoint's training had {was} as prior "
                "data: give the same, or start anew from its weights with --model.init_from"
            )

    def teardown(self, stage: str) -> None:
        """Close the environments."""
        if self.loader is not None:
            self.loader.collector.close()


def _prior_rows(settings: Mapping[str, Any]) -> int:
    return 0 if settings["data"] is None else round(settings["batch_size"] * settings["prior_share"])


class OnlineLoader:
    """Batches from the replay and the prior data; the policy of the module in training collects in between.

    Args:
        data: The data module.
    """

    def __init__(self, data: OnlineDataModule) -> None:
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
