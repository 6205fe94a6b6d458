"""Many environments of one task, stepped by worker processes, while the caller only chooses actions.

```
 caller    actions (n, A) ─┬─ pipe ─► worker 0: envs 0, 2, 4, ..  step, and reset to the slot's next seed ─┐
                           └─ pipe ─► worker 1: envs 1, 3, 5, ..                                          ─┤
           one record per live slot ◄────────────────────────────────────────────────────────────────── pipe ┘
```

Each slot plays a fixed list of seeds in order, so short episodes are never over-counted; a slot whose list is
finished is no longer stepped. Workers are plain `python -c` children: they work from notebooks, from scripts without a
`__main__` guard and under pytest, do not import torch, and end when their caller does, because their input ends.
gymnasium's and stable-baselines3's vector environments offer none of this: they choose the seeds of later episodes
themselves, step every slot until the end, and their processes need a `__main__` guard. They do suit endless data, as in
online training.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from dds_lightning.envs.worker import Slots, pack_step, read_frame, record_dtype, write_frame
from dds_lightning.errors import UserError

if TYPE_CHECKING:
    from dds_lightning.tasks import Task

_START_WORKER = "from dds_lightning.envs.worker import worker_main; worker_main()"


class EnvPoolError(RuntimeError):
    """An environment or its worker process failed; the message holds the worker's traceback."""


class _Local:
    """Slots in the caller's process: nothing to start, easy to debug."""

    def __init__(self, task: Task, count: int) -> None:
        self.slots = Slots(task, count)
        self.answer: NDArray[Any] = np.zeros(0)

    def send_start(self, seeds: list[list[int]]) -> None:
        self.answer = self.slots.start(seeds)

    def send_step(self, slots: NDArray[np.int64], actions: NDArray[np.float32]) -> None:
        self.answer = self.slots.step(slots, actions)

    def receive(self) -> NDArray[Any]:
        return self.answer

    def close(self) -> None:
        self.slots.close()


class _Remote:
    """Slots in a worker process, which communicates through its standard input and output."""

    def __init__(self, task: Task, count: int, name: str) -> None:
        self.name = name
        self.dtype = record_dtype(task)
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        # One thread each: the workers themselves are the parallelism.
        environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(  # noqa: S603 - this Python and a constant program, no shell
            [sys.executable, "-P", "-c", _START_WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            process_group=0,  # a signal to the caller's group must not end it while it starts and ignores none yet
        )
        self._end = weakref.finalize(self, _end_process, self.process)
        self._send(b"I", pickle.dumps((task, count)))

    def send_start(self, seeds: list[list[int]]) -> None:
        self._send(b"R", pickle.dumps(seeds))

    def send_step(self, slots: NDArray[np.int64], actions: NDArray[np.float32]) -> None:
        self._send(b"S", pack_step(slots, actions))

    def receive(self) -> NDArray[Any]:
        kind, payload = self._read()
        if kind == b"E":
            raise EnvPoolError(f"{self.name} failed:\n{payload.decode()}")
        if kind == b"U":
            raise UserError(payload.decode())
        return np.frombuffer(payload, self.dtype)

    def close(self) -> None:
        self._end()

    def _send(self, kind: bytes, payload: bytes) -> None:
        assert self.process.stdin is not None
        try:
            write_frame(self.process.stdin, kind, payload)
        except (OSError, ValueError) as error:
            raise self._died() from error

    def _read(self) -> tuple[bytes, bytes]:
        assert self.process.stdout is not None
        frame = read_frame(self.process.stdout)
        if frame is None:
            raise self._died()
        return frame

    def _died(self) -> EnvPoolError | UserError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=5)
        code = self.process.poll()
        if code == -signal.SIGKILL:
            return UserError(f"{self.name} was killed, most likely for want of memory: ask for fewer with --workers")
        return EnvPoolError(f"{self.name} ended unexpectedly with exit status {code}")


