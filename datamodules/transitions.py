"""What baselines learn from: single steps, segments under continuous skills, and sequences with returns to go.

All three are `SegmentDataModule`s: the same data, the same split, the same order. Rewards are scaled and shifted as in
`Relabelling`; terminations cut the bootstrap, truncations do not.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.loader import Batch, TensorLoader
from datamodules.relabel import check_widths
from datamodules.relabelling import Relabelling, returns_to_go
from datamodules.segments import SegmentDataModule
from dds_lightning.envs.semi_mdp import fold
from dds_lightning.errors import UserError
from dds_lightning.skill import SkillModule


class TransitionDataModule(SegmentDataModule):
    """Single steps, as batches for a critic.

    A batch is ``{"observations": (B, O), "actions": (B, A), "rewards": (B,), "next_observations": (B, O),
    "discounts": (B,), "dones": (B,)}``.

    Args:
        task: Name of a task; None accepts any valid data.
        data: For example `local:DIR`, see `datamodules.load_trajectories`.
        batch_size: B.
        validation_fraction: Share of the steps, in whole episodes, that is held out for validation.
        seed: Seed of the split and of the order of batches; it follows `--seed_everything`.
        device_resident: Keep the data on the training device.
        max_validation_segments: Greatest number of steps that are validated.
        **relabelling: Fields of `Relabelling`.
    """

    tail = "terminated"

    def __init__(
        self,
        task: str | None = None,
        data: str | None = None,
        batch_size: int = 256,
        validation_fraction: float = 0.05,
        seed: int | None = None,
        device_resident: bool = False,
        max_validation_segments: int = 4096,
        **relabelling: Any,
    ) -> None:
        self.relabelling = Relabelling(**relabelling)
        options: dict[str, Any] = {"validation_fraction": validation_fraction, "seed": seed}
        options |= {"device_resident": device_resident, "max_validation_segments": max_validation_segments}
        super().__init__(task, data, 1, self.relabelling.stride, batch_size, **options)

    def choices(self) -> Tensor:
        """What was chosen at the start of each window, (M, A)."""
        assert self._windows is not None
        return torch.from_numpy(self.trajectories.actions[self._windows.starts])

    def _loader(self, segments: NDArray[np.int64], **options: Any) -> TensorLoader:
        assert self._windows is not None
        device = self._place()
        observations, _ = self._tensors(device)
        w, settled = self._windows, self.relabelling.for_task(self.task)
        learning = settled.learning_rewards(self.trajectories, self.horizon)
        rewards, discounts = fold(learning, w.starts, w.lengths, settled.gamma, settled.discount)
        ends = self.trajectories.terminations[w.starts + w.lengths - 1]
        chosen = self._choices_of(segments, device)
        columns = {
            name: torch.as_tensor(values[segments], dtype=torch.float32, device=device)
            for name, values in (("rewards", rewards), ("discounts", discounts), ("dones", ends))
        }
        first = torch.from_numpy(w.observation_starts[segments]).to(device)
        after = torch.from_numpy((w.observation_starts + w.lengths)[segments]).to(device)

        def gather(index: Tensor) -> Batch:
            return {
                "observations": observations[first[index]],
                "actions": chosen[index],
                "next_observations": observations[after[index]],
                **{name: column[index] for name, column in columns.items()},
            }

        return TensorLoader(gather, len(segments), self.batch_size, device=device, **options)

    def _choices_of(self, segments: NDArray[np.int64], device: torch.device) -> Tensor:
        return self.choices()[torch.from_numpy(segments)].to(device)


class LatentDataModule(TransitionDataModule):
    """Segments of H steps as transitions, whose action is the continuous skill (B, D) that encodes them.

    A skill is the mean of the encoder's Gaussian. All segments are encoded once, when training starts.

    Args:
        task: Name of a task; None accepts any valid data.
        data: For example `local:DIR`, see `datamodules.load_trajectories`.
        skill: Skill checkpoint with continuous skills (``dds skill fit --model.bottleneck=gaussian``).
        batch_size: B.
        validation_fraction: Share of the steps, in whole episodes, that is held out for validation.
        seed: Seed of the split and of the order of batches; it follows `--seed_everything`.
        device_resident: Keep the data on the training device.
        max_validation_segments: Greatest number of segments that are validated.
        **relabelling: Fields of `Relabelling`.

    Attributes:
        skill_dim: D.
        skill_hash: Fingerprint of the skill model.
    """

    def __init__(
        self,
        task: str | None = None,
        data: str | None = None,
        skill: str | None = None,
        batch_size: int = 256,
        validation_fraction: float = 0.05,
        seed: int | None = None,
        device_resident: bool = False,
        max_validation_segments: int = 4096,
        **relabelling: Any,
    ) -> None:
        if skill is None:
            raise UserError("data.skill is missing: give the skill checkpoint (.ckpt or directory) to encode with")
        super().__init__(
            task,
            data,
            batch_size,
            validation_fraction,
            seed,
            device_resident,
            max_validation_segments,
            **relabelling,
        )
        self.relabelling = Relabelling(**relabelling)  # told once more so that the command line finds its fields
        self.save_hyperparameters("skill")  # what a refusal names
        self.skill = SkillModule.load(skill)
        if self.skill.discrete:
            raise UserError(
                f"data.skill is {skill}, whose skills are discrete: give continuous ones, trained with "
                "`dds skill fit --model.bottleneck=gaussian`"
            )
        self.horizon, self.skill_hash = self.skill.horizon, self.skill.fingerprint()
        self.skill_dim: int = self.skill.hparams.skill_dim
        self._skills: Tensor | None = None

    @torch.inference_mode()
    def choices(self) -> Tensor:
        """The skill of each window, (M, D)."""
        if self._skills is None:
            assert self._windows is not None
            data, w = self.trajectories, self._windows
            check_widths(data, self.skill)
            steps = np.minimum(np.arange(self.horizon), w.lengths[:, None] - 1)  # a short one repeats its last step
            parts = []
            for first in range(0, len(w), 2048):
                rows = slice(first, first + 2048)
                lengths = torch.from_numpy(w.lengths[rows])
                encoded = self.skill.encode_segments(
                    torch.from_numpy(data.observations[w.observation_starts[rows, None] + steps[rows]]),
                    torch.from_numpy(data.actions[w.starts[rows, None] + steps[rows]]),
                    lengths if bool((lengths < self.horizon).any()) else None,
                )
                parts.append(encoded.vectors)
            self._skills = torch.cat(parts)
        return self._skills

    def statistics(self) -> dict[str, Tensor]:
        """As of a `SegmentDataModule`, with mean and deviation (D,) of the skills of the training episodes."""
        found = super().statistics()
        skills = self.choices()[torch.from_numpy(self.training_segments)]
        return {**found, "skill_mean": skills.mean(dim=0), "skill_std": skills.std(dim=0)}


class SequenceDataModule(SegmentDataModule):
    """Segments with what is still to be earned.

    A batch is ``{"observations": (B, H, O), "actions": (B, H, A), "rewards": (B, H), "returns": (B, H),
    "steps": (B, H)}``: learning rewards, the sum of these from each step to the end of its episode, discounted by
    gamma, and the number of the step in its episode, from 0. Episodes shorter than H are left out.

    Args:
        task: Name of a task; None accepts any valid data.
        data: For example `local:DIR`, see `datamodules.load_trajectories`.
        horizon: H, steps of a segment.
        batch_size: B.
        validation_fraction: Share of the steps, in whole episodes, that is held out for validation.
        seed: Seed of the split and of the order of batches; it follows `--seed_everything`.
        device_resident: Keep the data on the training device.
        max_validation_segments: Greatest number of segments that are validated.
        **relabelling: Fields of `Relabelling`.
    """

    def __init__(
        self,
        task: str | None = None,
        data: str | None = None,
        horizon: int = 20,
        batch_size: int = 64,
        validation_fraction: float = 0.05,
        seed: int | None = None,
        device_resident: bool = False,
        max_validation_segments: int = 4096,
        **relabelling: Any,
    ) -> None:
        self.relabelling = Relabelling(**relabelling)
        options: dict[str, Any] = {"validation_fraction": validation_fraction, "seed": seed}
        options |= {"device_resident": device_resident, "max_validation_segments": max_validation_segments}
        super().__init__(task, data, horizon, self.relabelling.stride, batch_size, **options)

    @cached_property
    def _rewards(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Learning rewards and returns to go of every step, (N,) each; only after `setup`."""
        settled = self.relabelling.for_task(self.task)
        rewards = settled.learning_rewards(self.trajectories, 1)
        returns = returns_to_go(rewards, self.trajectories.lengths, settled.gamma)
        return rewards.astype(np.float32), returns.astype(np.float32)

    def statistics(self) -> dict[str, Tensor]:
        """As of a `SegmentDataModule`, and what rewards and returns are.

        Returns:
            Also ``reward_affine`` (2,), scale and shift of the learning rewards; ``return_range`` (2,), the least and
            the greatest return to go at the first step of an episode for training, and ``return_to_go_range`` (2,), at
            the first step of a segment for training.
        """
        found = super().statistics()
        _, returns = self._rewards
        assert self._windows is not None
        first = returns[self.trajectories.step_offsets[self.training_episodes]]
        starts = returns[self._windows.starts[self.training_segments]]
        affine = self.relabelling.for_task(self.task).affine(self.trajectories, 1)
        return {
            **found,
            "reward_affine": torch.tensor(affine),
            "return_range": torch.tensor([first.min(), first.max()]).float(),
            "return_to_go_range": torch.tensor([starts.min(), starts.max()]).float(),
        }

    def _loader(self, segments: NDArray[np.int64], **options: Any) -> TensorLoader:
        assert self._windows is not None
        device = self._place()
        observations, actions = self._tensors(device)
        rewards, returns = (torch.as_tensor(column, device=device) for column in self._rewards)
        lengths, offsets = self.trajectories.lengths, self.trajectories.step_offsets
        number = torch.from_numpy(np.arange(len(rewards)) - np.repeat(offsets[:-1], lengths)).to(device)
        first_rows = torch.from_numpy(self._windows.observation_starts[segments]).to(device)
        first_steps = torch.from_numpy(self._windows.starts[segments]).to(device)
        span = torch.arange(self.horizon, device=device)

        def gather(index: Tensor) -> Batch:
            steps = first_steps[index, None] + span  # (B, H)
            return {
                "observations": observations[first_rows[index, None] + span],
                "actions": actions[steps],
                "rewards": rewards[steps],
                "returns": returns[steps],
                "steps": number[steps],
            }

        return TensorLoader(gather, len(segments), self.batch_size, device=device, **options)
