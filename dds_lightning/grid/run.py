"""`dds study run`: plan the cells of a study file, do what is not done yet, and write its report.

```
 OUT/nodes/KIND-HASH/    one piece of work each, shared by all studies in OUT
 OUT/logs/KIND-HASH.txt  what it printed
 OUT/NAME/cells.json     the cells of the study NAME, and the evaluation that each is
 OUT/NAME/known.json     what cells have found elsewhere (--known)
 OUT/NAME/state.json     wall time of all launches, and why jobs failed in the last
 OUT/NAME/report/        tables, figures, one page, and results.json, from which another folder can go on
```
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dds_lightning.console.progress import on_terminal, progress_bar
from dds_lightning.console.reports import Report
from dds_lightning.console.terminal import Terminal
from dds_lightning.envs.pool import available_cores
from dds_lightning.grid.cells import Cell, Study, counted
from dds_lightning.grid.engines import Engine, Local, RayTasks, Slurm, refuse_request
from dds_lightning.grid.file import find_study, read_study
from dds_lightning.grid.found import Found, found_elsewhere
from dds_lightning.grid.job import LOGS, NODES
from dds_lightning.grid.loop import Progress, run_nodes
from dds_lightning.grid.nodes import Node, in_order, needed, plan
from dds_lightning.grid.results import CELLS, KNOWN, STATE, read_state, refuse_other_study
from dds_lightning.saving.run_directory import Done, duration, finished, locked, write_json


@dataclass(frozen=True)
class Asked:
    """What `dds study run` was asked to do; see its help."""

    file: str
    out: Path = Path("runs/study")
    engine: str = "local"
    workers: int | None = None
    scale: float = 1.0
    cpus: int = 1
    gpus: float = 0
    minutes: int = 240
    plan_only: bool = False
    known: Sequence[Path] = ()


def run_study(asked: Asked) -> Report:
    """Do every cell that is not done yet, and report all of them.

    Returns:
        Its status is 1 where a cell failed: the others are done and in the report all the same.

    Raises:
        UserError: A study file or a setting that cannot work, found before anything runs.
    """
    refuse_request(asked.engine, asked.workers, asked.cpus, asked.gpus, asked.minutes)
    path = find_study(asked.file)
    study = read_study(path, asked.scale)
    cells = plan(study)
    nodes = in_order(node for _, node in cells.values())
    place = asked.out / (path.stem if study.scale == 1 else f"{path.stem}@{study.scale:g}")
    known = found_elsewhere(place / KNOWN, asked.known, nodes)
    if asked.plan_only:
        return _planned(asked, study, cells, nodes, known)
    with locked(asked.out):
        refuse_other_study(place, study.title, path)
        write_json(place / CELLS, _table(study, cells, path, asked))
        if known.outcomes:
            known.save(place / KNOWN)
        before, began, failed = read_state(place)[0], time.monotonic(), dict[str, str]()
        try:
            failed = do_nodes(asked, nodes, known)
        finally:
            write_json(place / STATE, {"wall": round(before + time.monotonic() - began, 1), "failed": failed})
    from dds_lightning.grid.report import report_study

    report = report_study(place)
    why = {cells[key][0].name(): reason for key, reason in failed.items() if key in cells}
    told = [f"{nodes[key].title}: {reason}" for key, reason in failed.items() if not reason.startswith("not done")]
    report.data["failed"] = why
    if failed:
        report.text += [
            f"{len(why)} of {counted(len(cells), 'cell')} failed; run the same command to try again:",
            *told,
        ]
        report.text.append(f"the output of each job is in {asked.out / LOGS}")
        report.status = 1
    return report


def do_nodes(asked: Asked, nodes: Mapping[str, Node], known: Found) -> dict[str, str]:
    """Do those nodes that are not done and are needed.

    Args:
        asked: Says where and how.
        nodes: Of all cells, each after what it reads.
        known: What was found elsewhere.

    Returns:
        Key -> why it failed.
    """
    console = Terminal(stderr=True)
    progress = Progress(0, 1)
    here = _finished(asked, nodes)
    done = here.keys() | known.outcomes.keys()
    for key, node in nodes.items():
        if (work := here.get(key) or known.works.get(key)) is not None:
            progress.past[node.kind].append(work.seconds)
    todo = needed(nodes, done)
    progress.total = len(todo)
    console.print(f"{counted(len(nodes), 'job')}: {len(todo)} to do, the others done before or not needed")
    if not todo:
        return {}
    engine = _engine(asked)
    progress.slots = engine.slots
    shown = on_terminal()
    try:
        with progress_bar(
            ("spinner", "bar", "count", "{task.description}"), len(todo), shown=shown, console=console
        ) as bar:

            def tell(line: str) -> None:
                bar(completed=progress.done, description=line.rpartition("; ")[2] if "; " in line else "")
                console.print(line, soft_wrap=True)

            return run_nodes(todo, str(asked.out.absolute()), engine, progress, tell)
    finally:
        engine.close()


def _engine(asked: Asked) -> Engine:
    if asked.engine == "ray":
        return RayTasks(asked.workers, asked.cpus, asked.gpus)
    if asked.engine == "slurm":
        return Slurm(asked.out / "slurm", asked.workers, asked.cpus, asked.gpus, asked.minutes)
    return Local(asked.workers or available_cores())


def _table(study: Study, cells: Mapping[str, tuple[Cell, Node]], path: Path, asked: Asked) -> dict[str, Any]:
    """What the report needs to know about the cells, as JSON values, and the study file that they are from."""
    rows = [
        {"key": key, **asdict(cell), "nodes": list(in_order([node])), "title": cell.name()}
        for key, (cell, node) in cells.items()
    ]
    words = ["dds", "study", "run", asked.file, f"--out={asked.out}"]
    words += [] if study.scale == 1 else [f"--scale={study.scale:g}"]
    told = {"file": str(path.absolute()), "command": shlex.join(words)}
    return {"format": 1, "study": asdict(study), "cells": rows, **told}


def _finished(asked: Asked, nodes: Mapping[str, Node]) -> dict[str, Done]:
    """What is done in this study's folder."""
    return {key: done for key in nodes if (done := finished(asked.out / NODES / key)) is not None}


def _planned(
    asked: Asked, study: Study, cells: Mapping[str, tuple[Cell, Node]], nodes: Mapping[str, Node], known: Found
) -> Report:
    """What would be done."""
    done = _finished(asked, nodes).keys() | known.outcomes.keys()
    kinds: dict[str, int] = {}
    for node in needed(nodes, done).values():
        kinds[node.kind] = kinds.get(node.kind, 0) + 1
    budget = f"; stated budget: {duration(60 * study.budget * study.scale)} of one core" if study.budget else ""
    told = ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "nothing"
    lines: list[Any] = [f"{study.title}: {counted(len(cells), 'cell')}{budget}", f"jobs to do: {told}"]
    return Report({"title": study.title, "cells": len(cells), "jobs": kinds, "done_before": len(done)}, lines)
