"""Semi-MDP transitions (s, k, R, s', discount, done) in memory and as a file, which is checked when it is read.

`datamodules.relabel` makes them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_tensors
from dds_lightning.saving.files import refuse_newer, written_whole
from dds_lightning.saving.fingerprint import same
from dds_lightning.saving.untrusted import mapping, parse_json

FORMAT = 1
STORED = (
    "observations",
    "codes",
    "rewards",
    "next_observations",
    "discounts",
    "dones",
    "starts",
    "episodes",
)
"""The tensors of a file."""


@dataclass(frozen=True, eq=False)
class Relabelled:
    """M semi-MDP transitions."""

    observations: Tensor
    """(M, O)."""
    codes: Tensor
    """(M,) int64."""
    rewards: Tensor
    """(M,) sum of discounted rewards inside the segment, in the task's learning convention."""
    next_observations: Tensor
    """(M, O) state after the segment's last step."""
    discounts: Tensor
    """(M,) factor on the bootstrap."""
    dones: Tensor
    """(M,) float, 1 where the segment ends in a termination."""
    starts: Tensor
    """(M,) int64 step of the data set at which the segment begins."""
    episodes: Tensor
    """(M,) int64 episode of the segment."""
    num_skills: int
    """K."""

    def __len__(self) -> int:
        """Number of transitions M."""
        return len(self.codes)

    def batch(self, index: Tensor) -> dict[str, Tensor]:
        """The transitions at ``index`` (B,) as the policy's batch."""
        return {
            "observations": self.observations[index],
            "codes": self.codes[index],
            "rewards": self.rewards[index],
            "next_observations": self.next_observations[index],
            "discounts": self.discounts[index],
            "dones": self.dones[index],
        }

    def to(self, device: torch.device) -> "Relabelled":
        """The same transitions on another device."""
        if self.codes.device == device:
            return self
        return replace(self, **{name: getattr(self, name).to(device) for name in STORED})

    def summary(self) -> pd.DataFrame:
        """One row per code: share of the data, mean reward, mean displacement of the first two observations.

        ``dx`` and ``dy`` are the mean change of the first two dimensions (the position in a maze) over a segment, in
        the environment's units; ``distance`` is the mean length of that change.
        """
        moved = (self.next_observations - self.observations)[:, :2].cpu().numpy()  # (M, 2)
        frame = pd.DataFrame(
            {
                "code": self.codes.cpu().numpy(),
                "reward": self.rewards.cpu().numpy(),
                "dx": moved[:, 0],
                "dy": moved[:, -1],
                "distance": np.linalg.norm(moved, axis=1),
                "done": self.dones.cpu().numpy(),
            }
        )
        groups = frame.groupby("code")
        table = groups[["reward", "dx", "dy", "distance"]].mean()
        table.insert(0, "segments", groups.size())
        table.insert(1, "share", groups.size() / len(frame))
        table["terminations"] = groups["done"].sum().astype(int)
        table = table.reindex(range(self.num_skills))
        counts = ["segments", "share", "terminations"]
        table[counts] = table[counts].fillna(0)
        return table.astype({"segments": int, "terminations": int}).rename_axis("code").reset_index()

    def save(self, path: str | Path, key: dict[str, str | int | float]) -> None:
        """Write the transitions and `key`, what they were made from, atomically as one safetensors file."""
        # In one entry: safetensors writes several in any order, but the same transitions must give the same bytes.
        about = {"format": FORMAT, "num_skills": self.num_skills, "key": key}
        metadata = {"about": json.dumps(about, sort_keys=True)}
        with written_whole(Path(path)) as part:
            try:
                save_file({name: getattr(self, name).contiguous().cpu() for name in STORED}, part, metadata=metadata)
            except SafetensorError as error:  # how safetensors reports an error of the disk
                raise UserError(f"{path} could not be written: {error}") from None
            part.chmod(0o644)  # safetensors makes files readable for the owner only

    @classmethod
    def load(cls, path: str | Path, key: dict[str, str | int | float] | None = None) -> "Relabelled":
        """Read a relabelled file.

        Args:
            path: The file.
            key: What it must have been made from; None skips this check.

        Raises:
            UserError: When there is no such file, it is not a relabelled file, or it was made from something else,
                which the message names.
        """
        if not Path(path).exists():
            raise UserError(f"there is no relabelled file {path}: make it with `dds relabel`")
        try:
            tensors, metadata = read_tensors(path)
        except UserError as error:
            raise UserError(f"{path} is not a readable relabelled file ({error}): delete it and relabel") from error
        about = _about(metadata, path)
        found = dict(about["key"])
        if key and "skill" in key and same(str(found.get("skill")), str(key["skill"])):
            found["skill"] = key["skill"]  # another decoder, or how an earlier version named these skills
        if key is not None and found != json.loads(json.dumps(key)):
            pairs = {name: (found.get(name), value) for name, value in key.items() if found.get(name) != value}
            wrong = [f"{name} {there!r} instead of {wanted!r}" for name, (there, wanted) in pairs.items()]
            raise UserError(
                f"{path} was relabelled with other inputs ({'; '.join(wrong)}): choose another file or relabel"
            )
        if damage := _misfit(tensors, about["num_skills"]):
            raise UserError(f"{path} is not a readable relabelled file ({damage}): delete it and relabel")
        return cls(**tensors, num_skills=about["num_skills"])


def _misfit(tensors: Mapping[str, Tensor], num_skills: int) -> str | None:
    """What is wrong with the tensors of a file; None if they are transitions of `num_skills` codes."""
    if tensors.keys() != set(STORED):
        return f"it contains {', '.join(sorted(tensors)) or 'nothing'}, expected {', '.join(STORED)}"
    rows = len(tensors["codes"]) if tensors["codes"].ndim else 0
    for name, value in tensors.items():
        wide = name in ("observations", "next_observations")
        if not rows or value.ndim != 1 + wide or len(value) != rows:
            return f"{name} has shape {tuple(value.shape)}, expected {rows or 'some'} rows like codes"
        if value.dtype != (torch.int64 if name in ("codes", "starts", "episodes") else torch.float32):
            return f"{name} has type {value.dtype}"
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            return f"{name} contains numbers that are not finite"
    if tensors["observations"].shape != tensors["next_observations"].shape or not tensors["observations"].shape[1]:
        return f"next_observations have shape {tuple(tensors['next_observations'].shape)}, unlike observations"
    for name, most in (("discounts", 1), ("dones", 1), ("starts", None), ("episodes", None)):
        low, high = tensors[name].min().item(), tensors[name].max().item()
        if low < 0 or (most is not None and high > most):
            return f"{name} run from {low:g} to {high:g}, expected {'at least 0' if most is None else '0 to 1'}"
    codes = tensors["codes"]
    if int(codes.min()) < 0 or int(codes.max()) >= num_skills:
        return f"codes run from {int(codes.min())} to {int(codes.max())}, expected 0 to {num_skills - 1}"
    return None


def _about(metadata: Mapping[str, str], path: str | Path) -> dict[str, Any]:
    """The description stored in a file; an earlier version wrote it in three entries.

    Raises:
        UserError: When a newer version wrote it, or it cannot be parsed.
    """
    try:
        about = mapping(parse_json(metadata["about"], path) if "about" in metadata else dict(metadata), path)
        found = mapping(parse_json(about["key"], path) if isinstance(about["key"], str) else about["key"], path)
        parsed = {"format": int(about["format"]), "num_skills": int(about["num_skills"]), "key": found}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path} is not a readable relabelled file ({error!r}): delete it and relabel") from None
    refuse_newer(path, parsed["format"], FORMAT)
    return parsed
