"""`dds run`: the steps of `pipeline.steps` in order, in one directory, each done once.

The trainings are the very commands `dds skill fit`, `dds policy fit` and `dds clone fit`, which are printed.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError
from dds_lightning.pipeline.settings import RunSettings, Trainings
from dds_lightning.pipeline.steps import STEPS
from dds_lightning.saving.run_directory import Done, RunDirectory, duration, locked
from dds_lightning.study.run_task import keep_task
from dds_lightning.tasks import Task, get_task
from dds_lightning.training.fit import quieten


def run_all(settings: RunSettings) -> Report:
    """Do every step that is not done yet.

    Raises:
        UserError: A setting that cannot work, found before anything is written.
    """
    return Run(settings).everything()


class Run:
    """One run directory and what was asked of it.

    Args:
        settings: What was asked for; checked before the first file is written.

    Attributes:
        task: In the variant in which the data were recorded.
        data_hash: Of the files that were given; None where data are collected.
    """

    def __init__(self, settings: RunSettings) -> None:
        quieten()
        self.wanted: RunSettings = settings
        self.task: Task = get_task(settings.task)
        self._asked = self.task
        self.out = settings.out
        for name, value in (
            ("data_steps", settings.data_steps),
            ("clone_steps", settings.clone_steps),
            ("episodes", self.episodes),
            ("episodes_per_skill", settings.episodes_per_skill),
        ):
            if value < 1:
                raise UserError(f"--{name} is {value}, expected at least 1")
        self.data_hash = self._look_at_data()
        self.trainings: Trainings = Trainings(settings, self.task)
        self._console = Console(stderr=True)
        self._done: dict[str, Done] = {}

    def _look_at_data(self) -> str | None:
        """Hash of the files that were given, and the task in the variant in which they were recorded."""
        spec = self.wanted.data
        if spec is None:
            from datamodules.collect.collectors import refuse_uncollectable

            refuse_uncollectable(self.task)
            return None
        from datamodules.sources import resolve_task
        from datamodules.sources.stat_hash import stat_hash

        files = stat_hash(spec)
        self.task = resolve_task(spec, self.task)
        return files

    # ---------------------------------------------------------------- what steps ask

    @property
    def episodes(self) -> int:
        """Evaluation episodes of each contestant."""
        return self.task.evaluation_episodes if self.wanted.episodes is None else self.wanted.episodes

    @property
    def data_spec(self) -> str:
        """Where the data are, as `--data` takes it; once they are there."""
        return self.wanted.data or f"local:{self.output('data', 'data')}"

    def output(self, step: str, name: str) -> Path:
        """A file or folder that a finished step made."""
        return self._done[step].outputs[name]

    def facts(self, step: str) -> Mapping[str, Any]:
        """The small results of a finished step."""
        return self._done[step].facts

    def say(self, text: str, style: str | None = None) -> None:
        """Tell the person at the terminal."""
        self._console.print(text, style=style, highlight=False, soft_wrap=True)

    # ---------------------------------------------------------------- doing it

    def everything(self) -> Report:
        """Do the steps up to the one asked for, and report what they made."""
        with locked(self.out):
            if self.task != self._asked:
                chosen = f"evaluating in {self.task.name} ({self.task.env_id})"
                self.say(f"the data were recorded in another physics than {self._asked.name}'s: {chosen}")
            keep_task(self.out, self.task)
            directory = RunDirectory(self.out, self._console, self.wanted.fresh)
            for step in STEPS.values():
                self._done[step.name] = directory.do(
                    step.name,
                    step.title(self),
                    step.settings(self),
                    [self._done[name] for name in step.reads],
                    partial(step.work, self),
                    step.former(self) if step.former else None,
                )
                if step.name == self.wanted.until:
                    break
        return self._report()

    def _report(self) -> Report:
        """The table, where failures ended, and where everything lies."""
        done = list(self._done.values())
        data: dict[str, Any] = {
            "task": self.task.name,
            "out": self.out,
            "seed": self.wanted.seed,
            "seconds": {step.name: step.seconds for step in done},
            "done_before": [step.name for step in done if step.skipped],
            "outputs": {step.name: step.outputs for step in done},
        }
        text: list[Any] = []
        shown = done
        if "report" in self._done:
            from dds_lightning.study.report import summary_lines

            data |= self.facts("report")
            text += summary_lines(self.facts("report"))
            shown = [self._done["report"]]
            text.append(f"agent: {self.output('evaluate', 'agent')}")
        text += [f"{name}: {path}" for step in shown for name, path in step.outputs.items()]
        total = sum(step.seconds for step in done)
        text.append(f"{duration(total)} in all; everything is in {self.out}")
        return Report(data, text)