class EnvPool:
    """Environments of one task, split over worker processes; use it as a context manager or call `close`.

    Workers take about a second to start, so keep the pool where rollouts repeat. Results do not depend on the
    number of workers.

    Args:
        task: The task to build; must be picklable if there are workers.
        num_envs: Number of slots E.
        workers: Number of processes; None starts one per core, 0 steps in the calling process.

    Raises:
        UserError: `num_envs` or `workers` is out of range.
        EnvPoolError: An environment could not be built.
    """

    def __init__(self, task: Task, num_envs: int, workers: int | None = None) -> None:
        """Start the workers and build the environments."""
        if num_envs < 1:
            raise UserError(f"slots is {num_envs}, expected at least 1 environment")
        # A worker for fewer than four environments would mostly wait for its messages.
        workers = min(available_cores(), -(-num_envs // 4)) if workers is None else workers
        if workers < 0:
            raise UserError(f"workers is {workers}, expected 0 (no processes) or more")
        workers = min(workers, num_envs)
        self.task, self.num_envs, self.workers = task, num_envs, workers
        # Neighbouring slots play similar contestants, so deal them out: part p has slots p, p + parts, ...
        parts = max(workers, 1)
        self._slots = [np.arange(part, num_envs, parts) for part in range(parts)]
        self._parts: list[_Local | _Remote] = []
        self._alive = np.zeros(num_envs, dtype=bool)
        self._broken = True
        try:
            for part in range(parts):
                name = f"environment worker {part} of {workers} ({task.name})"
                count = len(self._slots[part])
                self._parts.append(_Remote(task, count, name) if workers else _Local(task, count))
            for started in self._parts:
                if isinstance(started, _Remote):
                    started.receive()
        except BaseException:
            self.close()
            raise
        self._broken = False

    @property
    def alive(self) -> NDArray[np.intp]:
        """Slots with an observation to act on, ascending."""
        return np.flatnonzero(self._alive)

    def start(self, seeds: Sequence[Sequence[int]]) -> NDArray[Any]:
        """Start the first episode of every slot; a rollout in progress is abandoned.

        Args:
            seeds: For each slot the seeds of its episodes; an empty or missing list leaves it idle.

        Returns:
            (E,) records, see `record_dtype`; only `observation`, `position` and `alive` are filled.
        """
        if len(seeds) > self.num_envs:
            raise UserError(f"seeds has {len(seeds)} lists, expected at most {self.num_envs}, one per environment")
        plan = [list(map(int, each)) for each in seeds] + [[] for _ in range(self.num_envs - len(seeds))]
        records = np.zeros(self.num_envs, record_dtype(self.task))
        with self._exchange():
            for part, own in zip(self._parts, self._slots, strict=True):
                part.send_start([plan[slot] for slot in own])
            for part, own in zip(self._parts, self._slots, strict=True):
                records[own] = part.receive()
        self._alive = records["alive"].copy()
        return records

    def step(self, actions: NDArray[np.float32]) -> NDArray[Any]:
        """Step every live slot once.

        Args:
            actions: (n, A), a row for each slot of `alive`, in that order.

        Returns:
            (n,) records of the same slots, see `record_dtype`.
        """
        slots = self.alive
        actions = np.ascontiguousarray(actions, dtype=np.float32)
        if actions.shape != (len(slots), self.task.action_dim):
            raise ValueError(f"actions are {actions.shape}, expected {(len(slots), self.task.action_dim)}")
        records = np.zeros(len(slots), record_dtype(self.task))
        owner = slots % len(self._slots)
        rows = [np.flatnonzero(owner == number) for number in range(len(self._slots))]
        with self._exchange():
            busy = [(part, own) for part, own in zip(self._parts, rows, strict=True) if len(own)]
            for part, own in busy:
                part.send_step(slots[own] // len(self._slots), actions[own])
            for part, own in busy:
                records[own] = part.receive()
        self._alive[slots] = records["alive"]
        return records

    @contextlib.contextmanager
    def _exchange(self) -> Any:
        """Close the pool if an exchange is interrupted: its answers would be taken for the next one's."""
        if self._broken:
            raise EnvPoolError("the environment pool is closed: create a new one")
        try:
            yield
        except BaseException:
            self.close()
            raise

    @property
    def closed(self) -> bool:
        """Whether the pool can no longer be used."""
        return self._broken

    def close(self) -> None:
        """End the workers and close the environments; harmless when repeated."""
        self._broken = True
        self._alive[:] = False
        parts, self._parts = self._parts, []
        for part in parts:
            if isinstance(part, _Remote) and part.process.stdin is not None:
                with contextlib.suppress(OSError):
                    part.process.stdin.close()  # all at once, so that they end together
        for part in parts:
            part.close()

    def __enter__(self) -> Self:
        """The pool itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the pool."""
        self.close()


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _end_process(process: subprocess.Popen[bytes]) -> None:
    """End a worker: by the end of its input, and if that does not help in time, by force."""
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()
    try:
        process.wait(timeout=3)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
