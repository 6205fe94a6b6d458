"""The results of a study as tables, from what its cells have found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.grid.cells import BASE, PLAYERS, label, shown
from dds_lightning.grid.found import Found, check_key, found_elsewhere, one_line
from dds_lightning.grid.job import NODES
from dds_lightning.saving.untrusted import TEXT, conform, mapping, parsing, read_json
from dds_lightning.study.paper import number_of
from dds_lightning.study.protocol import BEST, LAST
from dds_lightning.study.statistics import evaluation_curve, interval, mean_std, probability_of_improvement

CELLS = "cells.json"
"""The cells of a study, in its folder."""
KNOWN = "known.json"
"""What was found elsewhere, in a study's folder."""
STATE = "state.json"
"""How long a study's launches took, and what failed in the last, in its folder."""
PULLS = 100
"""Evaluation episodes that the curve of `evaluation_curve` goes up to."""
REMEDY = "run the study again"


def remember(place: Path, known: Iterable[Path]) -> None:
    """Keep in a study's folder what reports from elsewhere hold of its cells, beside what it was told before.

    Args:
        place: The study's folder.
        known: `results.json` of reports, or their folders.

    Raises:
        UserError: No study is there, a file is damaged, or a report has no cell of this study.
    """
    _elsewhere(place, _cells(place)[1], known).save(place / KNOWN)


def _elsewhere(place: Path, cells: Mapping[str, Iterable[str]], known: Iterable[Path] = ()) -> Found:
    """What was found elsewhere of the jobs that the cells are made of: told before, and in reports given now."""
    return found_elsewhere(place / KNOWN, known, {key for keys in cells.values() for key in keys})


def _cells(place: Path) -> tuple[Mapping[str, Any], dict[str, list[str]]]:
    """What a study's folder says about its cells; key of a cell -> keys of the jobs that it is made of."""
    file = place / CELLS
    if not file.is_file():
        raise UserError(
            f"{place} holds no study (it has no {file.name}): give the folder OUT/NAME that `dds study run` wrote"
        )
    with parsing(file, REMEDY):
        read = mapping(read_json(file, 64 * TEXT, root=place), file)
        conform(read, {"study": (dict,), "cells": (list,), "command": (str,)}, str(file))
        return read, {cell["key"]: [check_key(key, file) for key in cell["nodes"]] for cell in read["cells"]}


def refuse_other_study(place: Path, title: str, file: Path) -> None:
    """Refuse a folder in which another study file of the same name has put its cells: its report would be lost.

    A file that has moved, or says more than before, is the same study as long as its place or its title is.

    Args:
        place: The study's folder.
        title: Of the study that is to run.
        file: The study file.

    Raises:
        UserError: Names the other study.
    """
    if not (place / CELLS).is_file():
        return
    other = _cells(place)[0]
    there, called = other.get("file", ""), other["study"].get("title", title)
    if called != title and there not in ("", str(file.absolute())):
        raise UserError(
            f"{place} holds the study '{called}' of {there}, another file of the same name: give this one another name "
            "or another --out"
        )


def read_state(place: Path) -> tuple[float, dict[str, str]]:
    """Seconds on the clock that all launches of a study took, and job -> why it failed in the last.

    Raises:
        UserError: The file is damaged.
    """
    file = place / STATE
    if not file.is_file():
        return 0.0, {}
    with parsing(file, "delete it"):
        form = {"wall": (int, float), "failed": (dict,)}
        found = conform(read_json(file, 64 * TEXT, root=place), form, str(file))
        return float(found["wall"]), {key: one_line(str(why)) or "" for key, why in found["failed"].items()}


