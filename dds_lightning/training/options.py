"""The options of `dds STAGE` as its sources say them: the help, and the answer to a typo, without importing torch.

`stage_cli` parses in earnest; what is refused here would be refused there, several seconds later.
"""

from __future__ import annotations

import argparse
import inspect
import typing
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

from jsonargparse import ArgumentError, ArgumentParser

from dds_lightning.configs import resolve_configs
from dds_lightning.console.arguments import takes_lists
from dds_lightning.console.refusals import did_you_mean, sentence
from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.training.source import Parameter, parameters_of, summary_of
from dds_lightning.training.stages import Stage, get_stage

TRAINER = "lightning.pytorch.trainer.trainer:Trainer"
CALLBACKS = {
    "checkpoint": "dds_lightning.callbacks.rolling:RollingCheckpoint",
    "best": "dds_lightning.callbacks.best:BestCheckpoint",
    "average": "dds_lightning.callbacks.average:AverageWeights",
    "stop": "dds_lightning.callbacks.convergence:Convergence",
}
"""Groups of options of every stage, and the callbacks that they set."""
SUBCOMMANDS = {
    "fit": "Train; from the start, or with --ckpt_path from where a training stopped.",
    "validate": "Measure a checkpoint on the held-out episodes.",
    "test": "The same, under the names of a test.",
    "predict": "Write what a checkpoint says about every row of the data to predictions.parquet.",
}
GENERAL = {
    "config": Parameter("config", inspect.Parameter.empty, None, "File of settings; a packaged one by its short name."),
    "seed_everything": Parameter("seed_everything", bool | int, 0, "Seed of everything random."),
    "ckpt_path": Parameter("ckpt_path", str | None, None, "Go on from this .ckpt, or look at it."),
    "precision": Parameter(
        "precision",
        Literal["auto"] | None,
        None,
        "auto: measure whether bfloat16 is faster here; --trainer.precision overrules it.",
    ),
    "threads": Parameter(
        "threads", int | None, None, "Threads of torch; without it, as many as a short measurement finds worth it."
    ),
    "print_config": Parameter("print_config", inspect.Parameter.empty, None, "Print all settings as YAML and end."),
    "json": Parameter("json", inspect.Parameter.empty, None, "Print one JSON document and nothing else."),
}
FLAGS = ("json", "print_config", "help", "h")
"""Options without a value of their own."""
METHODS = ("verbose", "return_predictions")
"""Arguments of Lightning's methods that `stage_cli` passes on; ours have no use for them."""


class Group(NamedTuple):
    """Options with the same beginning."""

    name: str
    summary: str
    parameters: dict[str, Parameter]


def groups(stage: Stage) -> list[Group]:
    """The options of a stage, ours before Lightning's."""
    sources = {"model": stage.module, "data": stage.data, **CALLBACKS, "trainer": TRAINER}
    found = [Group("", "general", GENERAL)]
    for name, address in sources.items():
        linked = stage.links if name == "model" else ()
        parameters = {key: one for key, one in parameters_of(address).items() if key not in linked}
        if name == "trainer":
            parameters["max_steps"] = parameters["max_steps"]._replace(default=stage.steps)
        found.append(Group(name, summary_of(address), parameters))
    return found


def options(stage: Stage) -> dict[str, Parameter]:
    """All options of a stage by their names, without the dashes."""
    return {f"{group.name}.{key}".lstrip("."): one for group in groups(stage) for key, one in group.parameters.items()}


# ---------------------------------------------------------------------- help


def help_of(name: str, arguments: Sequence[str]) -> str | None:
    """The help that the arguments after `dds STAGE` ask for; None where they ask for none, or for a class's."""
    if arguments and not {"-h", "--help"} & set(arguments):
        return None
    stage = get_stage(name)
    subcommand = arguments[0] if arguments and arguments[0] in SUBCOMMANDS else None
    parser = argparse.ArgumentParser(
        prog=f"dds {name} {subcommand or 'COMMAND'}",
        usage=f"dds {name} {subcommand or 'COMMAND'} [--config FILE] [--SETTING=VALUE ...]",
        description=SUBCOMMANDS[subcommand] if subcommand else stage.description,
        add_help=False,
        formatter_class=lambda prog: argparse.HelpFormatter(prog, max_help_position=34),
    )
    if subcommand is None:
        parser.epilog = f"`dds {name} fit --help` lists the settings, `dds {name} fit --help trainer` Lightning's."
        commands = parser.add_argument_group("commands")
        for command, text in SUBCOMMANDS.items():
            commands.add_argument(command, help=text)
        return parser.format_help()
    trainers = arguments[-1] == "trainer"
    for group in groups(stage):
        if (group.name == "trainer") == trainers:
            described = parser.add_argument_group(group.name or "general", group.summary if group.name else None)
            for key, one in group.parameters.items():
                described.add_argument(f"--{group.name}.{key}".replace("--.", "--"), **_described(key, one))
    if not trainers:
        parser.epilog = (
            "Lightning's Trainer has its own settings, such as --trainer.max_steps, --trainer.accelerator, "
            f"--trainer.logger and --trainer.callbacks: `dds {name} {subcommand} --help trainer` lists them."
        )
    return parser.format_help()


