"""The result of a rollout: a table with one row per episode, and the recorded paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_npz, read_parquet
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import parsing, safe_name

_EPISODES, _PATHS = "episodes.parquet", "paths.npz"
_COLUMNS = {
    **dict.fromkeys(("actor", "label"), "O"),
    **dict.fromkeys(("episode", "seed"), "iu"),
    **dict.fromkeys(("return", "score"), "f"),
    **dict.fromkeys(("success", "terminated"), "bO"),
    "length": "iu",
    **dict.fromkeys(("final_x", "final_y"), "f"),
    "final_code": "iu",
    "codes": "O",
}
"""Column -> kinds of NumPy that it may have."""
_REMEDY = "run the rollout again; in a run, delete the folder evaluate and `dds run` plays the episodes anew"
_MOST = 2**12
"""Codes that a table may name."""


@dataclass(frozen=True, eq=False)
class RolloutPath:
    """One episode of T steps.

    Attributes:
        positions: (T + 1, 2) metres; NaN where there is no maze.
        codes: (T,) int16 skill in use in each step; -1 for an actor without skills.
        observations: (T + 1, O) where they were recorded.
    """

    positions: NDArray[np.float32]
    codes: NDArray[np.int16]
    observations: NDArray[np.float32] | None = None

    def __getitem__(self, name: str) -> Any:
        """`path["positions"]` is `path.positions`."""
        return getattr(self, name)


@dataclass(frozen=True, eq=False)
class RolloutResult:
    """The table of a rollout.

    Attributes:
        task: Name of the task.
        episodes: One row per episode: `actor`, `label` (the part of the contestant, else its name), `episode`
            (counted within the contestant), `seed` (of the environment), `return` (environment's own
            rewards), `score` (normalised, 0 to 100), `success` (missing where the task does not measure it),
            `terminated`, `length` (steps), `final_x` and `final_y` (metres; NaN where there is no maze),
            `final_code` (skill in use at the end; -1 without skills), `codes` (list of the skills chosen, one
            a decision).
        paths: (actor, episode) to `RolloutPath`; empty unless recorded.
    """

    task: str
    episodes: pd.DataFrame
    paths: Mapping[tuple[str, int], RolloutPath] = field(default_factory=dict)

    def summary(self, by: str = "actor") -> pd.DataFrame:
        """One row for each `actor` or `label`, in the table's order.

        Columns: `episodes`, `success` (per cent; NaN where the task does not measure it), `score` (mean),
        `score_error` (its standard error), `return`, `length` (means), `length_success` (mean steps of the
        successful episodes; NaN if none).
        """
        rows = []
        for name, part in self.episodes.groupby(by, sort=False):
            success = part["success"].astype(float)  # NaN where it is missing
            rows.append(
                {
                    by: name,
                    "episodes": len(part),
                    "success": 100.0 * success.mean(),
                    "score": part["score"].mean(),
                    "score_error": part["score"].std(ddof=1) / np.sqrt(len(part)) if len(part) > 1 else np.nan,
                    "return": part["return"].mean(),
                    "length": part["length"].mean(),
                    "length_success": part.loc[success == 1.0, "length"].mean(),
                }
            )
        return pd.DataFrame(rows)

    def joined(self, other: RolloutResult, order: Sequence[str]) -> RolloutResult:
        """This table and that of other contestants who played the same episodes, with the actors in `order`."""
        place = {name: i for i, name in enumerate(order)}
        episodes = pd.concat([self.episodes, other.episodes], ignore_index=True)
        episodes = episodes.sort_values("actor", key=lambda names: names.map(place), kind="stable", ignore_index=True)
        return RolloutResult(self.task, episodes, {**self.paths, **other.paths})

    def save(self, directory: str | Path) -> Path:
        """Write `episodes.parquet` and, when recorded, `paths.npz`; each file whole or not at all."""
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        table = self.episodes.copy()
        table.attrs = {"task": self.task}
        with written_whole(directory / _EPISODES) as part:
            table.to_parquet(part, index=False)
        if self.paths:
            keys = list(zip(table["actor"], table["episode"], strict=True))
            recorded = [self.paths[key] for key in keys]
            arrays: dict[str, Any] = {
                "positions": np.concatenate([path.positions for path in recorded]),
                "codes": np.concatenate([path.codes for path in recorded]),
            }
            if recorded[0].observations is not None:
                arrays["observations"] = np.concatenate([path.observations for path in recorded])
            with written_whole(directory / _PATHS) as part, part.open("wb") as file:
                np.savez_compressed(file, **arrays)
        else:
            (directory / _PATHS).unlink(missing_ok=True)  # of an earlier rollout
        return directory

    @classmethod
    def load(cls, directory: str | Path) -> RolloutResult:
        """Read what `save` wrote.

        Raises:
            UserError: There is no table, or the paths do not fit it.
        """
        directory = Path(directory)
        file = directory / _EPISODES
        if not file.exists():
            raise UserError(f"{file} does not exist: expected a directory written by a rollout")
        table = read_parquet(file, _COLUMNS, _REMEDY, root=directory)
        with parsing(file, _REMEDY):
            _check_episodes(table)
        paths: dict[tuple[str, int], RolloutPath] = {}
        if (directory / _PATHS).exists():
            arrays = read_npz(directory / _PATHS, root=directory, remedy=_REMEDY)
            lengths = table["length"].to_numpy()
            steps = int(lengths.sum())
            forms = {"codes": ((steps,), "iu"), "positions": ((steps + len(lengths), 2), "f")}
            forms |= {"observations": ((steps + len(lengths), -1), "f")} if "observations" in arrays else {}
            for name, (shape, kinds) in forms.items():
                array = arrays.get(name, np.zeros(0))
                width = array.shape[1:] if shape[-1] == -1 else shape[1:]
                if array.shape != (shape[0], *width) or array.ndim != len(shape) or array.dtype.kind not in kinds:
                    raise UserError(f"{directory / _PATHS}: {name} do not belong to {file}: {_REMEDY}")
            step = state = 0
            for actor, episode, length in zip(table["actor"], table["episode"], lengths, strict=True):
                states = slice(state, state + length + 1)
                seen = arrays["observations"][states] if "observations" in arrays else None
                codes = arrays["codes"][step : step + length]
                paths[actor, int(episode)] = RolloutPath(arrays["positions"][states], codes, seen)
                step, state = step + length, state + length + 1
        return cls(safe_name(table.attrs.get("task", "")), table, paths)


def _check_episodes(table: pd.DataFrame) -> None:
    """Make the columns what `RolloutResult` says, in place; a table that cannot be is refused.

    Raises:
        ValueError: Says what is wrong.
    """
    if not len(table):
        raise ValueError("it has no episodes")
    for name in ("actor", "label"):
        if not all(isinstance(text, str) for text in table[name]):
            raise ValueError(f"column '{name}' holds more than texts")
        distinct = table[name].nunique()
        table[name] = [safe_name(text) for text in table[name]]
        if table[name].nunique() != distinct or "" in table[name].to_numpy():
            raise ValueError(f"column '{name}' holds names that are not text")
    table["codes"] = [list(map(int, codes)) for codes in table["codes"]]
    used = [code for codes in table["codes"] for code in codes]
    ranges = {"length": (1, 10**7), "episode": (0, 10**7), "final_code": (-1, _MOST - 1)}
    for name, (low, high) in ranges.items():
        if table[name].min() < low or table[name].max() > high:
            raise ValueError(f"column '{name}' runs from {table[name].min()} to {table[name].max()}")
    if used and not 0 <= min(used) <= max(used) < _MOST:
        raise ValueError(f"column 'codes' runs from {min(used)} to {max(used)}")
    if not np.isfinite(table[["return", "score"]].to_numpy()).all():
        raise ValueError("a return or score is not finite")
    if np.nanmax(np.abs(table[["final_x", "final_y"]].to_numpy()), initial=0.0) > 1e6:
        raise ValueError("an episode ended beyond a thousand kilometres")
    for name in ("success", "terminated"):
        if not all(flag is pd.NA or flag is None or isinstance(flag, (bool, np.bool_)) for flag in table[name]):
            raise ValueError(f"column '{name}' holds more than flags")
    if table.duplicated(["actor", "episode"]).any():
        raise ValueError("an episode is there twice")
    if not isinstance(table.attrs.get("task", ""), str):
        raise ValueError("its task is no text")
