"""The command line `dds`. Nothing heavy is imported before the command is known.

A function of `commands` is a command: its signature is the command line and its docstring the help. `dds STAGE`, one
for each training stage, is Lightning's own command line (`training.stage_cli`). What a command returns is printed, as
text for a person or, with `--json`, as one JSON document with nothing beside it on standard output; progress and logs
go to standard error.
"""

import shlex
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

from dds_lightning._version import __version__
from dds_lightning.console.interrupts import Interrupted, caught
from dds_lightning.errors import UserError, is_out_of_memory, reason
from dds_lightning.saving.files import DISK_ERRORS
from dds_lightning.training.stages import STAGES

USAGE_ERROR = 2
GOES_ON = ("run", "relabel", "data collect", "data fetch")
"""Commands that find by themselves what an earlier call of theirs has done."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0, 2 for what the user can mend, 128 + signal when interrupted.

    Args:
        argv: The words after `dds`; None takes them from the process.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with caught(), warnings.catch_warnings():
            warnings.showwarning = _warn
            return _dispatch(words)
    except UserError as error:
        return _complain(str(error))
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        return _complain(f"out of memory ({reason(error)}): ask for less at once, for example with fewer --workers")
    except Interrupted as stop:
        print(f"dds: {_interrupted(words, stop)}", file=sys.stderr)
        return int(stop.code or 1)
    except BrokenPipeError:
        # The reader has left (`dds tasks | head`); Python would complain again while closing standard output.
        sys.stdout = None
        return 0
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        return _complain(f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror))


def _dispatch(words: list[str]) -> int:
    from jsonargparse import ArgumentError

    if words in (["--version"], ["-V"]):
        print(f"dds-lightning {__version__}")
        return 0
    try:
        if words and words[0] in STAGES:
            from dds_lightning.training.stage_cli import command

            as_json, work = "--json" in words, command(words[0], words[1:])
        else:
            as_json, work = _command(words)
    except ArgumentError as error:
        return _complain(f"{error.message} (see `{shlex.join(['dds', *_path(words)])} --help`)")
    except SystemExit as stop:  # --help and --print_config end so
        if isinstance(stop, Interrupted):
            raise
        return int(stop.code or 0)
    return _report(work, as_json)


def _path(words: list[str]) -> list[str]:
    """The words that name a command: as many of the first as there are."""
    from dds_lightning.cli.parser import command_table

    path: list[str] = []
    table: Any = command_table()
    for word in words:
        if not isinstance(table, Mapping) or word not in table:
            break
        path.append(word)
        table = table[word]
    return path


def _command(words: list[str]) -> tuple[bool, Callable[[], Any]]:
    """Parse the words of a command of ours."""
    from dds_lightning.cli.parser import build_parser, prepare

    parser, functions = build_parser()
    config = parser.parse_args(prepare(words or ["--help"]))
    name = config.pop("subcommand")
    settings = config.pop(name)
    while "subcommand" in settings:
        inner = settings.pop("subcommand")
        name, settings = f"{name} {inner}", settings.pop(inner)
    settings.pop("config", None)
    as_json = settings.pop("json", False)
    return as_json, lambda: functions[name](**settings.as_dict())


def _report(work: Callable[[], Any], as_json: bool) -> int:
    """Do the work with standard output turned away, then print what it returned."""
    from dds_lightning.console.reports import Report

    with redirect_stdout(sys.stderr):
        report = work()
    if isinstance(report, Report):
        report.print(as_json)
        return report.status
    return 0


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning as a sentence: where in the code it was raised says nothing to whoever types a command."""
    print(f"dds: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _complain(message: str) -> int:
    print(f"dds: error: {' '.join(message.split())}", file=sys.stderr)
    return USAGE_ERROR


def _interrupted(words: list[str], stop: Interrupted) -> str:
    """What was saved and which command goes on."""
    if " ".join(_path(words)) in GOES_ON:
        again = [word for word in words if not word.startswith("--fresh")]  # or it would begin anew
        return f"interrupted; the same command goes on where it stopped:\n  {shlex.join(['dds', *again])}"
    if stop.saved is None:
        same = shlex.join(["dds", *words])
        return f"interrupted before anything was saved; the same command begins again:\n  {same}"
    kept, skip = [], False
    starts = ("--ckpt_path", "--model.init_from")  # a training that goes on does not start from anything
    for word in words:
        if not skip and not word.startswith(starts):
            kept.append(word)
        skip = word in starts
    command = shlex.join(["dds", *kept, "--ckpt_path", stop.saved])
    return f"interrupted; the state is in {stop.saved}, and this goes on from it:\n  {command}"
