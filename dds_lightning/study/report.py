"""The report of a finished run: the table, figures, a clip and `report.md`, all from the run's files.

```
 evaluate/episodes.parquet, paths.npz ─┐
 agent/  relabel/codes.csv             ├─► report/  report.md  *.csv  *.png  episode.gif
 skill/logs  policy/logs  */stage.json ┘
```

Everything is read from files, so `report(directory)` always draws the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import read_csv
from dds_lightning.study.diagnosis import diagnose
from dds_lightning.study.findings import Findings
from dds_lightning.study.protocol import heading, paper_line
from dds_lightning.study.tables import ends, readable
from dds_lightning.tasks import known_task

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dds_lightning.console.reports import Report

DPI = 150


# ---------------------------------------------------------------------- writing


def write_report(run_dir: str | Path, task: str | None = None) -> dict[str, Any]:
    """Write `report/` of a run directory; every file whole or not at all.

    Args:
        run_dir: A directory of `dds run` with an evaluation.
        task: Name or file of its task, see `recall_task`.

    Returns:
        Paths of the files by name, and the facts that `summary_lines` prints, as plain JSON values: `task`, `main` (the
        contestant that the run is about), `protocol` (see `protocol.protocol`; None for an older run), `verdict`
        (`stage` and `text`, see `verdict.verdict`; None for an older run), `table`
        (see `tables.summary_table`), `failures` (of the main contestant; see `tables.failures_table`) and
        `diagnosis` (see `diagnosis.diagnose`).

    Raises:
        UserError: The run has no evaluation, or a file is damaged.
    """
    from dds_lightning.console.reports import plain
    from dds_lightning.study.page import page

    findings = Findings.read(Path(run_dir), task)
    folder = findings.root / "report"
    written: dict[str, Path] = {}
    tables = ("summary", "failures", "skills") if findings.task.measures_success else ("summary", "skills")
    for name in tables:
        written[name] = folder / f"{name}.csv"
        with written_whole(written[name]) as part:
            getattr(findings, name).to_csv(part, index=False, lineterminator="\n")
    logs = {stage: path for stage in ("skill", "policy") if (path := _metrics(findings.root, stage, folder))}
    written |= _draw(findings, folder, logs)
    diagnosis = diagnose(findings, logs)
    text = folder / "report.md"
    with written_whole(text) as part:
        part.write_text(
            page(findings, {name: path.name for name, path in written.items()}, diagnosis), encoding="utf-8"
        )
    failures = findings.failures[findings.failures["contestant"] == findings.main].drop(columns="contestant")
    facts = {
        "task": findings.task.name,
        "main": findings.main,
        "protocol": findings.protocol,
        "verdict": findings.verdict and findings.verdict._asdict(),
        "table": findings.summary.round(4),
        "failures": failures.round(4).astype(object).where(failures.notna(), None),
        "diagnosis": {name: table.round(4) for name, table in diagnosis.items()},
    }
    if "failures" in written:
        written["failures_table"] = written.pop("failures")  # the name belongs to the facts
    return {"report": text, **written, **plain(facts)}


def report(run_dir: str | Path, task: str | None = None) -> Report:
    """Write the report of a run directory again, and return what is in it; arguments as of `write_report`.

    Raises:
        UserError: See `write_report`.
    """
    from dds_lightning.console.reports import Report

    written = write_report(run_dir, task)
    paths = [f"{name}: {path}" for name, path in written.items() if isinstance(path, Path)]
    return Report(written, [*summary_lines(written), *paths])


def summary_lines(facts: Mapping[str, Any]) -> list[RenderableType]:
    """Format the facts of `write_report` for a terminal: the table, and where the main contestant's failures ended."""
    from dds_lightning.console.reports import table

    task, protocol = known_task(facts["task"]), facts.get("protocol")
    summary = readable(pd.DataFrame(facts["table"]), task)
    text: list[RenderableType] = [heading(protocol) if protocol else facts["task"], table(summary)]
    if line := paper_line(task):
        text.append(line)
    if weak := facts.get("verdict"):
        text.append(weak["text"])
    failures = pd.DataFrame(facts["failures"])
    if not task.measures_success:
        return text
    if failures.empty:
        return [*text, f"{facts['main']}: no episode failed"]
    title = f"{facts['main']}: where {failures['episodes'].sum()} failed episodes ended"
    return [*text, table(ends(failures), title)]


