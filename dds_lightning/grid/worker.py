"""A worker process of the local engine: it reads jobs as lines of JSON and answers each with a line.

It has one thread (`engines` sets OMP_NUM_THREADS): the workers are the parallelism.

It is a plain `python -c` child, as those of `envs.pool`: it works from notebooks and scripts without a `__main__`
guard, and ends, saving what it trains, when its caller does, because its input ends.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading

from dds_lightning.console.interrupts import Interrupted, caught
from dds_lightning.grid.job import do_logged


def main() -> None:
    """Serve until the input ends or a signal asks to stop."""
    answers = os.fdopen(os.dup(1), "w")
    jobs: queue.Queue[str] = queue.Queue()
    with caught():
        threading.Thread(target=_read, args=(jobs,), daemon=True).start()
        try:
            while line := jobs.get():
                answers.write(json.dumps(do_logged(json.loads(line))) + "\n")
                answers.flush()
        except Interrupted:
            os._exit(143)


def _read(jobs: queue.Queue[str]) -> None:
    """Pass lines on; when there are no more, stop what is being done as SIGTERM would."""
    for line in sys.stdin:
        jobs.put(line)
    os.kill(os.getpid(), signal.SIGTERM)
