"""The options of `dds STAGE` as its sources say them, and its help, without importing torch."""

from __future__ import annotations

import argparse
import inspect
import typing
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

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
    "ckpt_path": Parameter(
        "ckpt_path", str | None, None, "Continue the training of this .ckpt, or load it to measure it."
    ),
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
        listed = SUBCOMMANDS if stage.commands is None else {"fit": SUBCOMMANDS["fit"], **stage.commands}
        for command, text in listed.items():
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