# ---------------------------------------------------------------------- drawing


def _draw(findings: Findings, folder: Path, logs: Mapping[str, Path]) -> dict[str, Path]:
    """Draw every figure that the run's files and its task allow."""
    from dds_lightning.interpret.draw import bars, curves

    written: dict[str, Path] = {}

    def keep(name: str, figure: Any) -> None:
        written[name] = folder / f"{name}.png"
        with written_whole(written[name]) as part:
            # Without matplotlib's version in the metadata, the same picture gives the same bytes.
            figure.savefig(part, format="png", dpi=DPI, metadata={"Software": None})

    if findings.task.maze_map is not None:
        _draw_maze(findings, folder, keep, written)
    else:
        keep("scores", bars.plot_scores(findings.summary))
    if logs:
        keep("training", curves.plot_training_curves(dict(logs)))
    return written


def _draw_maze(findings: Findings, folder: Path, keep: Any, written: dict[str, Path]) -> None:
    from dds_lightning.interpret.draw import clip, maze
    from dds_lightning.study.skill_replays import stored_replays

    task, result, main = findings.task, findings.result, findings.main
    if result.paths:
        keep("trajectories", maze.plot_trajectories(task, result, main))
        first = maze.choose_episodes(result, main)[0]
        written["clip"] = folder / "episode.gif"
        clip.write_clip(written["clip"], task, result.paths[main, first], main)
        if findings.singles:
            keep("single_skills", maze.plot_single_skills(task, result, findings.singles))
    keep("failed_ends", maze.plot_failures(task, result, main))
    agent = findings.root / "agent"
    if (agent / "SHA256SUMS").is_file():
        stored = stored_replays(folder / "replays.npz", task, agent)
        starts, positions, codes, alive = (stored[name] for name in ("starts", "positions", "codes", "alive"))
        keep("starts_by_skill", maze.plot_starts_by_skill(task, starts, positions, codes, alive))
        keep("skills_by_start", maze.plot_skills_by_start(task, starts, positions, codes, alive))
        keep("values", _value_map(findings, agent))


def _value_map(findings: Findings, directory: Path) -> Any:
    """Draw the published critic over the maze, with the likeliest codes and where they lead according to the data."""
    import numpy as np

    from dds_lightning.agent import DDSAgent
    from dds_lightning.interpret.draw.values import plot_value_map, value_and_codes

    policy = DDSAgent.load(directory).policy
    assert policy is not None, "a run's agent has a policy"
    value, codes = value_and_codes(policy)
    directions = None
    if "dx" in findings.skills:
        directions = np.nan_to_num(findings.skills[["dx", "dy"]].to_numpy())
    return plot_value_map(findings.task, value, codes, directions)


def _metrics(root: Path, stage: str, folder: Path) -> Path | None:
    """Merge the metrics of a training that may have been interrupted: each launch logged to a separate file.

    What a launch logged after the step from which the next one resumed is left out.
    """
    numbered = [path for path in (root / stage / "logs").glob("version_*") if path.name[8:].isdecimal()]
    folders = sorted(numbered, key=lambda path: int(path.name[8:]))
    launches: list[pd.DataFrame] = []
    for path in (entry / "metrics.csv" for entry in folders):
        if not path.is_file() or not path.stat().st_size:
            continue
        launch = read_csv(path, {"step": "iuf"}, remedy=f"delete it, or train {stage} again")
        if launch.empty:
            continue
        launches = [earlier[earlier["step"] < launch["step"].min()] for earlier in launches]
        launches.append(launch)
    if not launches:
        return None
    with written_whole(folder / f"{stage}_metrics.csv") as part:
        pd.concat(launches).to_csv(part, index=False, lineterminator="\n")
    return folder / f"{stage}_metrics.csv"