@dataclass(frozen=True, eq=False)
class Results:
    """What a study has found so far.

    Attributes:
        place: The study's folder.
        study: Its file, checked, as plain values.
        command: What made it.
        cells: A row for each cell: coordinates, `seed`, `state` (done, failed or open), `reason` (why it failed),
            `score` (of the last checkpoint), `best` (of the best checkpoint; NaN without one), `chosen` (how),
            `horizon`, `hold`, `seconds` (of the evaluation and all that it reads), `key`, `commands`.
        found: What the cells are made of.
        wall: Seconds on the clock of all launches in this folder; 0 where none was.
    """

    place: Path
    study: Mapping[str, Any]
    command: str
    cells: pd.DataFrame
    found: Found
    wall: float = 0.0

    @classmethod
    def read(cls, place: Path) -> Results:
        """Read a study's folder.

        Raises:
            UserError: No study is there, or a file is damaged.
        """
        record, cells = _cells(place)
        with parsing(place / CELLS, REMEDY):
            found = _elsewhere(place, cells) | Found.of_nodes(place.parent / NODES, cells)
            wall, failed = read_state(place)
            table = pd.DataFrame([_row(cell, found, failed) for cell in record["cells"]])
            return cls(place, dict(record["study"]), record["command"], table, found, wall)

    @property
    def seconds(self) -> float:
        """Of all jobs of the study, each counted once."""
        return sum(work.seconds for work in self.found.works.values())

    def label(self, name: Any) -> str:
        """What the report calls an axis or a value."""
        return label(self.study["labels"], name)

    def name(self, where: Mapping[str, Any]) -> str:
        """A place in the grid, in words: values that speak for themselves without their axis."""
        parts = (
            value if axis in ("variant", "method", "task") else f"{self.label(axis)} {self.label(value)}"
            for axis, value in where.items()
        )
        return ", ".join(map(self.label, parts))

    def layout(self) -> tuple[list[str], list[str]]:
        """Coordinates of the table's rows and of its columns: those of the file, and what it does not name."""
        rows, columns = list(self.study["rows"]), list(self.study["columns"])
        several = [one for one in ("task", "method") if self.cells[one].nunique() > 1]
        axes = [*several, *self.study["grid"], *(["variant"] if self.study["variants"] else [])]
        open_axes = [axis for axis in axes if axis not in rows + columns]
        if not rows and not columns and open_axes:
            columns = [open_axes.pop()]
        return rows + open_axes or ["task"], columns

    def table(self, measure: str = "score") -> pd.DataFrame:
        """The study's table: mean ± standard deviation over seeds, the paper's number in a column of its own."""
        rows, columns = self.layout()
        lines: dict[Any, dict[str, str]] = {}
        done = self.cells[self.cells["state"] == "done"]
        for chosen, part in done.groupby(rows + columns, sort=False, dropna=False):
            where = dict(zip(rows + columns, chosen, strict=True))
            line = lines.setdefault(tuple(where[name] for name in rows), {})
            line |= {self.label(name): self.label(where[name]) for name in rows}
            head = self.name({name: where[name] for name in columns}) or "score"
            line[head] = mean_std(part[measure].dropna())
            first = part.iloc[0]
            settings = {**self.study["settings"], **where}
            method = PLAYERS[first["method"]].title
            if number := number_of(self.study["paper"], first["task"], method, settings):
                mean, spread = number
                line[f"{head} (paper)"] = f"{mean:.1f}" + ("" if spread is None else f" ± {spread:.1f}")
        return pd.DataFrame(list(lines.values())).fillna("-")

    def groups(self) -> dict[str, pd.DataFrame]:
        """What is compared: name -> (seeds, tasks) scores of every setting that has all its cells.

        While fewer than two have them, only tasks whose cells are all done count.
        """
        found = self._groups(self.cells)
        if len(found) > 1:
            return found
        done = self.cells.groupby("task")["score"].transform(lambda scores: scores.notna().all())
        return self._groups(self.cells[done]) or found

    def _axes(self) -> list[str]:
        """Coordinates by which two settings differ."""
        return [axis for axis in (*self.layout()[0], *self.layout()[1]) if axis != "task"]

    def _first(self, groups: Mapping[str, pd.DataFrame]) -> str | None:
        """The setting that the others are compared with: the first with the file's reference in it, else the first."""
        reference = self.study["reference"] or BASE
        for where in self.cells[self._axes()].drop_duplicates().to_dict("records"):
            if reference in where.values() and (name := self.name(where)) in groups:
                return name
        return next(iter(groups), None)

    def _groups(self, cells: pd.DataFrame) -> dict[str, pd.DataFrame]:
        axes = self._axes()
        found: dict[str, pd.DataFrame] = {}
        for chosen, part in cells.groupby(axes, sort=False, dropna=False) if axes else [((), cells)]:
            name = self.name(dict(zip(axes, chosen, strict=True)))
            scores = part.pivot(index="seed", columns="task", values="score")[part["task"].unique()]
            if len(scores) and not scores.isna().any(axis=None):
                found[name or "all"] = scores
        return found

    def comparison(self) -> pd.DataFrame:
        """A row for each setting: interquartile mean with its interval, and how probably it beats the reference."""
        groups, rows = self.groups(), []
        first = self._first(groups)
        for name, scores in groups.items():
            middle = interval(scores)
            row = {"setting": name, "runs": scores.size, "IQM": middle.value, "low": middle.low, "high": middle.high}
            if name != first and first is not None and list(scores) == list(groups[first]):
                better = probability_of_improvement(scores, groups[first])
                row |= {"P(better)": better.value, "P low": better.low, "P high": better.high}
            rows.append(row)
        table = pd.DataFrame(rows)
        return table.rename(columns={"P(better)": f"P(better than {first})"}) if first else table

    def effects(self) -> pd.DataFrame:
        """A row for each value of each axis, over all values of the others; empty where there is one axis.

        Runs are those of all cells with the value, stratified by where they stand on the other axes; a value that lacks
        cells is left out.
        """
        axes = [axis for axis in (*self.study["grid"], "method", "variant") if self._varies(axis)]
        rows: list[dict[str, Any]] = []
        for axis in axes if len(axes) > 1 else []:
            others = ["task", *(other for other in axes if other != axis)]
            groups = {
                value: part.pivot_table(index="seed", columns=others, values="score", sort=False)
                for value, part in self.cells.groupby(axis, sort=False)
            }
            whole = {value: part for value, part in groups.items() if part.size and not part.isna().any(axis=None)}
            size = max((part.size for part in whole.values()), default=0)
            found = [(value, part, interval(part)) for value, part in whole.items() if part.size == size]
            for value, part, middle in found:
                row = {"setting": self.label(axis), "value": self.label(value), "runs": part.size, "IQM": middle.value}
                row |= {"low": middle.low, "high": middle.high, "P(better than the first)": np.nan}
                if value != found[0][0]:
                    row["P(better than the first)"] = probability_of_improvement(part, found[0][1]).value
                apart = [self.label(other) for other, _, its in found if middle.low > its.high]
                rows.append(row | {"clearly above": ", ".join(apart)})
        return pd.DataFrame(rows)

    def _varies(self, axis: str) -> bool:
        return axis in self.cells and self.cells[axis].nunique(dropna=False) > 1

    def budgets(self) -> dict[str, NDArray[np.float64]]:
        """Task and method -> score of the setting that so many evaluation episodes find, see `evaluation_curve`."""
        found, outcomes = {}, self.found.outcomes
        for (task, method), part in self.cells.groupby(["task", "method"], sort=False):
            runs = [outcomes[key].episodes for key in part["key"] if key in outcomes]
            if len(runs) > 1:
                count = min(map(len, runs))
                found[f"{PLAYERS[method].title} on {task}"] = evaluation_curve([run[:count] for run in runs], PULLS)
        return found