def _described(key: str, one: Parameter) -> dict[str, Any]:
    text = " ".join(one.text.replace("%", "%%").split())
    default = "" if one.default in (inspect.Parameter.empty, None) else f" (default: {_plain(one.default)})"
    if key in FLAGS:
        return {"action": "store_true", "help": text}
    choices = typing.get_args(one.annotation) if typing.get_origin(one.annotation) is typing.Literal else ()
    return {"metavar": "|".join(map(str, choices)) or key.upper(), "help": text + default}


def _plain(value: Any) -> Any:
    """As a person types it."""
    return str(value).lower() if isinstance(value, bool) else list(value) if isinstance(value, tuple) else value


# ---------------------------------------------------------------------- typos


def refuse_typos(name: str, arguments: Sequence[str], prefix: str = "") -> None:
    """Refuse options that the stage does not have, and values that do not fit their types.

    Args:
        name: Of the stage.
        arguments: What follows `dds STAGE`.
        prefix: What another command writes before these options.

    Raises:
        UserError: Names the first, what was expected, and where the help is.
    """
    stage = get_stage(name)
    subcommand = next((one for one in arguments if not one.startswith("-")), "")
    if subcommand not in SUBCOMMANDS:
        near = did_you_mean(subcommand, SUBCOMMANDS)
        raise UserError(f"dds {name} {subcommand}: there is no such command, expected {', '.join(SUBCOMMANDS)}{near}")
    known = options(stage)
    unread = tuple(group.name for group in groups(stage) if not group.parameters)
    for option, value in _given(resolve_configs(arguments)):
        found = _known(option.rstrip("+"), known)
        help_ = "--help trainer" if option.startswith("trainer.") else "--help"
        where = f"(see `dds {name} {subcommand} {help_}`)"
        if found is None and option.partition(".")[0] not in unread:
            near = did_you_mean(f"--{prefix}{option}", [f"--{prefix}{one}" for one in known])
            raise UserError(f"--{prefix}{option} is not an option of `dds {name} {subcommand}`{near} {where}")
        if value is not None and found == option and found in known:
            _refuse_value(found, value, known[found], where)


def _given(arguments: Sequence[str]) -> Iterator[tuple[str, str | None]]:
    """Options and their values, on the command line and in files; a value of None is not looked at."""
    words = iter(arguments)
    for word in words:
        if word in ("-c", "--config"):
            yield from _of_file(next(words, ""))
        elif word.startswith("--config="):
            yield from _of_file(word.partition("=")[2])
        elif word.startswith("--"):
            option, equals, value = word[2:].partition("=")
            if not equals and option.partition(".")[0] not in FLAGS and not option.endswith(".help"):
                value = next(words, "")
                if value.startswith("--"):  # no value at all: the parser says what is missing
                    words = iter([value, *words])
                    value = ""
            yield option, value or None


def _of_file(path: str) -> Iterator[tuple[str, None]]:
    try:
        settings = read_yaml(path)
    except UserError:
        return  # the parser says what is wrong with it
    for group, inner in settings.items() if isinstance(settings, dict) else ():
        if isinstance(inner, dict):
            yield from ((f"{group}.{key}", None) for key in inner)
        else:
            yield str(group), None


def _known(option: str, known: dict[str, Parameter]) -> str | None:
    """The option that is meant: itself, a beginning of one, a group, or a setting inside one; None if there is none."""
    if option in known:
        return option
    if option.partition(".")[0] in (*FLAGS, *METHODS) or option.endswith(".help"):
        return option
    inside = next((name for name in known if option.startswith(f"{name}.")), None)
    return inside or next((name for name in known if name.startswith(option)), None)


def _refuse_value(option: str, value: str, one: Parameter, where: str) -> None:
    if one.annotation is inspect.Parameter.empty:
        return
    if takes_lists(one.annotation) and not value.lstrip().startswith("["):
        value = f"[{value}]"
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument(f"--{option}", type=one.annotation)
    try:
        parser.parse_args([f"--{option}={value}"])
    except ArgumentError as error:
        raise UserError(f"{sentence(error.message)} {where}") from None
