"""From functions to a command line."""

import inspect
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import docstring_parser
from jsonargparse import ArgumentParser

from dds_lightning.cli import atlas, checkpoints, commands, data, online, record, study
from dds_lightning.cli.completion import script
from dds_lightning.console.arguments import as_lists, list_options
from dds_lightning.console.reports import Report
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.training.stages import STAGES, run_stages

Commands = Mapping[str, Any]  # name -> function, a group of commands, or None for one of Lightning's

GROUPS = {
    "data": "List, show, check, fetch and collect data sets.",
    "checkpoints": "List and verify published agents.",
    "online": STAGES["online"].description,
    "study": "Run a grid over tasks, methods, settings and seeds, and report it with intervals.",
}
OPTIONAL_POSITIONALS: dict[Callable[..., Any], tuple[str, str]] = {
    commands.tasks: ("name", "?"),
    commands.evaluate: ("directory", "?"),
    checkpoints.list_: ("directory", "*"),
    data.list_: ("directory", "*"),
}
"""Functions with a parameter that has a default but is still a positional argument, and how often it may be given."""
TAKES_STAGES = (commands.run,)
"""Functions that take the arguments of each training stage as a keyword of its name."""


def command_table() -> Commands:
    """The commands by their names, in the order in which the help lists them."""
    return {
        "run": commands.run,
        **dict.fromkeys(STAGES),
        "online": {"compare": online.compare},  # beside the stage's own `fit`
        "relabel": commands.relabel,
        "evaluate": commands.evaluate,
        "report": commands.report,
        "study": {"run": study.run, "report": study.report},
        "atlas": atlas.atlas,
        "record": record.record,
        "data": {
            "list": data.list_,
            "show": data.show,
            "check": commands.data_check,
            "fetch": data.fetch,
            "collect": data.collect,
        },
        "tasks": commands.tasks,
        "publish": checkpoints.publish,
        "checkpoints": {"list": checkpoints.list_, "verify": checkpoints.verify},
        "export": checkpoints.export,
        "completion": completion,
    }


def build_parser() -> tuple[ArgumentParser, dict[str, Callable[..., Any]]]:
    """Build the parser, and the functions by the command that calls them ("data check")."""
    parser = ArgumentParser(
        prog="dds",
        description="Discrete diffusion skills for offline reinforcement learning.",
        epilog="`dds COMMAND --help` explains one command; `dds --version` prints the version.",
        exit_on_error=False,
    )
    functions: dict[str, Callable[..., Any]] = {}
    _add(parser, command_table(), functions)
    return parser, functions


def _add(parser: ArgumentParser, table: Commands, functions: dict[str, Callable[..., Any]], prefix: str = "") -> None:
    subcommands = parser.add_subcommands(required=True, metavar="COMMAND")
    for name, entry in table.items():
        if entry is None:
            subcommands.add_subcommand(name, ArgumentParser(exit_on_error=False), help=STAGES[name].description)
        elif isinstance(entry, Mapping):
            group = ArgumentParser(description=GROUPS[name], exit_on_error=False)
            subcommands.add_subcommand(name, group, help=GROUPS[name])  # before its commands, for jsonargparse
            _add(group, entry, functions, prefix=f"{name} ")
        else:
            documentation = inspect.getdoc(entry) or ""
            first = documentation.split("\n", 1)[0]
            about = documentation.split("\nArgs:", 1)[0].strip()
            leaf = ArgumentParser(description=about, exit_on_error=False)
            leaf.add_argument("--json", action="store_true", help="print one JSON document and nothing else")
            optional = OPTIONAL_POSITIONALS.get(entry)
            if optional:
                leaf.add_argument(optional[0], nargs=optional[1], help=_help(documentation, optional[0]))
            leaf.add_function_arguments(
                entry, as_group=False, as_positional=True, skip={optional[0]} if optional else None
            )
            for stage in run_stages() if entry in TAKES_STAGES else ():
                leaf.add_argument(f"--{stage}", type=list[str], default=[], help=f"Settings for `dds {stage} fit`")
            subcommands.add_subcommand(name, leaf, help=first)
            functions[prefix + name] = entry


def _functions(table: Commands) -> Iterator[Callable[..., Any]]:
    for entry in table.values():
        if isinstance(entry, Mapping):
            yield from _functions(entry)
        elif entry is not None:
            yield entry


def _help(documentation: str, parameter: str) -> str:
    described = {each.arg_name: each.description for each in docstring_parser.parse(documentation).params}
    return described.get(parameter) or ""


