"""Kill work at random moments, and do it again until it is finished.

The work runs in a forked child: everything is imported already, so a kill hits the work and not the imports.
"""

import contextlib
import itertools
import os
import random
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path


def launch(work: Callable[[], object], kill_after: float | None) -> bool:
    """Run `work` in a child, killed (SIGKILL) after some seconds if given; whether it finished by itself.

    Raises:
        AssertionError: it failed by itself; the message ends with what it printed.
    """
    with tempfile.TemporaryFile("w+") as said:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.setsid()  # its own children die with it
                with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                    status = 0 if work() in (None, 0) else 3
            except BaseException:
                traceback.print_exc(file=said)
            finally:
                said.flush()
                os._exit(status)
        deadline = None if kill_after is None else time.monotonic() + kill_after
        done = 0
        while not done:
            if deadline is not None and time.monotonic() >= deadline:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return False
            done, status = os.waitpid(child, os.WNOHANG)
            time.sleep(0.002)
        said.seek(0)
        assert status == 0, f"the work ended with status {os.waitstatus_to_exitcode(status)}:\n{said.read()[-3000:]}"
        return True


def kill_until_finished(
    work: Callable[[Path], object],
    look: Callable[[Path], object],
    check: Callable[[Path], object],
    folder: Path,
    *,
    seconds: float,
    kills: int,
    seed: int,
) -> str:
    """Launch `work` over and over, killed at random moments, until it has finished; again until there were enough.

    Args:
        work: given a folder, goes on there where an earlier launch stopped.
        look: at what a kill left behind in the folder; raises if that is bad.
        check: the finished folder; raises if it is not what it should be.
        folder: each life of the work gets a folder of its own in it.
        seconds: how long an unharmed launch takes.
        kills: how many launches to kill in all.
        seed: of the moments.

    Returns:
        What happened, in words.
    """
    rng, killed, launches = random.Random(seed), 0, 0
    for life in itertools.count():
        own = folder / str(life)
        finished = False
        while not finished:
            start = time.monotonic()
            launches += 1
            finished = launch(lambda own=own: work(own), rng.uniform(0.05, 0.9) * seconds if killed < kills else None)
            killed += not finished
            if finished:
                # A machine that is less busy now would finish every launch before its kill.
                seconds = min(seconds, 2 * (time.monotonic() - start))
            look(own)
        check(own)
        if killed >= kills:
            return f"{killed} kills, {launches} launches, {life + 1} finished"
    raise AssertionError("unreachable: counting does not end")
