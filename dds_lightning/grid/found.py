"""What a study has found, without the weights: `results.json` of its report, from which another folder can go on."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.grid.job import MADE
from dds_lightning.saving.arrays import read_parquet
from dds_lightning.saving.files import refuse_newer, written_whole
from dds_lightning.saving.run_directory import finished, read_marker
from dds_lightning.saving.untrusted import TEXT, conform, mapping, parsing, read_csv, read_json
from dds_lightning.study.protocol import LAST

FORMAT = 1
FILE = "results.json"
KEY = re.compile(r"[a-z0-9_]+-[0-9a-f]{16}")
"""The name of a job and of its folder."""
CELL = re.compile(r"evaluate-[0-9a-f]{16}")
"""The same of an evaluation, which alone may be a cell."""
REMEDY = "give the `results.json` that `dds study run` wrote into a report"
WORK: Mapping[str, Any] = {
    "seconds": (int, float),
    "command": (str, type(None)),
    "chosen": (str,),
    "horizon": (int, type(None)),
    "made": (int, type(None)),
}
"""The form of a finished job in the file; `made` is a place in the file's list of what results were made by."""
MADE_BY: Mapping[str, Any] = {"versions": (dict,), "commit": (str, type(None)), "machine": (str,)}
"""The form of what results were made by."""
LONGEST = 10_000
"""Characters of a command or of a reason."""


