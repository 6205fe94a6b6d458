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
    """Run a study, that is, every cell of a grid over tasks, methods, settings and seeds, and write its report.

    Work that several cells share is done once, even across studies in the same folder. Finished work is skipped, and
    a training that was killed continues from its last checkpoint. A cell that fails does not stop the others; its
    reason is printed at the end and stands in the report (exit status 1). Packaged studies: table2 (K and D), table3
    (encoder and decoder), figure5 (learning online), figure6 (H, and steps executed of it), ours (our own choices),
    baselines (all methods on two tasks).

    With --json: `study`, `report` (the page), `table` (a row for each cell), `comparison` and `failed` (cell: reason).

    Args:
        file: A study file (README, "Compare many settings"), or the name of a packaged one.
        out: Folder of the results; studies in the same folder share their work.
        engine: Where jobs run: in processes on this machine, on Ray (the cluster at `RAY_ADDRESS`, else this machine),
            or on Slurm through submitit.
        workers: Jobs that run at the same time; by default one for each core here, or as many as the cluster takes.
        scale: Factor on all budgets (steps of trainings and of data, episodes); 0.01 gives a quick trial.
        cpus: Cores for each job on Ray or Slurm.
        gpus: GPUs for each job on Ray or Slurm; Ray also takes a fraction.
        minutes: Time limit of a job on Slurm; a job that needs longer is queued again and continues.
        plan: Only print how much there is to do.
        known: `results.json` of reports, or their folders; cells that they hold, for example from another machine, are
            not run again.
    """
    from dds_lightning.grid.run import Asked, run_study

    return run_study(Asked(file, Path(out), engine, workers, scale, cpus, gpus, minutes, plan, _places(known)))


def report(directory: str, known: list[str] | str | None = None) -> Report:
    """Write the report of a study again, as one self-contained page and as Markdown; the study need not be finished.

    Args:
        directory: Folder of the study in the folder that `dds study run` wrote, for example runs/study/table2.
        known: `results.json` of reports, or their folders, for example from other machines; their cells join this
            report.
    """
    from dds_lightning.grid.report import report_study

    return report_study(Path(directory), _places(known))


def _places(given: list[str] | str | None) -> list[Path]:
    return [Path(one) for one in ([given] if isinstance(given, str) else given or [])]
