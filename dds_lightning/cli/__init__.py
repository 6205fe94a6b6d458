"""The command line `dds`. Nothing heavy is imported before the command is known.

A function of `commands` is a command: its signature is the command line and its docstring the help. `dds STAGE`, one
for each training stage, is Lightning's command line (`training.stage_cli`). What a command returns is printed, as
text for people or, with `--json`, as a single JSON document on standard output; progress and logs go to standard error.
"""

import errno
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

from dds_lightning._version import __version__
from dds_lightning.console.interrupts import Interrupted, caught
from dds_lightning.errors import ToldAlreadyError, UserError, is_out_of_memory, printable, reason
from dds_lightning.saving.files import DISK_ERRORS, expand
from dds_lightning.training.stages import STAGES, STARTS

USAGE_ERROR = 2
GOES_ON = ("run", "relabel", "online compare", "study run", "data collect", "data fetch")
"""Commands that detect what an earlier, interrupted call has already done."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0, 2 for a user's error, 128 + signal when interrupted.

    Args:
            argv: The arguments after `dds`; None takes them from the process.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        with caught(), warnings.catch_warnings():
            warnings.showwarning = _warn
            return _dispatch([_at_home(argument) for argument in arguments])
    except ToldAlreadyError:
        return USAGE_ERROR
    except UserError as error:
        return _complain(str(error))
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        return _complain(f"out of memory ({reason(error)}): ask for less at once, for example with fewer --workers")
    except Interrupted as stop:
        print(f"dds: {printable(_interrupted(arguments, stop))}", file=sys.stderr)
        return int(stop.code or 1)
    except BrokenPipeError:
        # The reader has left (`dds tasks | head`); Python would complain again while closing standard output.
        sys.stdout = None
        return 0
    except OSError as error:
        if error.errno not in (*DISK_ERRORS, errno.ENOENT):
            raise
        return _complain(f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror))


def _dispatch(arguments: list[str]) -> int:
    from jsonargparse import ArgumentError

    if arguments in (["--version"], ["-V"]):
        print(f"dds-lightning {__version__}")
        return 0
    try:
        if arguments and arguments[0] in STAGES and arguments[1:2] != ["compare"]:
            from dds_lightning.training.options import help_of
            from dds_lightning.training.typos import refuse_typos

            if (text := help_of(arguments[0], arguments[1:])) is not None:
                print(text, end="")
                return 0
            refuse_typos(arguments[0], arguments[1:])
            from dds_lightning.training.stage_cli import command

            as_json, work = "--json" in arguments, command(arguments[0], arguments[1:])
        else:
            as_json, work = _command(arguments)
    except ArgumentError as error:
        return _complain(_mistyped(_path(arguments), error.message))
    except SystemExit as stop:  # how --help and --print_config end
        if isinstance(stop, Interrupted):
            raise
        return int(stop.code or 0)
    return _report(work, as_json)


def _at_home(argument: str) -> str:
    """Expand `~` where a shell leaves it: after `--out=`, and after `local:`."""
    found = re.fullmatch(r"((?:--[\w.]+\+?=)?(?:(?:local|d4rl|arrays|minari):)?)(~(?:/.*)?)", argument)
    return f"{found[1]}{expand(found[2])}" if found else argument


def _path(arguments: list[str]) -> list[str]:
    """Return the leading arguments that name a command."""
    from dds_lightning.cli.parser import command_table

    path: list[str] = []
    table: Any = command_table()
    for argument in arguments:
        if not isinstance(table, Mapping) or argument not in table:
            break
        path.append(argument)
        table = table[argument]
    return path


def _mistyped(path: list[str], message: str) -> str:
    """What the parser refused, with what may have been meant and where the help is."""
    from dds_lightning.cli.parser import options_of
    from dds_lightning.console.refusals import did_you_mean, sentence

    told = sentence(message)
    known = options_of(path)
    if (found := re.search(r"unrecognized arguments: (--[\w.-]+)", told)) is not None:
        told = f"{found[1]} is not an option of `{shlex.join(['dds', *path])}`"
        told += did_you_mean(found[1].partition(".")[0], [f"--{one}" for one in known])
    elif (found := re.search(r"invalid choice: '?([^' ]+)", told)) is not None:
        told += did_you_mean(found[1], known)
    return f"{told} (see `{shlex.join(['dds', *path])} --help`)"


def _command(arguments: list[str]) -> tuple[bool, Callable[[], Any]]:
    """Parse the arguments of one of the commands defined here."""
    from dds_lightning.cli.parser import build_parser, prepare, refuse_settings

    parser, functions = build_parser()
    config = parser.parse_args(prepare(arguments or ["--help"]))
    name = config.pop("subcommand")
    settings = config.pop(name)
    while "subcommand" in settings:
        inner = settings.pop("subcommand")
        name, settings = f"{name} {inner}", settings.pop(inner)
    settings.pop("config", None)
    refuse_settings(settings)
    as_json = settings.pop("json", False)
    return as_json, lambda: functions[name](**settings.as_dict())


def _report(work: Callable[[], Any], as_json: bool) -> int:
    """Do the work with standard output redirected to standard error, then print what it returned."""
    from dds_lightning.console.reports import Report

    with redirect_stdout(sys.stderr):
        report = work()
    if isinstance(report, Report):
        report.print(as_json)
        return report.status
    return 0


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as one sentence: where in the code it was raised means nothing to the user of a command."""
    print(f"dds: warning: {' '.join(printable(str(message)).split())}", file=sys.stderr)


def _complain(message: str) -> int:
    print(f"dds: error: {' '.join(printable(message).split())}", file=sys.stderr)
    return USAGE_ERROR


def _interrupted(arguments: list[str], stop: Interrupted) -> str:
    """Say what was saved and which command continues."""
    if " ".join(_path(arguments)) in GOES_ON:
        again = [
            argument for argument in arguments if not argument.startswith("--fresh")
        ]  # --fresh would start all over
        return f"interrupted; the same command continues where it stopped:\n  {shlex.join(['dds', *again])}"
    if stop.saved is None:
        same = shlex.join(["dds", *arguments])
        return f"interrupted before anything was saved; the same command begins again:\n  {same}"
    kept, skip = [], False
    starts = ("--ckpt_path", *(f"--model.{name}" for name in STARTS))  # a resumed training takes no initial weights
    for argument in arguments:
        if not skip and not argument.startswith(starts):
            kept.append(argument)
        skip = argument in starts
    command = shlex.join(["dds", *kept, "--ckpt_path", stop.saved])
    return f"interrupted; the state is in {stop.saved}, and this command continues from it:\n  {command}"