def prepare(arguments: list[str]) -> list[str]:
    """Expand the shorthands that jsonargparse does not know; one value of a list is a list of one.

    A bare `--fresh` means `--fresh=true`, and takes true or false as its value if that follows. For `dds run` an
    option like `--skill.trainer.max_steps=100` (or the same as two arguments) is collected for that stage's `fit`.

    Raises:
        UserError: Such an option has no value.
    """
    flags = {
        f"--{name}"
        for function in _functions(command_table())
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is False
    }
    entry: Any = command_table()
    for argument in arguments:
        entry = entry.get(argument) if isinstance(entry, Mapping) else entry
    if callable(entry):
        arguments = as_lists(arguments, list_options(entry))
    out: list[str] = []
    rest, before = iter(arguments), ""
    for argument in rest:
        stage, _, option = argument.removeprefix("--").partition(".")
        if arguments[0] == "run" and argument.startswith("--") and stage in run_stages() and option:
            if "=" not in option:
                value = next(rest, None)
                if value is None:
                    raise UserError(f"{argument} has no value: write {argument}=VALUE")
                option = f"{option}={value}"
            out.append(f"--{stage}+=--{option}")
        elif arguments[0] == "run" and argument.startswith("--"):
            _refuse_of_a_stage(argument.partition("=")[0])
            out.append(f"{argument}=true" if argument in flags else argument)
        elif before in flags and argument in ("true", "false"):
            out[-1] = f"{before}={argument}"
        else:
            out.append(f"{argument}=true" if argument in flags else argument)
        before = argument
    return out


def _refuse_of_a_stage(option: str) -> None:
    """Refuse for `dds run` an option of `dds STAGE fit` that does not say of which stage.

    Raises:
        UserError: Says what to write.
    """
    from dds_lightning.training.options import groups

    group, _, inner = option.removeprefix("--").partition(".")
    if option in ("--data.data", "--data.task", "--config"):
        known = {"data": "--data DATA", "task": "the task as the first word, dds run TASK", "": "--preset NAME"}
        raise UserError(f"{option} is an option of one training, such as `dds skill fit`: here give {known[inner]}")
    if inner and group in {one.name for stage in run_stages() for one in groups(STAGES[stage])}:
        ways = " or ".join(f"--{stage}.{group}.{inner}" for stage in run_stages())
        raise UserError(f"{option} does not say which training it is for: write {ways}")


def options_of(path: Sequence[str]) -> list[str]:
    """What may follow the words of a command: further words, or the options of the function that it is."""
    entry: Any = command_table()
    for word in path:
        entry = entry[word]
    if isinstance(entry, Mapping):
        return list(entry)
    stages = run_stages() if entry in TAKES_STAGES else []
    return ["json", *(inspect.signature(entry).parameters if entry else ()), *stages]


def refuse_settings(settings: Mapping[str, Any]) -> None:
    """Refuse settings whose mistakes show without doing anything: seeds, and the arguments of training stages.

    Raises:
        UserError: Names the first.
    """
    if settings.get("seed") is not None:
        refuse_seed("--seed", settings["seed"])
    for stage in run_stages():
        if settings.get(stage):
            from dds_lightning.training.typos import refuse_typos

            refuse_typos(stage, ["fit", *settings[stage]], prefix=f"{stage}.")


def completion(shell: Literal["bash", "zsh"]) -> Report:
    """Print what lets a shell complete commands and options: add `eval "$(dds completion bash)"` to ~/.bashrc.

    Args:
        shell: The shell; for zsh the line goes into ~/.zshrc.
    """
    text = script({" ".join(path): known for path, known in _words()}, zsh=shell == "zsh")
    return Report({"shell": shell, "script": text}, [text])


def _words() -> Iterator[tuple[tuple[str, ...], list[str]]]:
    """The words of every command, and what may follow them."""
    from dds_lightning.training.options import SUBCOMMANDS, options

    table = command_table()
    yield (), [*table, "--help", "--version"]
    for name, entry in table.items():
        if isinstance(entry, Mapping):
            yield (name,), [*entry, "--help"]
            for inner in entry:
                yield (name, inner), _flags(entry[inner], options_of([name, inner]))
        elif entry is None:
            yield (name,), [*SUBCOMMANDS, "--help"]
            for subcommand in SUBCOMMANDS:
                yield (name, subcommand), [*(f"--{one}=" for one in options(STAGES[name])), "--help"]
        else:
            stages = (
                [f"--{stage}.{one}=" for stage in run_stages() for one in options(STAGES[stage])]
                if name == "run"
                else []
            )
            yield (name,), [*_flags(entry, options_of([name])), *stages]


def _flags(function: Any, names: list[str]) -> list[str]:
    """Options of a command, with the values of those that take one of a few."""
    hints = typing.get_type_hints(function)
    choices = {name: typing.get_args(hint) for name, hint in hints.items() if typing.get_origin(hint) is Literal}
    listed = [f"--{name}={value}" for name in names for value in choices.get(name, ())]
    return [*(f"--{name}" for name in names if name not in choices), *listed, "--help"]
