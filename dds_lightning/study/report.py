"""A finished run as a person looks at it: the table, figures, a clip and `report.md`, all from the run's files.

```
 evaluate/episodes.parquet, paths.npz ─┐
 agent/  relabel/codes.csv             ├─► report/  report.md  *.csv  *.png  episode.gif
 skill/logs  policy/logs  */stage.json ┘
```

Nothing is taken from memory, so `report(directory)` draws the same again whenever it is called.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from dds_lightning.saving.files import written_whole
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


def write_report(run_dir: str | Path) -> dict[str, Any]:
    """Write `report/` of a run directory; every file whole or not at all.

    Args:
        run_dir: a directory of `dds run`, evaluated.

    Returns:
        Paths of the files by name, and the facts that `told` prints, as plain JSON values: `task`, `main` (the
        contestant that the run is about), `protocol` (see `protocol.protocol`; None of an older run), `table`
        (see `tables.summary_table`), `failures` (of the main contestant; see `tables.failures_table`) and
        `diagnosis` (see `diagnosis.diagnose`).

    Raises:
        UserError: nothing has been evaluated there, or a file is damaged.
    """
    from dds_lightning.console.reports import plain
    from dds_lightning.study.page import page

    found = Findings.read(Path(run_dir))
    folder = found.root / "report"
    made: dict[str, Path] = {}
    tables = ("summary", "failures", "skills") if found.task.measures_success else ("summary", "skills")
    for name in tables:
        made[name] = folder / f"{name}.csv"
        with written_whole(made[name]) as part:
            getattr(found, name).to_csv(part, index=False, lineterminator="\n")
    logs = {stage: path for stage in ("skill", "policy") if (path := _metrics(found.root, stage, folder))}
    made |= _draw(found, folder, logs)
    diagnosis = diagnose(found, logs)
    text = folder / "report.md"
    with written_whole(text) as part:
        part.write_text(page(found, {name: path.name for name, path in made.items()}, diagnosis), encoding="utf-8")
    failures = found.failures[found.failures["contestant"] == found.main].drop(columns="contestant")
    facts = {
        "task": found.task.name,
        "main": found.main,
        "protocol": found.protocol,
        "table": found.summary.round(4),
        "failures": failures.round(4).astype(object).where(failures.notna(), None),
        "diagnosis": {name: table.round(4) for name, table in diagnosis.items()},
    }
    if "failures" in made:
        made["failures_table"] = made.pop("failures")  # the name belongs to the facts
    return {"report": text, **made, **plain(facts)}


def report(run_dir: str | Path) -> Report:
    """Write the report of a run directory once more, and tell what is in it.

    Raises:
        UserError: as `write_report`.
    """
    from dds_lightning.console.reports import Report

    made = write_report(run_dir)
    paths = [f"{name}: {path}" for name, path in made.items() if isinstance(path, Path)]
    return Report(made, [*told(made), *paths])


def told(facts: Mapping[str, Any]) -> list[RenderableType]:
    """The facts of `write_report` for a terminal: the table, and where the main contestant's failures ended."""
    from dds_lightning.console.reports import table

    task, protocol = known_task(facts["task"]), facts.get("protocol")
    summary = readable(pd.DataFrame(facts["table"]), task)
    text: list[RenderableType] = [heading(protocol) if protocol else facts["task"], table(summary)]
    if line := paper_line(task):
        text.append(line)
    failures = pd.DataFrame(facts["failures"])
    if not task.measures_success:
        return text
    if failures.empty:
        return [*text, f"{facts['main']}: no episode failed"]
    title = f"{facts['main']}: where {failures['episodes'].sum()} failed episodes ended"
    return [*text, table(ends(failures), title)]


# ---------------------------------------------------------------------- drawing


def _draw(found: Findings, folder: Path, logs: Mapping[str, Path]) -> dict[str, Path]:
    """Every figure that the run's files and its task allow."""
    from dds_lightning.interpret.draw import bars, curves

    made: dict[str, Path] = {}

    def keep(name: str, figure: Any) -> None:
        made[name] = folder / f"{name}.png"
        with written_whole(made[name]) as part:
            # Without the version of matplotlib in it, the same picture is the same file.
            figure.savefig(part, format="png", dpi=DPI, metadata={"Software": None})

    if found.task.maze_map is not None:
        _draw_maze(found, folder, keep, made)
    else:
        keep("scores", bars.plot_scores(found.summary))
    if logs:
        keep("training", curves.plot_training_curves(dict(logs)))
    return made


def _draw_maze(found: Findings, folder: Path, keep: Any, made: dict[str, Path]) -> None:
    from dds_lightning.interpret.draw import clip, maze
    from dds_lightning.study.skill_replays import stored_replays

    task, result, main = found.task, found.result, found.main
    if result.paths:
        keep("trajectories", maze.plot_trajectories(task, result, main))
        first = maze.choose_episodes(result, main)[0]
        made["clip"] = folder / "episode.gif"
        clip.write_clip(made["clip"], task, result.paths[main, first], main)
        if found.singles:
            keep("single_skills", maze.plot_single_skills(task, result, found.singles))
    keep("failed_ends", maze.plot_failures(task, result, main))
    agent = found.root / "agent"
    if (agent / "SHA256SUMS").is_file():
        stored = stored_replays(folder / "replays.npz", task, agent)
        starts, positions, codes, alive = (stored[name] for name in ("starts", "positions", "codes", "alive"))
        keep("starts_by_skill", maze.plot_starts_by_skill(task, starts, positions, codes, alive))
        keep("skills_by_start", maze.plot_skills_by_start(task, starts, positions, codes, alive))
        keep("values", _value_map(found, agent))


def _value_map(found: Findings, directory: Path) -> Any:
    """The published critic over the maze, with the policy's likeliest codes and where the data say they lead."""
    import numpy as np

    from dds_lightning.agent import DDSAgent
    from dds_lightning.interpret.draw.values import plot_value_map, value_and_codes

    policy = DDSAgent.load(directory).policy
    assert policy is not None, "a run's agent has a policy"
    value, codes = value_and_codes(policy)
    directions = None
    if "dx" in found.skills:
        directions = np.nan_to_num(found.skills[["dx", "dy"]].to_numpy())
    return plot_value_map(found.task, value, codes, directions)


def _metrics(root: Path, stage: str, folder: Path) -> Path | None:
    """One metrics file of a training that may have been interrupted: each launch logged into its own.

    What a launch logged after the step from which the next one went on was lost, and is left out.
    """
    folders = sorted((root / stage / "logs").glob("version_*"), key=lambda path: int(path.name.split("_")[1]))
    launches: list[pd.DataFrame] = []
    for path in (entry / "metrics.csv" for entry in folders):
        if not path.is_file() or not path.stat().st_size:
            continue
        launch = pd.read_csv(path)
        launches = [earlier[earlier["step"] < launch["step"].min()] for earlier in launches]
        launches.append(launch)
    if not launches:
        return None
    with written_whole(folder / f"{stage}_metrics.csv") as part:
        pd.concat(launches).to_csv(part, index=False, lineterminator="\n")
    return folder / f"{stage}_metrics.csv"
