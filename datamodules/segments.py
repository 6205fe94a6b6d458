"""Batches of segments for skill training: all tensors in memory, each batch one fancy index."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, Literal

import lightning.pytorch as pl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.collect.collectors import can_collect
from datamodules.loader import Batch, TensorLoader, data_state, overfits, refuse_other_data
from datamodules.sources import load_trajectories
from datamodules.trajectories import Trajectories, Windows
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.nn.normaliser import MIN_STD
from dds_lightning.tasks import get_task

STD_FLOOR = MIN_STD
"""Standard deviations are at least this, so that an observation that never changes does not divide by
zero."""


MORE_HELD_OUT = 0.2
"""Share of the steps that may be held out beyond what was asked for without a warning."""


class SegmentDataModule(pl.LightningDataModule):
    """Sliding windows over offline episodes, as batches `{"observations": (B, H, O), "actions": (B, H, A)}`.

    Beside them `"starts"` (B,) says in which row of the data's actions each segment starts. Values are in raw units;
    the model normalises with `statistics()`. Windows never cross an episode. Training and validation share no episode.

    For your own arrays: `SegmentDataModule.from_trajectories(Trajectories.from_episodes("mine", episodes))`;
    the docstring of `datamodules.trajectories` shows the form of `episodes`.

    Attributes:
        trajectories: All data, after `setup`.
        task: The task of the data; after `setup` the variant in which they were recorded.
        horizon: H.
    """

    trajectories: Trajectories
    tail: Literal["full", "terminated"] = "full"
    """Whether segments that a termination cuts short count, see `datamodules.windows.sliding_windows`."""

    def __init__(
        self,
        task: str | None = None,
        data: str | None = None,
        horizon: int = 10,
        stride: int = 1,
        batch_size: int = 128,
        validation_fraction: float = 0.05,
        seed: int | None = None,
        device_resident: bool = False,
        max_validation_segments: int = 4096,
    ) -> None:
        """Choose the data; nothing is read yet.

        Args:
            task: Name of a task (`dds tasks` lists them). The data must fit it. None accepts any valid data.
            data: For example `local:DIR`, `minari:ID` or `d4rl:FILE`, see `datamodules.load_trajectories`.
            horizon: H, steps of a segment.
            stride: Steps between segments: 1 takes every window, H divides episodes into separate segments.
            batch_size: B.
            validation_fraction: Share of the steps, in whole episodes, that is held out for validation.
            seed: Seed of the split and of the order of batches. On the command line it follows `--seed_everything`;
                None means 0.
            device_resident: Keep the data on the training device; batches are then made there.
            max_validation_segments: Greatest number of segments, evenly spread, that are validated.
        """
        super().__init__()
        for name, value in (("horizon", horizon), ("stride", stride), ("batch_size", batch_size)):
            if value < 1:
                raise UserError(f"{name}: got {value}, expected at least 1")
        if max_validation_segments < 1:
            raise UserError(f"max_validation_segments: got {max_validation_segments}, expected at least 1")
        if not 0.0 <= validation_fraction < 1.0:
            raise UserError(f"validation_fraction: got {validation_fraction}, expected 0 to less than 1")
        refuse_seed("data.seed", seed or 0)
        self.task = get_task(task) if task is not None else None
        self.data, self.horizon, self.stride, self.batch_size = data, horizon, stride, batch_size
        self.validation_fraction, self.seed = validation_fraction, seed or 0
        self.device_resident, self.max_validation_segments = device_resident, max_validation_segments
        self._windows: Windows | None = None
        self._on_device: dict[torch.device, tuple[Tensor, Tensor]] = {}

    @classmethod
    def from_trajectories(cls, trajectories: Trajectories, **options: Any) -> SegmentDataModule:
        """Use trajectories that are in memory already; `options` are arguments of the constructor."""
        module = cls(**options)
        module.trajectories = trajectories
        return module

    # ------------------------------------------------------------------ what the model needs to know

    @property
    def observation_dim(self) -> int:
        """O, from the task, or from the data without one."""
        return self.task.observation_dim if self.task is not None else self._loaded().observation_dim

    @property
    def action_dim(self) -> int:
        """A, from the task, or from the data without one."""
        return self.task.action_dim if self.task is not None else self._loaded().action_dim

    def statistics(self) -> dict[str, Tensor]:
        """Statistics of the training episodes, float32.

        Returns:
            `observation_mean` and `observation_std` (O,), the latter at least `STD_FLOOR`; `action_low` and
            `action_high` (A,).
        """
        self.setup()
        data = self.trajectories
        chosen = np.zeros(data.num_episodes, bool)
        chosen[self.training_episodes] = True
        rows = np.flatnonzero(np.repeat(chosen, data.lengths + 1))
        total = np.zeros(data.observation_dim)
        for part in _parts(rows):
            total += data.observations[part].sum(axis=0, dtype=np.float64)
        mean = total / len(rows)
        squares = np.zeros_like(mean)
        for part in _parts(rows):
            squares += np.square(data.observations[part] - mean).sum(axis=0)
        std = np.maximum(np.sqrt(squares / len(rows)), STD_FLOOR)
        return {
            "observation_mean": torch.from_numpy(mean.astype(np.float32)),
            "observation_std": torch.from_numpy(std.astype(np.float32)),
            "action_low": torch.tensor(data.action_low),
            "action_high": torch.tensor(data.action_high),
        }

    # ------------------------------------------------------------------ Lightning's hooks

    def setup(self, stage: str | None = None) -> None:
        """Read the data, find the windows and split by episode; a second call does nothing."""
        if self._windows is not None:
            return
        data = self._loaded()
        self._windows = data.windows(self.horizon, self.stride, self.tail)
        self.training_episodes, self.validation_episodes = data.split(self.validation_fraction, self.seed, self.horizon)
        self._warn_of_lost_data(data)
        held_out = np.isin(self._windows.episodes, self.validation_episodes)
        self.training_segments = np.flatnonzero(~held_out)
        self.validation_segments = np.flatnonzero(held_out)
        if len(self.validation_segments) > self.max_validation_segments:
            spread = np.linspace(0, len(self.validation_segments) - 1, self.max_validation_segments)
            self.validation_segments = self.validation_segments[spread.round().astype(np.int64)]
        # In a random order, so that the first batches, all that a training may look at, are a fair sample: in many a
        # file the episodes of one controller come before those of another.
        np.random.default_rng(0).shuffle(self.validation_segments)

    def _warn_of_lost_data(self, data: Trajectories) -> None:
        """Warn where whole episodes are so long that far more than `validation_fraction` is not learnt from."""
        share = data.lengths[self.validation_episodes].sum() / data.num_steps
        if share > self.validation_fraction + MORE_HELD_OUT:
            warnings.warn(
                f"data.validation_fraction is {self.validation_fraction:g}, but whole episodes are held out, and with "
                f"{data.num_episodes} of them that is {share:.0%} of the steps: record more episodes, cut long ones, "
                "or give 0 and do without held-out loss",
                stacklevel=3,
            )

    def train_dataloader(self) -> TensorLoader:
        """Shuffled, full batches, shared among processes."""
        self.setup()
        trainer = self.trainer
        rank, world = (trainer.global_rank, trainer.world_size) if trainer is not None else (0, 1)
        shuffle = not overfits(trainer)
        return self._loader(
            self.training_segments, shuffle=shuffle, seed=self.seed, drop_last=True, rank=rank, world_size=world
        )

    def val_dataloader(self) -> TensorLoader | list[Any]:
        """The same segments in the same random order every time; none when `validation_fraction` is 0."""
        self.setup()
        if overfits(self.trainer):
            return self.train_dataloader()
        return self._loader(self.validation_segments) if len(self.validation_segments) else []

    def test_dataloader(self) -> TensorLoader | list[Any]:
        """As for validation."""
        return self.val_dataloader()

    def predict_dataloader(self) -> TensorLoader:
        """Every segment, in order."""
        self.setup()
        assert self._windows is not None
        return self._loader(np.arange(len(self._windows)))

    def state_dict(self) -> dict[str, Any]:
        """Which data these are, for every checkpoint."""
        return data_state(self._loaded())

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Refuse to go on with other data; `Trainer.validate` and its like may look at any."""
        refuse_other_data(state_dict, self._loaded(), self.trainer)

    # ------------------------------------------------------------------ helpers

    def _loaded(self) -> Trajectories:
        if not hasattr(self, "trajectories"):
            if self.data is None:
                raise UserError(self._how_to_get_data())
            self.trajectories = load_trajectories(self.data, self.task)
            self.task = self.trajectories.task
        return self.trajectories

    def _how_to_get_data(self) -> str:
        if self.task is None:
            return "data: expected a task or data, got neither; give at least data, for example local:DIR"
        if not can_collect(self.task):
            return f"data: none were given for task '{self.task.name}'; give d4rl:FILE or minari:ID"
        collected = f"`dds data collect {self.task.name} --out data`"
        place = f"local:data/{self.task.data_ids.get('local', self.task.name)}"
        return f"data: none were given for task '{self.task.name}'; {collected} collects some, then give {place}"

    def _loader(self, segments: NDArray[np.int64], **options: Any) -> TensorLoader:
        assert self._windows is not None
        device = self._place()
        observations, actions = self._tensors(device)
        first_rows = torch.from_numpy(self._windows.observation_starts[segments]).to(device)
        first_steps = torch.from_numpy(self._windows.starts[segments]).to(device)
        span = torch.arange(self.horizon, device=device)

        def gather(index: Tensor) -> Batch:
            return {
                "observations": observations[first_rows[index, None] + span],  # (B, H, O)
                "actions": actions[first_steps[index, None] + span],  # (B, H, A)
                "starts": first_steps[index],
            }

        return TensorLoader(gather, len(segments), self.batch_size, device=device, **options)

    def _place(self) -> torch.device:
        if self.device_resident and self.trainer is not None:
            return self.trainer.strategy.root_device
        return torch.device("cpu")

    def _tensors(self, device: torch.device) -> tuple[Tensor, Tensor]:
        if device not in self._on_device:
            with warnings.catch_warnings():
                # Memory maps are read-only, and batches are copies: nothing writes through these tensors.
                warnings.filterwarnings("ignore", message=".*not writable.*")
                observations = torch.from_numpy(self.trajectories.observations).to(device)
                actions = torch.from_numpy(self.trajectories.actions).to(device)
            self._on_device[device] = (observations, actions)
        return self._on_device[device]


def _parts(rows: NDArray[np.int64], size: int = 1 << 20) -> Iterator[NDArray[np.int64]]:
    for start in range(0, len(rows), size):
        yield rows[start : start + size]
