"""`dds run`: the steps of `pipeline.steps` in order, in one directory, each done once.

The trainings are the very commands `dds skill fit`, `dds policy fit` and `dds clone fit`, which are printed.
"""

import re
from contextlib import nullcontext
from functools import partial
from typing import Any

from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError
from dds_lightning.pipeline.context import Run
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.pipeline.steps import STEPS
from dds_lightning.saving.run_directory import MARKER, RunDirectory, duration, locked, read_marker
from dds_lightning.saving.untrusted import parsing
from dds_lightning.study.run_task import keep_task


def run_all(settings: RunSettings) -> Report:
    """Do every step that is not done yet, up to the one asked for, and report what they made.

    Raises:
        UserError: A setting that cannot work, found before anything is written.
    """
    run = Run(settings)
    with locked(run.out):
        _refuse_other_run(run)
        if run.task != run.asked:
            chosen = f"evaluating in {run.task.name} ({run.task.env_id})"
            run.say(f"the data were recorded in another physics than {run.asked.name}'s: {chosen}")
        keep_task(run.out, run.task)
        directory = RunDirectory(run.out, run.console, settings.fresh)
        for step in STEPS.values():
            run.done[step.name] = directory.do(
                step.name,
                step.title(run),
                step.settings(run),
                [run.done[name] for name in step.reads],
                partial(step.work, run),
                step.former(run) if step.former else None,
            )
            if step.name == "data":
                run.trainings.refuse_late_validations(int(run.facts("data")["facts"]["steps"]))
            if step.name == settings.until:
                break
    return _report(run)


def _refuse_other_run(run: Run) -> None:
    """Refuse to put another task's run away, whatever its physics: the folder was mistyped.

    Raises:
        UserError: The folder holds the run of another task.
    """
    held = read_marker(run.out / "data").get("settings", {}).get("task")
    if held is not None and _without_physics(held) != _without_physics(run.task.name):
        raise UserError(
            f"--out is {run.out}, which holds a run of {held}, not of {run.asked.name}: give another folder, or move "
            "that one away"
        )


def _without_physics(name: str) -> str:
    return re.sub("@[^?]*", "", name)


def _report(run: Run) -> Report:
    """The table, where failures ended, and where everything lies."""
    done = list(run.done.values())
    data: dict[str, Any] = {
        "task": run.task.name,
        "out": run.out,
        "seed": run.wanted.seed,
        "seconds": {step.name: step.seconds for step in done},
        "done_before": [step.name for step in done if step.skipped],
        "outputs": {step.name: step.outputs for step in done},
    }
    text: list[Any] = []
    shown = done
    if "report" in run.done:
        from dds_lightning.study.report import summary_lines

        data |= run.facts("report")
        # Of a report that was there before, the marker may be a stranger's.
        marker, remedy = run.done["report"].folder / MARKER, "delete it, and `dds run` reports again"
        with parsing(marker, remedy) if run.done["report"].skipped else nullcontext():
            text += summary_lines(run.facts("report"))
        shown = [run.done[name] for name in ("report", "online") if name in run.done]
        text.append(f"agent: {run.output('evaluate', 'agent')}")
    text += [f"{name}: {path}" for step in shown for name, path in step.outputs.items()]
    total = sum(step.seconds for step in done)
    text.append(f"{duration(total)} in all; everything is in {run.out}")
    return Report(data, text)
