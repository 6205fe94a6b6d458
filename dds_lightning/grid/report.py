"""`dds study report`: one self-contained page and Markdown, laid out as the paper's tables and figures."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd

from dds_lightning.console.reports import Report, table
from dds_lightning.grid import figures
from dds_lightning.grid.cells import counted
from dds_lightning.grid.found import FILE as FOUND
from dds_lightning.grid.results import PULLS, Results, remember
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.run_directory import duration
from dds_lightning.saving.templates import render
from dds_lightning.study.paper import DATA_DIFFER, LAYOUTS
from dds_lightning.study.tables import markdown

COMMANDS = (
    "To repeat a cell by hand, run its commands in this order in an empty folder. Work that several cells share is "
    "listed with each of them. In the study's own folder the commands would replace its work."
)


@dataclass
class Section:
    """A part of the report: text, a table, a figure, commands."""

    title: str
    lines: list[str] = field(default_factory=list)
    table: pd.DataFrame | None = None
    figure: Any = None
    name: str = ""
    commands: list[tuple[str, list[str]]] = field(default_factory=list)


def report_study(place: Path, known: Sequence[Path] = ()) -> Report:
    """Write `report/` in a study's folder, and return what is in it; a study that is not finished has one too.

    Args:
        place: The study's folder.
        known: Reports of other folders or machines whose cells are taken over, and remembered there.

    Raises:
        UserError: No study is there, a file is damaged, or a report has no cell of this study.
    """
    if known:
        remember(place, known)
    results = Results.read(place)
    sections, folder = _sections(results), place / "report"
    pictures = {section.name: _png(section.figure) for section in sections if section.figure is not None}
    for name, picture in pictures.items():
        with written_whole(folder / f"{name}.png") as part:
            part.write_bytes(picture)
    page = render("dds_lightning.grid", "page.html.jinja", _values(results, sections, pictures))
    cells = results.cells.drop(columns=["commands", "key"])
    for file, text in {
        "report.md": _markdown(results, sections),
        "index.html": page,
        "cells.csv": cells.to_csv(index=False, lineterminator="\n"),
    }.items():
        with written_whole(folder / file) as part:
            part.write_text(text, encoding="utf-8")
    results.found.save(folder / FOUND)
    comparison = results.comparison()
    told: list[Any] = [table(results.table(), str(results.study["title"]))]
    told += [table(comparison)] if len(comparison) > 1 else []
    told += [_progress(results), f"report: {folder / 'index.html'}"]
    data = {"study": place, "report": folder / "index.html", "table": cells, "comparison": comparison}
    return Report(data, told)


def _progress(results: Results) -> str:
    states = results.cells["state"].value_counts()
    failed = f", {states['failed']} failed" if "failed" in states else ""
    wall = f" ({duration(results.wall)} of wall time in this folder)" if results.wall else ""
    done = f"{states.get('done', 0)} of {counted(len(results.cells), 'cell')} done{failed}"
    return f"{done}, in {duration(results.seconds)} of one core in all{wall}"


def _sections(results: Results) -> list[Section]:
    """Everything that the report holds, from its files alone."""
    study, cells = results.study, results.cells[results.cells["state"] == "done"]
    seeds = study["seeds"]
    over = f", mean ± standard deviation over {len(seeds)} seeds" if len(seeds) > 1 else f" with seed {seeds[0]}"
    opening = [str(study["question"])] if study["question"] else []
    opening.append(f"Normalised scores of the last checkpoint{over}; {_progress(results)}.")
    if study["scale"] != 1:
        opening.append(f"All budgets were multiplied by {study['scale']:g}: this is a trial, not a result.")
    if study["budget"]:
        stated = duration(60 * study["budget"] * study["scale"])
        opening.append(f"Stated budget: {stated} of one core; spent: {duration(results.seconds)}.")
    if study["paper"] in LAYOUTS:
        opening.append(f"{LAYOUTS[study['paper']]} {DATA_DIFFER}")
    if cells.empty:
        return [Section("", [*opening, "No cell is finished yet."]), *_making(results)]
    sections = [Section("", opening), Section("Scores", [], results.table())]
    if cells["best"].notna().any():
        told = "The best checkpoint was chosen by playing in the test environment during training: an optimistic score."
        with_best = set(cells.loc[cells["best"].notna(), "method"])
        if without := [name for name in cells["method"].unique() if name not in with_best]:
            told += f" {', '.join(map(results.label, without))}: none, because these do not play during training."
        watched = replace(results, cells=cells[cells["method"].isin(with_best)])
        sections.append(Section("The best checkpoint, apart", [told], watched.table("best")))
    if study["paper"] == "figure6" and cells["horizon"].notna().any():
        sections.append(Section("Score over the horizon", [], None, figures.plot_horizon(cells), "horizon"))
    if curves := results.found.curves:
        online: dict[str, list[pd.DataFrame]] = {}
        for row in results.cells.to_dict("records"):
            if row["key"] in curves:
                online.setdefault(results.label(row.get("variant", row["method"])), []).append(curves[row["key"]])
        sections.append(Section("While learning online", [], None, figures.plot_online(online), "online"))
    return [*sections, *_statistics(results), *_making(results)]


def _statistics(results: Results) -> list[Section]:
    """What of the differences is real."""
    comparison, groups, budgets = results.comparison(), results.groups(), results.budgets()
    sections: list[Section] = []
    if len(comparison) > 1:
        told = (
            "Interquartile mean (IQM) over seeds and tasks with its 95 % interval from a bootstrap stratified by task, "
            "and the probability that a run with this setting beats one with the reference. With few seeds an interval "
            "is no more than the range of the scores; settings whose intervals overlap cannot be told apart here."
        )
        compared = list(next(iter(groups.values())))
        if len(compared) < results.cells["task"].nunique():
            told += f" Compared on {', '.join(compared)} only: the other tasks are not finished."
        numbers = comparison.round(2)
        sections.append(Section("Is it real?", [told], numbers, figures.plot_intervals(comparison), "intervals"))
        few = f"The first {figures.MOST} of {len(groups)} settings are drawn; all of them are in the table above."
        drawn = [few] if len(groups) > figures.MOST else []
        sections.append(Section("Performance profiles", drawn, None, figures.plot_profiles(groups), "profiles"))
    effects = results.effects()
    if len(effects):
        told = (
            "Each value, pooled over all values of the other settings: IQM with its 95 % interval, the probability "
            "that a run beats one with the setting's first value, and the values whose whole interval lies below."
        )
        sections.append(Section("What each setting does", [told], effects.round(2)))
    if budgets:
        told = (
            f"Score of the setting that one would deploy after at most {PULLS} evaluation episodes in all, which an "
            "upper-confidence bandit spends on up to eight of the trained policies."
        )
        sections.append(
            Section("How many evaluations it takes", [told], None, figures.plot_budgets(budgets), "budgets")
        )
    return sections


def _making(results: Results) -> list[Section]:
    """By what all of it was made."""
    made = [
        ", ".join(f"{name} {version}" for name, version in one["versions"].items())
        + (f"; commit {one['commit']}" if one.get("commit") else "")
        + f"; {one['machine']}"
        for one in results.found.made()
    ]
    shown = results.cells[["title", "state", "reason", "score", "best", "chosen", "seconds"]].copy()
    shown = shown.drop(columns=[name for name in ("reason", "chosen") if not shown[name].any()])
    shown["seconds"] = shown["seconds"].map(duration)
    shown = shown.rename(columns={"title": "cell", "seconds": "time, with all it reads"}).round(1)
    shown = shown.dropna(axis=1, how="all")
    commands = [(str(row["title"]), list(row["commands"])) for row in results.cells.to_dict("records")]
    return [
        Section("Every cell", [], shown),
        Section("How it was made", [*made, f"The whole study: {results.command}", COMMANDS], commands=commands),
    ]


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=130, metadata={"Software": None})
    return file.getvalue()


def _values(results: Results, sections: list[Section], pictures: dict[str, bytes]) -> dict[str, Any]:
    """What the page's template uses."""
    parts = []
    for section in sections:
        frame = section.table if section.table is not None else pd.DataFrame()
        texts = frame.astype(object).where(frame.notna(), "-")
        parts.append(
            {
                "title": section.title,
                "lines": section.lines,
                "columns": [str(name) for name in frame.columns],
                "rows": [[str(value) for value in row] for row in texts.itertuples(index=False)],
                "picture": base64.b64encode(pictures[section.name]).decode() if section.name in pictures else "",
                "commands": section.commands,
            }
        )
    return {"title": results.study["title"], "sections": parts}


def _markdown(results: Results, sections: list[Section]) -> str:
    parts = [f"# {results.study['title']}"]
    for section in sections:
        parts += [f"## {section.title}"] if section.title else []
        parts += section.lines
        parts += [markdown(section.table)] if section.table is not None else []
        parts += [f"![{section.title}]({section.name}.png)"] if section.name else []
        for name, commands in section.commands:
            parts.append(f"{name}:\n\n```bash\n" + "\n".join(commands) + "\n```")
    return "\n\n".join(parts) + "\n"
