"""`python -m dds_lightning` is `dds`."""

import atexit
import os
import sys
from typing import NoReturn

from dds_lightning.cli import main


def run() -> NoReturn:
    """Run `dds` as the program of this process."""
    leave(main())


def leave(status: int) -> NoReturn:
    """End this process; one of several that trained together ends without taking Python down.

    Threads of Gloo release the tensors of the last exchange when they get to it. Where Python is being taken down by
    then, they abort the process: a training that is finished and saved would end with status -6.
    """
    distributed = sys.modules.get("torch.distributed")
    if distributed is None or not distributed.is_available() or not distributed.is_initialized():
        sys.exit(status)
    atexit._run_exitfuncs()  # loggers send what they still hold
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
