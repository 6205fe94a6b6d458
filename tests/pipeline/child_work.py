"""What the processes of `test_child` do; nothing is imported that takes long."""

import os
import time
from pathlib import Path


def double(number):
    """Return twice a number, and say so."""
    print("working", flush=True)
    return 2 * number


def refuse(error):
    """Raise an error."""
    raise error


def variable(name):
    """Return a variable of the process."""
    return os.environ.get(name)


def stop_here(signum):
    """Send a signal to this process."""
    os.kill(os.getpid(), signum)
    time.sleep(30)


def sleep(path):
    """Say that this process works, and go on for long."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)
