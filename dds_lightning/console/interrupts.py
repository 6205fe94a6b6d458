"""Ctrl-C and SIGTERM: stop where the work can be resumed, and report it in the exit status.

Outside a training the first signal raises `Interrupted` at once. Inside `deferred()` it only sets a mark,
which the checkpoint callback sees after the next optimiser step: it saves and raises there. A second signal
is never deferred, unless it comes with the first: a terminal signals a whole group, and a parent passes it on.
"""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
TOGETHER = 1.0
"""Seconds within which two signals are one request."""


class Interrupted(SystemExit):
    """The user or the scheduler asked to stop; the exit status is 128 + the signal, as shells expect.

    Args:
        signum: The signal.
        saved: Path of the checkpoint that was written before stopping, if any.
    """

    def __init__(self, signum: int, saved: str | None = None) -> None:
        super().__init__(128 + signum)
        self.signum = signum
        self.saved = saved


class _Mark:
    catching = False
    deferring = False
    signum: int | None = None
    since = 0.0


def pending() -> int | None:
    """The signal that waits for the next safe point, or None."""
    return _Mark.signum


def _on_signal(signum: int, frame: FrameType | None) -> None:
    if _Mark.deferring and _Mark.signum is None:
        _Mark.signum, _Mark.since = signum, time.monotonic()
        return
    if _Mark.deferring and time.monotonic() - _Mark.since < TOGETHER:
        return
    _Mark.signum = None
    raise Interrupted(signum)


@contextmanager
def caught() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into `Interrupted` inside the block; do nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signum: signal.signal(signum, _on_signal) for signum in SIGNALS}
    _Mark.catching = True
    try:
        yield
    finally:
        _Mark.catching = False
        for signum, handler in before.items():
            signal.signal(signum, handler)


def catch_in_a_process() -> None:
    """In a process that a training has started, which entered no block of `caught()`: defer signals until its end."""
    if not _Mark.catching and threading.current_thread() is threading.main_thread():
        _Mark.catching = _Mark.deferring = True


def take_back() -> None:
    """Inside `caught()`, handle the signals again after other code (a Trainer) has installed its own handlers."""
    if _Mark.catching and threading.current_thread() is threading.main_thread():
        for signum in SIGNALS:
            signal.signal(signum, _on_signal)


@contextmanager
def deferred() -> Iterator[None]:
    """Hold back the first signal so that `pending()` reports it; one that is still pending raises at the end."""
    _Mark.deferring, _Mark.signum = True, None
    try:
        yield
        if _Mark.signum is not None:
            raise Interrupted(_Mark.signum)
    finally:
        _Mark.deferring, _Mark.signum = False, None
