"""One run directory, what was asked of it, and what its finished steps have made."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dds_lightning.console.terminal import Terminal
from dds_lightning.errors import UserError
from dds_lightning.pipeline.settings import RunSettings, Trainings
from dds_lightning.saving.run_directory import Done
from dds_lightning.tasks import Task, get_task, is_own
from dds_lightning.training.fit import quieten

Settings = dict[str, Any]
"""What a step depends on; JSON values."""


class Run:
    """One run directory and what was asked of it.

    Args:
        settings: What was asked for; checked before the first file is written.

    Attributes:
        task: The task, in the variant in which the data were recorded.
        asked: The task as it was asked for.
        data_hash: Hash of the files that were given; None where data are collected.
        console: Where progress is printed.
        done: Name -> finished step.
    """

    def __init__(self, settings: RunSettings) -> None:
        quieten()
        self.wanted: RunSettings = settings
        self.task: Task = get_task(settings.task)
        self.asked = self.task
        self.out = settings.out
        for name, value in (
            ("data_steps", settings.data_steps),
            ("clone_steps", settings.clone_steps),
            ("episodes", self.episodes),
            ("episodes_per_skill", settings.episodes_per_skill),
            ("jobs", 1 if settings.jobs is None else settings.jobs),
        ):
            if value < 1:
                raise UserError(f"--{name} is {value}, expected at least 1")
        self.data_hash = self._look_at_data()
        self.trainings: Trainings = Trainings(settings, self.task)
        if is_own(self.task):
            _try_environment(self.task)
        self.console = Terminal(stderr=True)
        self.done: dict[str, Done] = {}

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
        return self.done[step].outputs[name]

    def facts(self, step: str) -> Mapping[str, Any]:
        """The small results of a finished step."""
        return self.done[step].facts

    def say(self, text: str, style: str | None = None) -> None:
        """Tell the person at the terminal."""
        self.console.print(text, style=style, soft_wrap=True)


def _try_environment(task: Task) -> None:
    """Take one step: what an environment does wrong is told before anything is trained for it."""
    env = task.make_env()
    try:
        env.reset(seed=0)
        env.step(task.action_box()[0])
    finally:
        env.close()