@dataclass(frozen=True)
class Work:
    """A finished job.

    Attributes:
        seconds: How long it took.
        command: Does the same by hand.
        chosen: How its best checkpoint was chosen; empty without one.
        horizon: H, of a training of skills.
        made: Versions, commit and machine.
    """

    seconds: float
    command: str | None = None
    chosen: str = ""
    horizon: int | None = None
    made: Mapping[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished cell.

    Attributes:
        scores: Checkpoint, `last` or `best`, -> mean normalised score.
        episodes: Scores of the last checkpoint's episodes.
    """

    scores: Mapping[str, float]
    episodes: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """Finished work of a study.

    Attributes:
        works: Key -> job.
        outcomes: Key of the evaluation that is a cell -> cell.
        curves: Key of the evaluation -> what was reached while learning online: `env_steps` and `value`.
    """

    works: Mapping[str, Work] = field(default_factory=dict)
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)
    curves: Mapping[str, pd.DataFrame] = field(default_factory=dict)

    def __or__(self, other: Found) -> Found:
        """Both; what both have is the other's."""
        return Found(
            {**self.works, **other.works}, {**self.outcomes, **other.outcomes}, {**self.curves, **other.curves}
        )

    def only(self, works: Iterable[str]) -> Found:
        """Those of some jobs, by their keys."""
        kept, parts = set(works), (self.works, self.outcomes, self.curves)
        return Found(*({key: one for key, one in part.items() if key in kept} for part in parts))  # type: ignore[arg-type]

    @classmethod
    def of_nodes(cls, root: Path, cells: Mapping[str, Iterable[str]]) -> Found:
        """What lies in the folders of the jobs.

        Args:
            root: Holds the folders.
            cells: Key of the evaluation that is a cell -> keys of all jobs that it is made of.

        Raises:
            UserError: A file is damaged.
        """
        works, outcomes, curves = dict[str, Work](), dict[str, Outcome](), dict[str, pd.DataFrame]()
        for key in dict.fromkeys(key for keys in cells.values() for key in keys):
            if (done := finished(root / key)) is None:
                continue
            chosen, horizon = done.facts.get("chosen"), None
            if key.startswith("skill-"):
                horizon = read_marker(done.folder)["settings"]["data.horizon"]
            works[key] = Work(
                done.seconds,
                done.facts.get("command"),
                f"{chosen['monitor']} at step {chosen['step']:,}" if chosen else "",
                horizon,
                _made(done.folder),
            )
            if key in cells:
                table = read_parquet(done.outputs["episodes"], {"actor": "O", "score": "f"}, "run the study again")
                outcomes[key] = Outcome(
                    {one["actor"]: one["score"] for one in done.facts["results"]},
                    table.loc[table["actor"] == LAST, "score"].to_numpy(np.float64),
                )
        for key, keys in cells.items():
            if (curve := _curve(root, keys)) is not None:
                curves[key] = curve
        return cls(works, outcomes, curves)

    @classmethod
    def load(cls, path: Path, remedy: str = REMEDY) -> Found:
        """Read a `results.json`.

        Args:
            path: The file.
            remedy: What to do where it is missing or damaged.

        Raises:
            UserError: It is missing, damaged, of a newer version, or another file.
        """
        if not path.is_file():
            raise UserError(f"{path} is not there: {remedy}")
        with parsing(path, remedy):
            value = mapping(read_json(path, 64 * TEXT), path)
            refuse_newer(path, value.get("format"), FORMAT)
            conform(value, {"made": (list,), "nodes": (dict,), "cells": (dict,), "curves": (dict,)}, str(path))
            made = [_made_by(one, f"{path}, made") for one in value["made"]]
            works, outcomes = dict[str, Work](), dict[str, Outcome]()
            for key, entry in value["nodes"].items():
                one = conform(entry, WORK, f"{path}, nodes, {check_key(key, path)}")
                by = made[one["made"]] if one["made"] is not None else None
                works[key] = Work(one["seconds"], one_line(entry.get("command")), one["chosen"], one["horizon"], by)
            for key, entry in value["cells"].items():
                what = f"{path}, cells, {check_key(key, path, CELL)}"
                one = conform(entry, {"scores": (dict,), "episodes": (list,)}, what)
                number = (int, float)
                scores = conform(one["scores"], {LAST: number, **dict.fromkeys(one["scores"], number)}, what)
                outcomes[key] = Outcome(
                    {name: float(score) for name, score in scores.items()}, _series(one["episodes"], what)
                )
            curves = dict[str, pd.DataFrame]()
            for key, entry in value["curves"].items():
                what = f"{path}, curves, {check_key(key, path, CELL)}"
                if set(curve := mapping(entry, what)) != {"env_steps", "value"}:
                    raise UserError(f"{what}: a curve has other columns than env_steps and value: {remedy}")
                curves[key] = pd.DataFrame({name: _series(column, what) for name, column in curve.items()})
            return cls(works, outcomes, curves)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        made = self.made()
        nodes = {
            key: {
                "seconds": work.seconds,
                "command": work.command,
                "chosen": work.chosen,
                "horizon": work.horizon,
                "made": None if work.made is None else made.index(dict(work.made)),
            }
            for key, work in self.works.items()
        }
        cells = {
            key: {"scores": dict(one.scores), "episodes": [round(score, 4) for score in one.episodes.tolist()]}
            for key, one in self.outcomes.items()
        }
        curves = {key: curve.to_dict("list") for key, curve in self.curves.items()}
        value = {"format": FORMAT, "made": made, "nodes": nodes, "cells": cells, "curves": curves}
        with written_whole(path) as part:
            part.write_text(json.dumps(value, allow_nan=False), encoding="utf-8")

    def made(self) -> list[dict[str, Any]]:
        """Distinct versions, commits and machines."""
        found = {json.dumps(work.made, sort_keys=True): work.made for work in self.works.values()}
        return [dict(one) for one in found.values() if one is not None]


def check_key(key: str, file: Path, form: re.Pattern[str] = KEY) -> str:
    """The name of a job, if it is one, of a `form`: it may become a path.

    Raises:
        UserError: It is something else.
    """
    if not form.fullmatch(str(key)):
        raise UserError(f"{file}: {str(key)[:80]!r} is not the name of a job: run the study again")
    return key


def _made_by(value: Any, what: str) -> dict[str, Any]:
    """What results were made by, out of a file, if it has the right form."""
    found = conform(value, MADE_BY, what)
    return {**found, "versions": conform(found["versions"], dict.fromkeys(found["versions"], (str,)), what)}


def _series(values: Any, what: str) -> NDArray[np.float64]:
    """A list of one or more finite numbers.

    Raises:
        UserError: It is something else.
    """
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or not len(found) or not np.isfinite(found).all():
        raise UserError(f"{what} has {str(values)[:80]}, expected a list of finite numbers: {REMEDY}")
    return found


def _made(folder: Path) -> dict[str, Any] | None:
    path = folder / MADE
    return _made_by(read_json(path, root=folder), str(path)) if path.is_file() else None


def _curve(root: Path, keys: Iterable[str]) -> pd.DataFrame | None:
    """What an online training reached over environment steps; None for a cell without one."""
    online = next((key for key in keys if key.startswith("online-")), None)
    files = sorted((root / online).glob("logs/version_*/metrics.csv")) if online else []
    if not files:
        return None
    table = pd.concat([read_csv(path, {"step": "iuf"}) for path in files])
    value = next((name for name in ("online/success", "online/return") if name in table), None)
    if value is None or "online/env_steps" not in table:
        return None
    table = table.drop_duplicates("step", keep="last").rename(columns={"online/env_steps": "env_steps", value: "value"})
    return table[["env_steps", "value"]].dropna().sort_values("env_steps")


def one_line(given: str | None) -> str | None:
    """A command or a reason out of a file that anybody may have written: one line, whole, with quotes and braces."""
    if given is None:
        return None
    return "".join(letter for letter in given[:LONGEST] if letter.isprintable() and letter != "`")


def found_elsewhere(remembered: Path, given: Iterable[Path], jobs: Collection[str]) -> Found:
    """What reports of other folders or machines hold of a study.

    Args:
        remembered: What the study's folder knows already, if the file is there.
        given: `results.json` of reports, or their folders.
        jobs: Keys of the study's jobs; nothing else is taken over.

    Raises:
        UserError: A file is missing or damaged, or a report has no cell of this study.
    """
    found = Found.load(remembered, "delete it, and give --known again").only(jobs) if remembered.is_file() else Found()
    for file in given:
        there = Found.load(file / FILE if file.is_dir() else file).only(jobs)
        if not there.outcomes:
            raise UserError(
                f"--known: {file} has no cell of this study: its tasks, settings, seeds or preset differ; leave it out"
            )
        found |= there
    return found
