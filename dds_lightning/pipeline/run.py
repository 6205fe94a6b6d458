"""`dds run`: the steps of `pipeline.steps`, in one directory, each done once, side by side where that is possible.

The trainings are the very commands `dds skill fit`, `dds policy fit` and `dds clone fit`, which are printed.
"""

import re
import time
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from dds_lightning.console.reports import Report
from dds_lightning.envs.pool import available_cores
from dds_lightning.errors import UserError
from dds_lightning.pipeline.beside import Beside, Work
from dds_lightning.pipeline.child import Lines, await_turn
from dds_lightning.pipeline.context import Run
from dds_lightning.pipeline.record import keep
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.pipeline.steps import STEPS, Step, reading_starts
from dds_lightning.saving.run_directory import MARKER, Done, RunDirectory, duration, locked, read_marker
from dds_lightning.saving.untrusted import parsing
from dds_lightning.study.run_task import keep_task


def run_all(settings: RunSettings) -> Report:
    """Do every step that is not done yet, up to the one asked for, and report what they made.

    Raises:
        UserError: A setting that cannot work, found before anything is written.
    """
    run, started = Run(settings), time.monotonic()
    with locked(run.out):
        _refuse_other_run(run)
        if run.task != run.asked:
            chosen = f"evaluating in {run.task.name} ({run.task.env_id})"
            run.say(f"the data were recorded in another physics than {run.asked.name}'s: {chosen}")
        keep_task(run.out, run.task)
        keep(settings)
        _do_steps(run)
    return _report(run, time.monotonic() - started)


def _do_steps(run: Run) -> None:
    """Do the steps in their order, and those that may be done beside others as soon as there is a core for them."""
    directory, told = (RunDirectory(run.out, console, run.wanted.fresh) for console in (run.console, Lines()))
    names = list(STEPS)
    last = names.index(run.wanted.until) if run.wanted.until in names else len(names)
    steps = [reading_starts(STEPS[name], run) for name in names[: last + 1]]
    parts = [part for step in steps for part in (step.ahead, step) if part is not None and part.beside]

    # Here and not when they begin: parsers and filters of warnings are not made for two threads.
    known = {part.name: (part.settings(run), part.former(run) if part.former else None) for part in parts}

    def do(step: Step, work: Work, directory: RunDirectory = told) -> Done:
        settings, former = known.get(step.name) or (step.settings(run), step.former(run) if step.former else None)
        reads = [run.done[name] for name in step.reads]
        return directory.do(step.name, step.title(run), settings, reads, work, former)

    def front(step: Step) -> Done:
        def work(folder: Path, resuming: bool) -> Mapping[str, Any]:
            await_turn()
            if step.one_core:
                beside.begin()
            return step.work(run, folder, resuming)

        return do(step, work, directory)

    with Beside(run, parts, do, lanes=(run.wanted.jobs or available_cores()) - 1) as beside:
        for step in steps:
            if step.ahead is not None and not _is_done(run, step, directory):
                run.done[step.ahead.name] = beside.take(step.ahead) or front(step.ahead)
            run.done[step.name] = beside.take(step) or front(step)
            if step.name == "data":
                run.trainings.refuse_late_validations(int(run.facts("data")["facts"]["steps"]))


def _is_done(run: Run, step: Step, directory: RunDirectory) -> bool:
    return directory.find(step.name, step.settings(run), [run.done[name] for name in step.reads]) is not None


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


def _report(run: Run, clock: float) -> Report:
    """The table, where failures ended, and where everything lies; `clock` is how many seconds this call took."""
    done = [run.done[name] for name in STEPS if name in run.done]
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
    if "online" in run.done and (played := run.facts("online").get("played")):
        data["online"] = played
        text.append(f"after learning online: score {played['score']:.1f} over {played['episodes']} episodes, sampled")
    text += [f"{name}: {path}" for step in shown for name, path in step.outputs.items()]
    total = duration(sum(step.seconds for step in run.done.values()))
    text.append(f"{total} in all, {duration(clock)} by the clock in this call; everything is in {run.out}")
    return Report(data, text)
