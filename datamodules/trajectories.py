"""The container of offline data: flat arrays for episodes of different lengths.

    episode 0 (T = 3)                 episode 1 (T = 2)
    o0  o1  o2  o3                    o4  o5  o6              observations, N + E rows
      a0  a1  a2                        a3  a4                actions, rewards, flags: N rows
                └ terminations or         └
                  truncations True

Step `s` of episode `e` acts on observation row `s + e` and leads to row `s + e + 1`.

Your own arrays become `Trajectories` by `Trajectories.from_episodes`:

    episodes = [
        {
            "observations": ...,   # (T + 1, O), the state after the last step included
            "actions": ...,        # (T, A), inside the box
            "rewards": ...,        # (T,)
            "terminations": ...,   # (T,) True on the last step if the task ended there (no bootstrap beyond)
            "truncations": ...,    # (T,) True on the last step if only the recording ended there
        },
    ]
    data = SegmentDataModule.from_trajectories(Trajectories.from_episodes("mine", episodes), horizon=10)
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.storage import read_arrays, save_arrays
from datamodules.validation import DataError, check_box, validate_arrays, validate_episode
from datamodules.windows import Windows, ranges, sliding_windows
from dds_lightning.tasks import Task

__all__ = ["DataError", "Trajectories", "Windows"]

ARRAY_TYPES = {
    "observations": np.float32,
    "actions": np.float32,
    "rewards": np.float32,
    "terminations": np.bool_,
    "truncations": np.bool_,
    "lengths": np.int64,
    "action_low": np.float32,
    "action_high": np.float32,
}
"""Every array of a `Trajectories` and its type."""


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Episodes in flat arrays (in memory or memory-mapped); see the picture in the module's docstring.

    Create one with `from_episodes`, `load` or `datamodules.load_trajectories`: these check their input.

    Attributes:
        name: Name of the data set.
        observations: (N + E, O) float32; episode e has lengths[e] + 1 rows.
        actions: (N, A) float32.
        rewards: (N,) float32, in the environment's units (the task's scale and shift are applied later).
        terminations: (N,) bool, True where the task ended, so that there is nothing to bootstrap from.
        truncations: (N,) bool, True where only the recording ended.
        lengths: (E,) int64, number of steps of each episode.
        action_low: (A,) float32.
        action_high: (A,) float32.
        task: The task, in its variant, that the data were loaded for; None if unknown. It is neither stored nor part
            of the fingerprint.
        steps_left_out: Steps that the source holds beside these, because it does not say where they led or because they
            are beyond a maze's goal; not stored either.
    """

    name: str
    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    terminations: NDArray[np.bool_]
    truncations: NDArray[np.bool_]
    lengths: NDArray[np.int64]
    action_low: NDArray[np.float32]
    action_high: NDArray[np.float32]
    task: Task | None = field(default=None, kw_only=True)
    steps_left_out: int = field(default=0, kw_only=True)

    # ------------------------------------------------------------------ creating one

    @classmethod
    def from_episodes(
        cls,
        name: str,
        episodes: Sequence[Mapping[str, Any]],
        *,
        action_low: ArrayLike = -1.0,
        action_high: ArrayLike = 1.0,
        observation_dim: int | None = None,
        action_dim: int | None = None,
        episode_names: Sequence[str] | None = None,
    ) -> Trajectories:
        """Check episodes and concatenate them.

        Args:
            name: Name of the data set, for messages.
            episodes: Mappings with the five fields in the module's docstring; other entries are ignored.
            action_low: Lower bounds of actions, one number or (A,).
            action_high: Upper bounds of actions, one number or (A,).
            observation_dim: O; None takes the first episode's.
            action_dim: A; None takes the first episode's.
            episode_names: What messages call the episodes; None counts from "episode 0".

        Raises:
            DataError: When there is no episode, or one is invalid; the message names the data set, the episode, the
                field and the value.
        """
        if not len(episodes):
            raise DataError(f"data set '{name}' is empty: it has no episodes; give at least one")
        if isinstance(episodes, Mapping):
            raise DataError(f"data set '{name}' is one mapping, expected a list of them: give [episode]")
        first = episodes[0]
        observation_dim = observation_dim or _width(first.get("observations"))
        action_dim = action_dim or _width(first.get("actions")) or 1
        for which, bound in (("action_low", action_low), ("action_high", action_high)):
            if (shape := np.shape(bound)) not in ((), (1,), (action_dim,)):
                raise DataError(
                    f"data set '{name}': {which} has shape {shape}, expected one number or {action_dim} of them"
                )
        low = np.broadcast_to(np.asarray(action_low, np.float32), (action_dim,)).copy()
        high = np.broadcast_to(np.asarray(action_high, np.float32), (action_dim,)).copy()
        check_box(f"data set '{name}'", low, high)
        names = episode_names or [f"episode {e}" for e in range(len(episodes))]
        checked = [
            validate_episode(name, label, fields, observation_dim=observation_dim, action_low=low, action_high=high)
            for label, fields in zip(names, episodes, strict=True)
        ]
        joined: dict[str, Any] = {key: np.concatenate([fields[key] for fields in checked]) for key in checked[0]}
        lengths = np.array([len(fields["rewards"]) for fields in checked], np.int64)
        return cls(name=name, lengths=lengths, action_low=low, action_high=high, **joined)

    def select(self, episode_ids: ArrayLike) -> Trajectories:
        """A copy with these episodes only, in this order."""
        ids = np.asarray(episode_ids, np.int64)
        if not ids.size:
            raise DataError(f"data set '{self.name}': no episodes were selected")
        if ids.min() < 0 or ids.max() >= self.num_episodes:
            raise DataError(
                f"data set '{self.name}': episode {ids.min() if ids.min() < 0 else ids.max()} was requested, "
                f"expected 0 to {self.num_episodes - 1}"
            )
        steps = ranges(self.step_offsets[ids], self.lengths[ids])
        rows = ranges(self.observation_offsets[ids], self.lengths[ids] + 1)
        return replace(
            self,
            observations=self.observations[rows],
            actions=self.actions[steps],
            rewards=self.rewards[steps],
            terminations=self.terminations[steps],
            truncations=self.truncations[steps],
            lengths=self.lengths[ids],
        )

    def for_task(self, task: Task | None) -> Trajectories:
        """The same data for a task, without copying an array or computing the fingerprint again."""
        same = replace(self, task=task)
        vars(same).update({name: value for name, value in vars(self).items() if name not in vars(same)})
        return same

    # ------------------------------------------------------------------ what is in it

    @property
    def num_steps(self) -> int:
        """N."""
        return len(self.rewards)

    @property
    def num_episodes(self) -> int:
        """E."""
        return len(self.lengths)

    @property
    def observation_dim(self) -> int:
        """O."""
        return int(self.observations.shape[1])

    @property
    def action_dim(self) -> int:
        """A."""
        return int(self.actions.shape[1])

    @cached_property
    def step_offsets(self) -> NDArray[np.int64]:
        """(E + 1,) first step of each episode, and N."""
        return np.concatenate([[0], np.cumsum(self.lengths)])

    @cached_property
    def observation_offsets(self) -> NDArray[np.int64]:
        """(E + 1,) first observation row of each episode, and N + E."""
        return self.step_offsets + np.arange(self.num_episodes + 1)

    @cached_property
    def returns(self) -> NDArray[np.float64]:
        """(E,) undiscounted return of each episode."""
        return np.add.reduceat(self.rewards.astype(np.float64), self.step_offsets[:-1])

    def episode(self, number: int) -> dict[str, NDArray[Any]]:
        """Views of one episode's five arrays."""
        if not 0 <= number < self.num_episodes:
            raise DataError(
                f"data set '{self.name}': there is no episode {number}, expected 0 to {self.num_episodes - 1}"
            )
        steps = slice(self.step_offsets[number], self.step_offsets[number + 1])
        rows = slice(self.observation_offsets[number], self.observation_offsets[number + 1])
        return {
            "observations": self.observations[rows],
            "actions": self.actions[steps],
            "rewards": self.rewards[steps],
            "terminations": self.terminations[steps],
            "truncations": self.truncations[steps],
        }

    @cached_property
    def _fingerprint(self) -> str:
        digest = hashlib.sha256()
        for key, array in self.arrays().items():
            digest.update(f"{key} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
        return digest.hexdigest()

    def fingerprint(self) -> str:
        """SHA-256 of all arrays (not of the name), computed once."""
        return self._fingerprint

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every array by name."""
        return {key: getattr(self, key) for key in ARRAY_TYPES}

    def episode_of(self, steps: ArrayLike) -> NDArray[np.int64]:
        """The episode of each step, same shape as `steps`."""
        return np.searchsorted(self.step_offsets, np.asarray(steps), side="right") - 1

    def split(self, fraction: float, seed: int, horizon: int = 1) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Divide the episodes into training and validation.

        Validation episodes are drawn at random until they have `fraction` of all steps. Episodes shorter than
        `horizon` stay with training, where they are left out anyway.

        Args:
            fraction: Share of the steps that is held out; 0 holds out nothing.
            seed: The same seed gives the same split.
            horizon: Fewest steps of an episode that may be held out.

        Returns:
            Sorted episode numbers for training and for validation.

        Raises:
            DataError: When there is only one episode to divide, or `fraction` is out of range.
        """
        if not 0.0 <= fraction < 1.0:
            raise DataError(f"validation_fraction: got {fraction}, expected at least 0 and less than 1")
        everything = np.arange(self.num_episodes)
        if fraction == 0:
            return everything, everything[:0]
        shuffled = np.random.default_rng([seed, 1]).permutation(everything)
        usable = shuffled[self.lengths[shuffled] >= horizon]
        if len(usable) < 2:
            raise DataError(
                f"data set '{self.name}': {len(usable)} of its episodes have {horizon} steps, so none can be "
                "held out for validation; use more data, or validation_fraction 0"
            )
        before = np.cumsum(self.lengths[usable]) - self.lengths[usable]
        count = int(np.sum(before < fraction * self.num_steps))
        validation = np.sort(usable[: min(max(count, 1), len(usable) - 1)])
        return np.setdiff1d(everything, validation), validation

    # ------------------------------------------------------------------ segments

    def windows(self, horizon: int, stride: int = 1, tail: Literal["full", "terminated"] = "full") -> Windows:
        """Sliding windows of `horizon` steps; see `datamodules.windows.sliding_windows`."""
        terminated = self.terminations[self.step_offsets[1:] - 1]
        return sliding_windows(self.name, self.lengths, terminated, horizon, stride, tail)

    # ------------------------------------------------------------------ on disk

    def save(self, directory: str | Path, *, overwrite: bool = False) -> Path:
        """Write a folder of .npy files, completely or not at all; see `datamodules.storage`."""
        facts = {"name": self.name, "fingerprint": self.fingerprint()}
        return save_arrays(directory, self.arrays(), facts, overwrite=overwrite)

    @classmethod
    def load(cls, directory: str | Path, *, mmap: bool = False, verify: bool = True) -> Trajectories:
        """Read what `save` wrote.

        Args:
            directory: The folder.
            mmap: Map the arrays instead of reading them: memory is filled as they are used.
            verify: Compare with the stored fingerprint, for which all arrays are read once.

        Raises:
            DataError: When a file is missing, damaged or does not match.
        """
        facts, arrays = read_arrays(directory, ARRAY_TYPES, mmap=mmap)
        name = str(facts["name"])
        validate_arrays(name, arrays)
        trajectories = cls(name=name, **arrays)
        if verify and trajectories.fingerprint() != facts["fingerprint"]:
            raise DataError(
                f"data set '{name}': the arrays in {directory} do not match their fingerprint; they were changed"
            )
        return trajectories


def _width(value: Any) -> int | None:
    shape = np.shape(value) if value is not None else ()
    return tuple(shape)[1] if len(shape) == 2 else None
