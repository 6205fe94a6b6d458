"""The data of online training: collection and updates in turn, beside prior data where there are some.

```
 env ─► SkillEnv ─► replay ──┬─► batch ─► update
  ▲                          │
  └──── policy ◄─── trainer  └─ prior data, relabelled (half of each batch)
```
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from torch import Tensor

from datamodules.loader import refuse_other_rounds
from datamodules.online_batches import OnlineLoader
from datamodules.relabelled import RelabeledDataModule
from datamodules.relabelling import Relabelling
from datamodules.robots import load_skills
from datamodules.semi_mdp import Relabelled
from dds_lightning.errors import UserError
from dds_lightning.online.skill_env import BOUND, SkillEnv
from dds_lightning.tasks import Task, get_task


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
