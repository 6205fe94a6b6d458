"""Where the jobs of a study run: processes on this machine, a Ray cluster, or Slurm by submitit.

An engine turns a job into a `Future` of its answer; order, sharing and what is done already are `loop`'s.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from dds_lightning.errors import UserError, lacks_extra
from dds_lightning.grid.job import Job, do_logged

Answer = dict[str, Any]
TRIES = 3
"""How often a job is begun whose process dies under it; each time it goes on from its last checkpoint."""
_START = "from dds_lightning.grid.worker import main; main()"


class Engine(Protocol):
    """Runs jobs."""

    slots: int
    """Jobs that are worth submitting at once."""

    def submit(self, job: Job) -> Future[Answer]:
        """Begin a job; the future's exception means that the engine lost it."""
        ...

    def close(self) -> None:
        """Stop what is running; it goes on from its last checkpoint the next time."""


class Local:
    """Worker processes of one thread each, which are kept from job to job.

    Args:
        workers: How many.
    """

    def __init__(self, workers: int) -> None:
        self.slots, self.closed = workers, False
        self._threads = ThreadPoolExecutor(workers)
        self._idle: queue.LifoQueue[_Worker] = queue.LifoQueue()
        self._workers: list[_Worker] = []

    def submit(self, job: Job) -> Future[Answer]:
        """As `Engine.submit`."""
        return self._threads.submit(self._do, job)

    def _do(self, job: Job) -> Answer:
        status = 0
        for _ in range(TRIES):
            if self.closed:
                return {"seconds": 0.0, "error": "stopped"}
            worker = self._worker()
            answer = worker.ask(job)
            if answer is not None:
                self._idle.put(worker)
                return answer
            self._workers.remove(worker)
            status = worker.process.wait()
        died = f"its process died {TRIES} times, last with status {status}"
        return {"seconds": 0.0, "error": f"{died}; most likely memory ran out: ask for fewer --workers"}

    def _worker(self) -> _Worker:
        try:
            return self._idle.get_nowait()
        except queue.Empty:
            worker = _Worker()
            self._workers.append(worker)
            return worker

    def close(self) -> None:
        """As `Engine.close`."""
        self.closed = True
        for worker in list(self._workers):
            worker.end()
        self._threads.shutdown(cancel_futures=True)


class _Worker:
    """One process that answers jobs."""

    def __init__(self) -> None:
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self.process = subprocess.Popen(  # noqa: S603 - this Python and a constant program, no shell
            [sys.executable, "-P", "-c", _START],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **threads, "PYTHONPATH": path},
            text=True,
            process_group=0,  # Ctrl-C is the caller's, who asks the workers to save
        )

    def ask(self, job: Job) -> Answer | None:
        """Its answer; None if the process died."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps(job) + "\n")
            self.process.stdin.flush()
        except OSError:
            return None
        line = self.process.stdout.readline()
        return json.loads(line) if line.endswith("\n") else None

    def end(self) -> None:
        """Let it save and end; its thread sees the end of its output."""
        self.process.terminate()
        try:
            self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()


class RayTasks:
    """Ray core tasks, on this machine or on the cluster that RAY_ADDRESS names.

    Args:
        workers: Tasks at once; None submits all that are ready.
        cpus: Of each task.
        gpus: Of each task; may be a fraction.

    Raises:
        UserError: Ray is not installed or does not start, or no task could ever begin on this machine.
    """

    def __init__(self, workers: int | None, cpus: int = 1, gpus: float = 0) -> None:
        ray = _package("ray", "--engine=ray needs Ray", "ray")
        self.ray, self.slots = ray, workers or 1000
        here = "RAY_ADDRESS" not in os.environ
        if not ray.is_initialized():
            count = None if workers is None else workers * cpus
            alone = {"num_cpus": count, "include_dashboard": False} if here else {}
            try:
                ray.init(log_to_driver=False, configure_logging=False, **alone)
            except Exception as error:  # Ray's own have no common class
                tried = "it does not start here" if here else f"RAY_ADDRESS={os.environ['RAY_ADDRESS']} does not answer"
                told = (str(error).splitlines() or [type(error).__name__])[0]
                raise UserError(f"--engine is ray, but {tried}: {told}") from None
        self._refuse_too_much(cpus, gpus, here)
        # A worker that is lost is Ray's to replace; an error of ours is an answer, and not tried again.
        self._do = ray.remote(max_retries=TRIES - 1, num_cpus=cpus, num_gpus=gpus)(do_logged)

    def _refuse_too_much(self, cpus: int, gpus: float, here: bool) -> None:
        """Refuse tasks that would wait for ever on this machine; say so of a cluster, which may grow."""
        nodes = [node["Resources"] for node in self.ray.nodes() if node["Alive"]]
        if any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in nodes):
            return
        most = ", ".join(f"{node.get('CPU', 0):g} and {node.get('GPU', 0):g}" for node in nodes) or "none"
        asked = f"--cpus is {cpus} and --gpus is {gpus:g}, which no node of Ray has (CPUs and GPUs of each: {most})"
        if here:
            self.close()
            raise UserError(f"{asked}: ask for less")
        warnings.warn(f"{asked}: jobs wait until such a node joins the cluster", stacklevel=3)

    def submit(self, job: Job) -> Future[Answer]:
        """As `Engine.submit`."""
        future: Future[Answer] = self._do.remote(dict(job)).future()
        return future

    def close(self) -> None:
        """As `Engine.close`."""
        self.ray.shutdown()


class Requeued:
    """A job that Slurm may preempt: it is put back in the queue and goes on from its last checkpoint."""

    def __call__(self, job: Job) -> Answer:
        """Do it."""
        return do_logged(job)

    def checkpoint(self, job: Job) -> Any:
        """What submitit submits again after a preemption or a timeout."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, job)


