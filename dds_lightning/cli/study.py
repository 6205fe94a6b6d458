"""`dds study`: run a grid of trainings, and report it."""

from pathlib import Path
from typing import Literal

from dds_lightning.console.reports import Report


def run(
    file: str,
    out: str = "runs/study",
    engine: Literal["local", "ray", "slurm"] = "local",
    workers: int | None = None,
    scale: float = 1.0,
    cpus: int = 1,
    gpus: float = 0,
    minutes: int = 240,
    plan: bool = False,
    known: list[str] | str | None = None,
) -> Report:
    """Run a study: every cell of a grid over tasks, methods, settings and seeds, then its report.

    What several cells need is done once, also for several studies in one folder; finished work is skipped, what was
    killed goes on from its last checkpoint, and a cell that fails is told at the end and keeps no other back (exit
    status 1). Packaged studies: table2 (K and D), table3 (encoder and decoder), figure5 (online), figure6 (H, and
    steps executed of H), ours (our own choices), baselines (all methods on two tasks).

    With --json: `study`, `report` (the page), `table` (a row for each cell), `comparison` and `failed` (cell: why).

    Args:
        file: A study file (README, "Compare many settings"), or the name of a packaged one.
        out: Folder; studies in the same one share their work.
        engine: Where jobs run: processes here, Ray (`RAY_ADDRESS`, else here), or Slurm by submitit.
        workers: Jobs at once; without it one for each core here, and what the cluster takes elsewhere.
        scale: Factor on all budgets, steps of trainings, of data and episodes: 0.01 tries a study.
        cpus: Cores of each job on Ray or Slurm.
        gpus: GPUs of each job on Ray or Slurm.
        minutes: Time limit of a job on Slurm, after which it is queued again and goes on.
        plan: Only say how much there is to do.
        known: `results.json` of reports, or their folders: what they hold, from another machine say, is not done again.
    """
    from dds_lightning.grid.run import Asked, run_study

    return run_study(Asked(file, Path(out), engine, workers, scale, cpus, gpus, minutes, plan, _places(known)))


def report(directory: str, known: list[str] | str | None = None) -> Report:
    """Write the report of a study again: one page to keep, and Markdown; a study that is not finished has one too.

    Args:
        directory: Folder of the study in the folder that `dds study run` wrote, for example runs/study/table2.
        known: `results.json` of reports, or their folders: cells that other machines have done join this report.
    """
    from dds_lightning.grid.report import report_study

    return report_study(Path(directory), _places(known))


def _places(given: list[str] | str | None) -> list[Path]:
    return [Path(one) for one in ([given] if isinstance(given, str) else given or [])]
