"""A training in a process of its own, for strategies that start the command they are in once more on every device."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from dds_lightning.console import interrupts
from dds_lightning.console.reports import Report
from dds_lightning.errors import ToldAlreadyError
from dds_lightning.saving.untrusted import mapping, parse_json


def run_alone(arguments: Sequence[str]) -> Report:
    """Run `dds STAGE ...` in a process of its own, where its messages appear as they come.

    Args:
        arguments: What follows `dds`.

    Returns:
        Its report.

    Raises:
        ToldAlreadyError: It has refused something, and said what.
        Interrupted: It was asked to stop, by the signal that this process got, which is passed on.
        RuntimeError: It ended in another way.
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    process = subprocess.Popen(  # noqa: S603 - this Python and this program, no shell
        [sys.executable, "-m", "dds_lightning", *arguments, "--json"],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
        text=True,
    )
    while True:
        try:
            answer, _ = process.communicate()
            break
        except interrupts.Interrupted as stop:
            process.send_signal(stop.signum)
    if process.returncode == 0:
        made = mapping(parse_json(answer, "the answer of the training"), "the answer of the training")
        return Report({**made, **{name: Path(made[name]) for name in ("checkpoint", "best") if made[name]}})
    if process.returncode == 2:
        raise ToldAlreadyError(f"dds {arguments[0]} has said what was wrong")
    signum = process.returncode - 128 if process.returncode > 128 else -process.returncode
    if signum in interrupts.SIGNALS:
        raise interrupts.Interrupted(signal.Signals(signum))
    raise RuntimeError(f"dds {arguments[0]} ended with status {process.returncode}; its messages are above")
