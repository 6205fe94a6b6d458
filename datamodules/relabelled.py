"""The semi-MDP transitions as a data module: relabel once, keep the result on disk, serve batches from memory."""

import hashlib
import json
import logging
import os
from functools import cached_property
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from datamodules.loader import TensorLoader, data_state, overfits, refuse_other_data
from datamodules.partial_codes import PartialCodes
from datamodules.relabel import refuse_other_transitions, relabel, relabel_key
from datamodules.relabelling import Relabelling
from datamodules.robots import load_skills
from datamodules.semi_mdp import Relabelled
from datamodules.sources import load_trajectories
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.nn.precision import fastest_precision
from dds_lightning.saving.files import home
from dds_lightning.saving.fingerprint import halves
from dds_lightning.tasks import Task, get_task

log = logging.getLogger(__name__)
LONG = 20_000
"""Segments from which on it is worth measuring whether the encoder is faster in bfloat16."""


class RelabeledDataModule(pl.LightningDataModule):
    """Semi-MDP transitions of a data set under the skills of a checkpoint.

    Relabelling runs once: its result is stored under ``cache`` in a file named after the hash of data, all that decides
    the codes of the skills, and every field of `Relabelling`, so that nothing stale is ever read.

    Args:
        task: Name of a task (``dds tasks``); null for your own data. After ``setup`` the attribute ``task`` is the
            variant in which the data were recorded.
        data: Where the data are, e.g. ``local:DIR``, ``minari:ID`` or ``d4rl:FILE``.
        skill: Skill checkpoint: a Lightning ``.ckpt`` or a published directory.
        relabelled: Read this file (of ``dds relabel``) instead of the cache; refused if it was made from anything else.
        cache: Folder of the cache; null puts it beside the skill checkpoint, or in the user's cache folder where that
            is a published directory.
        batch_size: Transitions per batch.
        validation_fraction: Share of the episodes held out.
        seed: Seed of the split and of the order. On the command line it follows ``--seed_everything``; null means 0.
        device_resident: Keep the transitions on the accelerator.
        **relabelling: Fields of `Relabelling`: gamma, discount, stride, reward_scale, reward_shift.

    Attributes:
        relabelling: The settings of relabelling as they were given; ``settings`` has the task's in place of None.
    """

    hparams: Any  # Lightning types it as a mapping, but it also has attributes

    def __init__(
        self,
        task: str | None = None,
        data: str | None = None,
        skill: str | None = None,
        relabelled: str | None = None,
        cache: str | None = None,
        batch_size: int = 256,
        validation_fraction: float = 0.05,
        seed: int | None = None,
        device_resident: bool = False,
        **relabelling: Any,
    ) -> None:
        super().__init__()
        seed = seed or 0
        refuse_seed("data.seed", seed)
        self.relabelling = Relabelling(**relabelling)
        relabelling.update(self.relabelling.settings())  # defaults included
        self.save_hyperparameters()
        self.task: Task | None = get_task(task) if task else None
        if skill is None:
            raise UserError("data.skill is missing: give the skill checkpoint (.ckpt or directory) to relabel with")
        if not 0.0 <= validation_fraction < 1.0:
            raise UserError(f"data.validation_fraction is {validation_fraction}, expected a share in [0, 1)")
        self.skill = load_skills(skill, self.task)
        self.observation_dim: int = self.skill.hparams.observation_dim
        self.num_skills: int = self.skill.num_skills
        self.skill_hash = self.skill.fingerprint()
        self.transitions: Relabelled | None = None
        self._given: Trajectories | None = None

    @classmethod
    def from_trajectories(cls, trajectories: Trajectories, skill: str, **settings: Any) -> "RelabeledDataModule":
        """Build the module over trajectories already in memory."""
        module = cls(skill=skill, **settings)
        module._given = trajectories
        return module

    @cached_property
    def trajectories(self) -> Trajectories:
        """The data set, loaded at first use; from then on ``task`` is the variant in which it was recorded."""
        if self._given is not None:
            return self._given
        if self.hparams.data is None:
            raise UserError(
                "data.data is missing: give local:DIR, minari:ID or d4rl:FILE, or collect with `dds data collect TASK`"
            )
        trajectories = load_trajectories(self.hparams.data, self.task)
        self.task = trajectories.task
        return trajectories

    @property
    def batch_size(self) -> int:
        """B."""
        return int(self.hparams.batch_size)

    @property
    def horizon(self) -> int:
        """H, of the skills."""
        return self.skill.horizon

    @property
    def settings(self) -> dict[str, Any]:
        """What relabelling depends on beside data and skills: the fields of `Relabelling`."""
        return self.relabelling.for_task(self.task).settings()

    @cached_property
    def key(self) -> dict[str, str | int | float]:
        """Everything the relabelled data depend on; computed once, because it hashes data and weights."""
        return relabel_key(self.trajectories, self.skill, self.relabelling.for_task(self.task))

    def cache_file(self) -> Path:
        """File of the relabelled data of exactly these inputs, whatever the decoder, or that of an earlier version."""
        codes, whole = halves(self.skill_hash)
        keys = [json.dumps({**self.key, "skill": skill}, sort_keys=True) for skill in (codes, whole)]
        names = [hashlib.sha256(key.encode()).hexdigest()[:16] for key in keys]
        files = [self._cache_folder() / f"relabelled-{name}.safetensors" for name in names]
        return next((file for file in files if file.exists()), files[0])

    def _cache_folder(self) -> Path:
        """The given folder, else beside the checkpoint of a training; nothing is added to a published directory."""
        if self.hparams.cache:
            return Path(self.hparams.cache)
        skill = Path(self.hparams.skill)
        if not skill.is_dir():
            return skill.parent
        return Path(os.environ.get("XDG_CACHE_HOME") or home() / ".cache") / "dds-lightning"

    def prepare_data(self) -> None:
        """Relabel, unless the result of exactly these inputs is stored."""
        if self.hparams.relabelled is None and not self.cache_file().exists():
            self.relabel_into(self.cache_file())

    def relabel_into(self, path: Path) -> Relabelled:
        """Relabel and write the result to `path`; repeating a call that was stopped continues it.

        Much data are encoded in bfloat16 where that is faster, as in a training with `precision: auto`.
        """
        relabelling = self.relabelling.for_task(self.task)
        long = len(self.trajectories.rewards) > LONG * relabelling.stride
        precision: Any = fastest_precision().precision if long else "32-true"
        partial = PartialCodes(path, {**self.key, "precision": precision})
        made = relabel(self.trajectories, self.skill, relabelling, precision=precision, progress=True, partial=partial)
        made.save(path, self.key)
        partial.remove()
        log.info("relabelled %d segments into %s", len(made), path)
        return made

    def setup(self, stage: str | None = None) -> None:
        """Read the transitions and split them by episode."""
        if self.transitions is not None:
            return
        path = Path(self.hparams.relabelled) if self.hparams.relabelled else self.cache_file()
        transitions = Relabelled.load(path, self.key)
        refuse_other_transitions(transitions, self.trajectories, self.skill, self.relabelling.for_task(self.task), path)
        self.transitions = transitions
        h = self.hparams
        _, held_out = self.trajectories.split(h.validation_fraction, h.seed, self.skill.horizon)
        validates = torch.isin(self.transitions.episodes, torch.as_tensor(held_out))
        self.train_index = torch.nonzero(~validates).flatten()
        held = torch.nonzero(validates).flatten()
        # In a random order, as in SegmentDataModule: the first batches are a fair sample of all episodes.
        self.validation_index = held[torch.randperm(len(held), generator=torch.Generator().manual_seed(0))]

    def statistics(self) -> dict[str, Any]:
        """What the policy needs of the data: normalisation, code shares, range of rewards, discount of values."""
        assert self.transitions is not None, "setup() comes first"
        t, i = self.transitions, self.train_index
        observations, rewards = t.observations[i], t.rewards[i]
        counts = torch.bincount(t.codes[i], minlength=self.num_skills).float()
        return {
            "observation_mean": observations.mean(dim=0),
            "observation_std": observations.std(dim=0),
            "code_share": counts / counts.sum(),
            "reward_range": (rewards.min().item(), rewards.max().item()),
            "max_discount": (t.discounts * (1.0 - t.dones))[i].max().item(),  # after an end no value follows
        }

    def state_dict(self) -> dict[str, Any]:
        """Which data these are, for every checkpoint."""
        return data_state(self.trajectories)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Refuse to go on with other data; `Trainer.validate` and its like may look at any."""
        refuse_other_data(state_dict, self.trajectories, self.trainer)

    def _loader(self, index: Tensor, train: bool = False) -> TensorLoader:
        assert self.transitions is not None, "setup() comes first"
        trainer = self.trainer
        device = torch.device("cpu")
        if self.hparams.device_resident and trainer is not None:
            device = trainer.strategy.root_device
        transitions, rows = self.transitions.to(device), index.to(device)

        def gather(chosen: Tensor) -> dict[str, Tensor]:
            return transitions.batch(rows[chosen])

        h = self.hparams
        options: dict[str, Any] = {"device": device}
        if train:
            rank, world = (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)
            options |= {
                "shuffle": not overfits(trainer),
                "seed": h.seed,
                "drop_last": True,
                "rank": rank,
                "world_size": world,
            }
        return TensorLoader(gather, len(index), h.batch_size, **options)

    def train_dataloader(self) -> TensorLoader:
        """Shuffled batches; the order is a function of seed and epoch."""
        return self._loader(self.train_index, train=True)

    def val_dataloader(self) -> TensorLoader | list[Any]:
        """The held-out episodes' transitions in a fixed random order; none when ``validation_fraction`` is 0."""
        if overfits(self.trainer):
            return self.train_dataloader()
        return self._loader(self.validation_index) if len(self.validation_index) else []

    test_dataloader = val_dataloader

    def predict_dataloader(self) -> TensorLoader:
        """Every transition, in order."""
        assert self.transitions is not None, "setup() comes first"
        return self._loader(torch.arange(len(self.transitions)))