class Slurm:
    """One Slurm job for each job, by submitit.

    Args:
        folder: Of submitit's files, on a file system that all nodes see.
        workers: Jobs in the queue at once; None means 100.
        cpus: Of each job.
        gpus: Of each job.
        minutes: Time limit of each job; one that needs longer is put back in the queue.
        cluster: `slurm`, or submitit's `local` for a trial.
    """

    def __init__(
        self,
        folder: Path,
        workers: int | None,
        cpus: int = 1,
        gpus: float = 0,
        minutes: int = 240,
        cluster: str = "slurm",
    ) -> None:
        submitit = _package("submitit", "--engine=slurm needs submitit", "slurm")
        self.slots = workers or 100
        try:
            self._executor = submitit.AutoExecutor(folder / "%j", cluster=cluster)
        except RuntimeError as error:
            raise UserError(
                f"--engine is slurm, but submitit finds no Slurm here ({error}): run it on a login node"
            ) from None
        self._executor.update_parameters(
            timeout_min=minutes, cpus_per_task=cpus, gpus_per_node=int(gpus), name="dds-study"
        )
        self._refusal: type[Exception] = submitit.core.utils.FailedJobError
        self._threads, self.closed = ThreadPoolExecutor(self.slots), False
        self._jobs: list[Any] = []

    def submit(self, job: Job) -> Future[Answer]:
        """As `Engine.submit`."""
        try:
            submitted = self._executor.submit(Requeued(), dict(job))
        except self._refusal as error:
            raise UserError(f"--engine is slurm, and it refuses the job ({' '.join(str(error).split())})") from None
        self._jobs.append(submitted)
        return self._threads.submit(self._wait, submitted)

    def _wait(self, submitted: Any) -> Answer:
        while not (self.closed or submitted.done()):
            time.sleep(0.5)
        if self.closed:
            return {"seconds": 0.0, "error": "stopped"}
        answer: Answer = submitted.result()
        return answer

    def close(self) -> None:
        """As `Engine.close`: what is queued or running is cancelled."""
        self.closed = True
        for submitted in self._jobs:
            if not submitted.done():
                submitted.cancel()
        self._threads.shutdown(cancel_futures=True)


ENGINES: dict[str, Callable[..., Engine]] = {"local": Local, "ray": RayTasks, "slurm": Slurm}
"""Name -> engine; `run` gives each its arguments."""


def refuse_request(engine: str, workers: int | None, cpus: int, gpus: float, minutes: int) -> None:
    """Refuse what cannot be asked of an engine.

    Raises:
        UserError: Names the first.
    """
    whole = float(gpus).is_integer()
    rules = (
        ("engine", engine, engine in ENGINES, f"one of {', '.join(ENGINES)}"),
        ("workers", workers, workers is None or workers >= 1, "at least 1"),
        ("cpus", cpus, isinstance(cpus, int) and cpus >= 1, "a whole number of at least 1"),
        ("gpus", gpus, 0 <= gpus < float("inf"), "0 or more"),
        ("gpus", gpus, whole or (engine != "slurm" and gpus < 1), "a whole number, or with --engine ray less than 1"),
        ("minutes", minutes, minutes >= 1, "at least 1"),
    )
    for name, value, fine, expected in rules:
        if not fine:
            raise UserError(f"--{name} is {value}, expected {expected}")


def _package(name: str, what: str, extra: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise lacks_extra(what, extra) from None
