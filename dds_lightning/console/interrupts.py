"""Ctrl-C and SIGTERM: stop at a place from which the work can go on, and say so with the exit status.

Outside a training the first signal raises `Interrupted` at once. Inside `deferred()` it only sets a mark,
which the checkpoint callback sees after the next optimiser step: it saves and raises there. A second signal
never waits.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(SystemExit):
    """The user or the scheduler asked to stop; the exit status is 128 + the signal, as shells expect.

    Args:
        signum: the signal.
        saved: the checkpoint that holds the state at the stop, if one was written.
    """

    def __init__(self, signum: int, saved: str | None = None) -> None:
        super().__init__(128 + signum)
        self.signum = signum
        self.saved = saved


class _Mark:
    catching = False
    deferring = False
    signum: int | None = None


def pending() -> int | None:
    """The signal that waits for the next safe place, or None."""
    return _Mark.signum


def _on_signal(signum: int, frame: FrameType | None) -> None:
    if _Mark.deferring and _Mark.signum is None:
        _Mark.signum = signum
        return
    _Mark.signum = None
    raise Interrupted(signum)


@contextmanager
def caught() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into `Interrupted` inside the block; does nothing off the main thread."""
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


def take_back() -> None:
    """Inside `caught()`, handle the signals again after somebody else (a Trainer) has put handlers of its own."""
    if _Mark.catching and threading.current_thread() is threading.main_thread():
        for signum in SIGNALS:
            signal.signal(signum, _on_signal)


@contextmanager
def deferred() -> Iterator[None]:
    """Let the first signal wait until `pending()` is asked; one that nobody asked about raises at the end."""
    _Mark.deferring, _Mark.signum = True, None
    try:
        yield
        if _Mark.signum is not None:
            raise Interrupted(_Mark.signum)
    finally:
        _Mark.deferring, _Mark.signum = False, None