def _row(cell: Mapping[str, Any], found: Found, failed: Mapping[str, str]) -> dict[str, Any]:
    """One row of `Results.cells`."""
    # What pandas cannot group by (lists), or reads as missing (null), stands as text.
    place = {axis: one if type(one) in (str, int, float) else shown(one) for axis, one in cell["place"].items()}
    row = {"task": cell["task"], "method": cell["method"], **place, "seed": cell["seed"], "key": cell["key"]}
    row |= {"title": cell["title"], "state": "open", "reason": "", "score": np.nan, "best": np.nan, "chosen": ""}
    row |= {"horizon": np.nan, "hold": np.nan}
    if (outcome := found.outcomes.get(cell["key"])) is not None:
        row |= {"state": "done", "score": outcome.scores[LAST], "best": outcome.scores.get(BEST, np.nan)}
    elif cell["key"] in failed:  # the first of its jobs to fail kept the others back
        first = next(key for key in cell["nodes"] if key in failed)
        row |= {"state": "failed", "reason": f"{first.partition('-')[0]}: {failed[first]}"}
    works = [found.works[key] for key in cell["nodes"] if key in found.works]
    row["seconds"] = sum(work.seconds for work in works)
    row["commands"] = [work.command for work in works if work.command is not None]
    for work in works:
        row["chosen"] = work.chosen or row["chosen"]
        if work.horizon is not None:
            row["horizon"] = row["hold"] = work.horizon
    row["hold"] = cell["settings"].get("evaluate.hold") or row["hold"]
    return row
