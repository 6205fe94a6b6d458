"""Steps that are done in processes of their own while the step in front of them uses one core."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dds_lightning.console.interrupts import Interrupted
from dds_lightning.errors import ToldAlreadyError
from dds_lightning.pipeline.child import Children, tell
from dds_lightning.pipeline.context import Run
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.pipeline.steps import Step, every_step
from dds_lightning.saving.run_directory import Done

Work = Callable[[Path, bool], Mapping[str, Any]]


class Beside:
    """What is being done beside the steps in front.

    A step begins as soon as those that it reads are done and a core is free. What it fails with is told at once, and
    raised where its result is needed: the step in front goes on. A step in front that fails is told as well, and what
    is being done beside it comes to its end. Ctrl-C and SIGTERM stop all of them, where they can be resumed.

    Args:
        run: The run.
        steps: Those that may be done beside others, in the order in which they begin.
        do: Does a step by this work, or finds that it is done.
        lanes: How many are done at the same time; 0 leaves all of them to the caller.
    """

    def __init__(self, run: Run, steps: Sequence[Step], do: Callable[[Step, Work], Done], lanes: int) -> None:
        self.run, self.do, self.lanes = run, do, lanes
        self._waiting = list(steps)
        self._futures: dict[str, Future[Done]] = {}
        self._children = Children(max(lanes, 1))
        self._lock = threading.Lock()
        self._open = False

    def begin(self) -> None:
        """From now on, begin what can begin."""
        self._open = self.lanes > 0
        self._begin_ready()

    def take(self, step: Step) -> Done | None:
        """The result of a step that has begun, for which this waits; None if it is the caller's to do."""
        with self._lock:
            if step in self._waiting:
                self._waiting.remove(step)
        future = self._futures.get(step.name)
        return None if future is None or future.cancel() else future.result()

    def _begin_ready(self) -> None:
        with self._lock:
            ready = [step for step in self._waiting if self._open and self.run.done.keys() >= set(step.reads)]
            for step in ready:
                self._waiting.remove(step)
                self._futures[step.name] = self._children.submit(self._do, step)

    def _do(self, step: Step) -> Done:
        def work(folder: Path, resuming: bool) -> Mapping[str, Any]:
            arguments = (self.run.wanted, self.run.done, step.name, folder, resuming)
            made: Mapping[str, Any] = self._children.run(step.name, f"{__name__}:work_of", *arguments)
            return made

        try:
            done = self.run.done[step.name] = self.do(step, work)
        except BaseException as error:
            if self._open and not isinstance(error, Interrupted):
                why = "" if isinstance(error, ToldAlreadyError) else f": {error}"
                tell(f"{step.name} has failed{why}; what is being done beside it goes on")
            raise
        self._begin_ready()
        return done

    # ---------------------------------------------------------------- the end

    def __enter__(self) -> Self:
        """Nothing begins before `begin`."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Begin nothing more; stop what is being done where that was asked for, else wait for it."""
        with self._lock:
            self._open = False
            self._waiting.clear()
        going_on = [name for name, future in self._futures.items() if future.running()]
        if error is not None and going_on and not isinstance(error, Interrupted):
            tell(f"{error or kind}; the run ends when {' and '.join(going_on)} beside it has come to its end")
        self._children.__exit__(kind, error, _)


def work_of(
    settings: RunSettings, done: Mapping[str, Done], name: str, folder: Path, resuming: bool
) -> Mapping[str, Any]:
    """In a process of its own, do the work of a step of a run."""
    run = Run(settings)
    run.done.update(done)
    step = next(step for step in every_step() if step.name == name)
    return dict(step.work(run, folder, resuming))
