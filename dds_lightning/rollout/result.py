"""The result of a rollout: a table with one row per episode, and the recorded paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.saving.files import written_whole

_EPISODES, _PATHS = "episodes.parquet", "paths.npz"


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
        if not file.is_file():
            raise UserError(f"{file} does not exist: expected a directory written by a rollout")
        table = pd.read_parquet(file)
        table["codes"] = [list(map(int, codes)) for codes in table["codes"]]
        paths: dict[tuple[str, int], RolloutPath] = {}
        if (directory / _PATHS).is_file():
            with np.load(directory / _PATHS, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            lengths = table["length"].to_numpy()
            if len(arrays["codes"]) != lengths.sum() or len(arrays["positions"]) != (lengths + 1).sum():
                raise UserError(f"{directory / _PATHS} does not belong to {file}: run the rollout again")
            step = state = 0
            for actor, episode, length in zip(table["actor"], table["episode"], lengths, strict=True):
                states = slice(state, state + length + 1)
                seen = arrays["observations"][states] if "observations" in arrays else None
                codes = arrays["codes"][step : step + length]
                paths[actor, int(episode)] = RolloutPath(arrays["positions"][states], codes, seen)
                step, state = step + length, state + length + 1
        return cls(str(table.attrs.get("task", "")), table, paths)
