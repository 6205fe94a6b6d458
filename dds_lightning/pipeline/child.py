"""Work in a process of its own, with one thread: its messages appear line by line under its name.

The process does one function and sends back what it returned or raised. It takes part in two agreements:

- It ends with its caller, however that one ends: nothing goes on writing into a run that nobody watches any more.
- Where several share the cores it waits for its turn (`await_turn`) before each piece of work.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self, TypeVar

from dds_lightning.console.interrupts import SIGNALS, Interrupted, caught
from dds_lightning.console.terminal import Terminal
from dds_lightning.errors import ToldAlreadyError, UserError, printable

T = TypeVar("T")
_START = "from dds_lightning.pipeline.child import main; main()"
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


class Child:
    """A process that does one function.

    Args:
        name: Stands before each of its messages.
        function: What it does, "package.file:name".
        *arguments: Of the function; must be picklable.
    """

    def __init__(self, name: str, function: str, *arguments: Any) -> None:
        self.name = name
        self.connection, theirs = Pipe()
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        self.process = subprocess.Popen(  # noqa: S603 - this Python and a constant program, no shell
            [sys.executable, "-P", "-c", _START, str(theirs.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=[theirs.fileno()],
            env={**os.environ, **_ONE_THREAD, "PYTHONPATH": path},
            process_group=0,  # a signal from the terminal reaches it through its caller, once
            text=True,
            errors="replace",
        )
        theirs.close()
        self._relay = threading.Thread(target=self._pass_on, daemon=True)
        self._relay.start()
        self.connection.send((function, arguments))

    def result(self, turn: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext) -> Any:
        """Wait for what the function returns.

        Args:
            turn: Entered while the process works, from each of its calls of `await_turn` to the next.

        Raises:
            UserError: What it refused, or that it was killed.
            Interrupted: It was asked to stop.
            RuntimeError: It failed otherwise; its messages say how.
        """
        held = contextlib.ExitStack()
        try:
            while True:
                kind, value = self.connection.recv()
                if kind != "turn":
                    break
                held.close()
                held.enter_context(turn())
                with contextlib.suppress(OSError):  # it has ended meanwhile, and what it said comes next
                    self.connection.send("go")
        except (EOFError, OSError):
            kind, value = "ended", None
        finally:
            held.close()
        status = self.process.wait()
        self._relay.join()
        self.connection.close()
        if kind == "returned":
            return value
        if kind == "interrupted":
            raise Interrupted(*value)
        if kind == "refused":
            raise value
        if -status in SIGNALS:  # before it could catch them
            raise Interrupted(-status)
        if status == -signal.SIGKILL:
            raise UserError(f"{self.name} was killed, most likely for want of memory: give --jobs=1")
        raise RuntimeError(f"{self.name} ended with status {status}; its messages are above")

    def signal(self, signum: int) -> None:
        """Ask it to stop where the work can be resumed."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signum)

    def _pass_on(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            tell(f"{self.name} | {line.rstrip()}")


class Children:
    """Processes that work at the same time, each waited for by a thread of this one; use it as a context manager.

    Its end waits for all of them. Where Ctrl-C or SIGTERM brought it, they are asked to stop first.

    Args:
        count: How many work at the same time.
    """

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count)
        self._running: list[Child] = []
        self._signum: int | None = None

    def submit(self, work: Callable[..., T], *arguments: Any) -> Future[T]:
        """Begin some work in a thread, which calls `run` for what takes long."""
        return self._pool.submit(work, *arguments)

    def run(self, name: str, function: str, *arguments: Any, **how: Any) -> Any:
        """Start a process and wait for its result; arguments as of `Child`, `**how` as of `Child.result`."""
        child = Child(name, function, *arguments)
        self._running.append(child)
        if self._signum is not None:
            child.signal(self._signum)
        return child.result(**how)

    def __enter__(self) -> Self:
        """Nothing runs yet."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Begin nothing more, and wait."""
        if isinstance(error, Interrupted):
            self._stop(error.signum)
        try:
            self._pool.shutdown(cancel_futures=True)
        except Interrupted as stop:
            self._stop(stop.signum)
            self._pool.shutdown()
            raise

    def _stop(self, signum: int) -> None:
        self._signum = signum
        for child in self._running:
            child.signal(signum)


def tell(line: str) -> None:
    """Print a line to standard error as a whole, from any thread; above a progress bar if there is one."""
    sys.stderr.write(f"{printable(line)}\n")
    sys.stderr.flush()


class Lines(Terminal):
    """A console on which every print is a line of `tell`: for threads, which share the terminal with a bar."""

    def print(self, *objects: Any, **_: Any) -> None:
        """Print in one piece, without style."""
        tell(" ".join(map(str, objects)))


# ---------------------------------------------------------------------- in the process


class _Turns:
    """What the caller has allowed so far; None outside of a child."""

    connection: Connection | None = None
    granted = threading.Semaphore(0)


def _listen(connection: Connection) -> None:
    """Take the caller's permissions, and end at once when it has ended."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.recv()
            _Turns.granted.release()
    os.kill(os.getpid(), signal.SIGKILL)


def await_turn() -> None:
    """Wait until the caller gives a core; at once in a process that nobody has started for this."""
    if _Turns.connection is not None:
        _Turns.connection.send(("turn", None))
        _Turns.granted.acquire()


def main() -> None:
    """Do what the caller asks for."""
    connection = Connection(int(sys.argv[1]))
    function, arguments = connection.recv()
    _Turns.connection = connection
    threading.Thread(target=_listen, args=(connection,), daemon=True).start()
    warnings.showwarning = lambda message, *_, **__: tell(f"warning: {' '.join(str(message).split())}")
    module, _, name = function.partition(":")
    try:
        with caught():
            answer: tuple[str, Any] = ("returned", getattr(import_module(module), name)(*arguments))
    except Interrupted as stop:
        answer = ("interrupted", (stop.signum, stop.saved))
    except UserError as error:
        kind = ToldAlreadyError if isinstance(error, ToldAlreadyError) else UserError
        answer = ("refused", kind(str(error)))
    except BaseException:
        traceback.print_exc()
        answer = ("failed", None)
    connection.send(answer)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # at once: the caller has the answer, and threads of libraries may linger
