"""The answer to a typo in the settings of a stage, at once: torch and Lightning take seconds to import.

`stage_cli` parses in earnest; what is refused here would be refused there too, later. What only the libraries can judge
passes, unless it is a word close to one that they know.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jsonargparse import ArgumentError, ArgumentParser

from dds_lightning.configs import resolve_configs
from dds_lightning.console.arguments import takes_lists
from dds_lightning.console.refusals import did_you_mean, sentence
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.saving.places import refuse_no_checkpoint
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.tasks import known_task
from dds_lightning.tasks.own import is_address
from dds_lightning.training.monitors import ALWAYS, OURS, refuse_metric
from dds_lightning.training.options import FLAGS, METHODS, SUBCOMMANDS, groups, options
from dds_lightning.training.rules import refuse_values
from dds_lightning.training.source import Parameter, classes_in, parameters_of
from dds_lightning.training.stages import Stage, get_stage

STRATEGIES = (
    "auto",
    *(
        f"{kind}{end}"
        for kind in ("ddp", "ddp_spawn", "ddp_fork", "ddp_notebook")
        for end in ("", "_find_unused_parameters_false", "_find_unused_parameters_true")
    ),
    *(f"deepspeed{end}" for end in ("", "_stage_1", "_stage_2", "_stage_2_offload", "_stage_3")),
    *("deepspeed_stage_3_offload", "deepspeed_stage_3_offload_nvme", "fsdp", "fsdp_cpu_offload"),
    *("single_device", "single_xla", "single_tpu", "xla", "xla_debug"),
)
WORDS = {
    "trainer.strategy": STRATEGIES,
    "trainer.accelerator": ("auto", "cpu", "cuda", "gpu", "mps", "tpu"),
    "trainer.profiler": ("simple", "advanced", "pytorch", "xla"),
}
"""What Lightning's registries hold."""
ROOMS = {
    "trainer.strategy": ("lightning.pytorch.strategies",),
    "trainer.profiler": ("lightning.pytorch.profilers",),
    "trainer.logger": ("lightning.pytorch.loggers",),
    "trainer.callbacks": ("lightning.pytorch.callbacks", "dds_lightning.callbacks"),
}
"""Where the classes are that a setting may name."""


MISSING = "\0"
"""Stands where an option ends the line, or another one follows."""


CHOICES = {"mode": ("min", "max")}
"""Arguments of Lightning's callbacks that take one of a few words, though their type does not say so."""


class _Given(NamedTuple):
    """A setting as it was given, on the command line or in a file; a value of None is not looked at."""

    name: str
    value: str | None
    in_file: bool = False


def refuse_typos(name: str, arguments: Sequence[str], prefix: str = "") -> None:
    """Refuse options that the stage does not have, and values that it cannot have.

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
    given = list(_given(resolve_configs(arguments)))
    values: dict[str, Any] = {}
    for option, value, _ in given:
        found = _known(option.rstrip("+"), known)
        help_ = "--help trainer" if option.startswith("trainer.") else "--help"
        where = f"(see `dds {name} {subcommand} {help_}`)"
        if found is None and option.partition(".")[0] not in unread:
            near = did_you_mean(f"--{prefix}{option}", [f"--{prefix}{one}" for one in known])
            raise UserError(f"--{prefix}{option} is not an option of `dds {name} {subcommand}`{near} {where}")
        if option == "data" and value and value != MISSING and not Path(value).is_file():
            raise UserError(
                f"--{prefix}data is a group of settings: for data write --{prefix}data.data={value} {where}"
            )
        if value == MISSING:
            raise UserError(f"--{prefix}{option} has no value: write --{prefix}{option}=VALUE {where}")
        if value is not None and found == option and found in known:
            values[found] = _value(found, value, known[found], where)
    try:
        _refuse_names(given)
        _refuse_what_cannot_be(values)
        if subcommand == "fit":
            _refuse_metrics(stage, given, values)
    except UserError as error:
        raise UserError(f"{prefix.rstrip('.')}: {error}" if prefix else str(error)) from None


# ---------------------------------------------------------------------- what was given


def _given(arguments: Sequence[str]) -> Iterator[_Given]:
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
                if not value or value.startswith("--"):
                    value = MISSING
            yield _Given(option, value or None)


def _of_file(path: str) -> Iterator[_Given]:
    try:
        settings = read_yaml(path)
    except UserError:
        return  # the parser says what is wrong with it
    for group, inner in settings.items() if isinstance(settings, dict) else ():
        for key, value in inner.items() if isinstance(inner, dict) else ((None, inner),):
            text = str(value) if type(value) in (str, int, float) else None
            yield _Given(f"{group}.{key}" if key else str(group), text, in_file=True)


def _known(option: str, known: dict[str, Parameter]) -> str | None:
    """The option that is meant: itself, a beginning of one, a group, or a setting inside one; None if there is none."""
    if option in known:
        return option
    if option.partition(".")[0] in (*FLAGS, *METHODS) or option.endswith(".help"):
        return option
    inside = next((name for name in known if option.startswith(f"{name}.")), None)
    return inside or next((name for name in known if name.startswith(option)), None)


# ---------------------------------------------------------------------- values


def _value(option: str, value: str, one: Parameter, where: str) -> Any:
    """What the value means for an option of this type; the text itself where the source does not say the type."""
    if one.annotation is inspect.Parameter.empty:
        return value
    if takes_lists(one.annotation) and not value.lstrip().startswith("["):
        value = f"[{value}]"
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument(f"--{option}", type=one.annotation)
    try:
        return parser.parse_args([f"--{option}={value}"])[option]
    except ArgumentError as error:
        raise UserError(f"{sentence(error.message)} {where}") from None


def _refuse_what_cannot_be(values: Mapping[str, Any]) -> None:
    """Refuse values of the right type that nothing can be done with; of those given twice the last counts."""
    of_trainer = {name.removeprefix("trainer."): value for name, value in values.items() if name.startswith("trainer.")}
    refuse_values({name: value for name, value in of_trainer.items() if not isinstance(value, str) or name in WORDS})
    for setting, shown in (("seed_everything", "--seed_everything"), ("data.seed", "data.seed")):
        if type(values.get(setting)) is int:
            refuse_seed(shown, values[setting])
    task, checkpoint = values.get("data.task"), values.get("ckpt_path")
    if isinstance(task, str) and not is_address(task.partition("?")[0]):
        known_task(task)
    if checkpoint not in (None, "last", "best"):
        refuse_no_checkpoint(Path(checkpoint), "--ckpt_path: ")


# ---------------------------------------------------------------------- names that Lightning knows


def _refuse_names(given: Sequence[_Given]) -> None:
    """Refuse a word that is close to a name of Lightning's and is none, and such arguments of its classes."""
    made: dict[str, str] = {}  # option -> address of the class that was named last
    for option, value, _ in given:
        setting = option.rstrip("+")
        outer = next((name for name in ROOMS if option.startswith(f"{name}.")), None)
        if outer is not None:
            argument = option.removeprefix(f"{outer}.").removeprefix("init_args.")
            _refuse_argument(made.get(outer), argument, value, outer)
        elif value is not None and setting in (*WORDS, *ROOMS):
            classes = {name: address for room in ROOMS.get(setting, ()) for name, address in classes_in(room).items()}
            known = (*WORDS.get(setting, ()), *classes)
            word = value.rpartition(".")[2] if value.startswith(OURS) else value
            if word.lower() not in known and word not in known and (near := did_you_mean(word, known)):
                raise UserError(f"{setting} is {value}, which does not exist{near} (see `--help trainer`)")
            made[setting] = classes.get(word, "")


def _refuse_argument(address: str | None, argument: str, value: str | None, setting: str) -> None:
    parameters, name = parameters_of(address) if address else {}, str(address).rpartition(":")[2]
    if argument in parameters:
        known = CHOICES.get(argument, ())
        if known and value not in (None, *known) and (near := did_you_mean(str(value), known)):
            raise UserError(f"{setting}: {argument} of {name} is {value}, expected {' or '.join(known)}{near}")
    elif argument not in ("class_path", "dict_kwargs") and (near := did_you_mean(argument, parameters)):
        raise UserError(f"{setting}: {name} has no argument {argument}{near}")


# ---------------------------------------------------------------------- metrics


def _refuse_metrics(stage: Stage, given: Sequence[_Given], values: Mapping[str, Any]) -> None:
    """Refuse to watch what the stage never logs, where nothing else could log it."""
    chosen = [one for one in given if one.name.rstrip("+") == "trainer.callbacks"]
    known = {name for room in ROOMS["trainer.callbacks"] for name in classes_in(room)}
    others = any(one.in_file or not (one.value in known or str(one.value).startswith(OURS)) for one in chosen)
    if not stage.metrics or others:
        return
    watched = [("best.monitor", values.get("best.monitor"))]
    if values.get("stop.when", "steps") != "steps":
        watched.append(("stop.monitor", values.get("stop.monitor")))
    kind = ""
    for name, value, _ in given:
        if name.rstrip("+") == "trainer.callbacks":
            kind = str(value).rpartition(".")[2]
        elif name == "trainer.callbacks.monitor" and all(one.name != "trainer.callbacks.strict" for one in given):
            watched.append((f"trainer.callbacks: monitor of {kind}", value))
    for setting, metric in watched:
        if metric not in (None, *stage.metrics, *ALWAYS) and not str(metric).startswith("rollout/"):
            refuse_metric(stage, setting, str(metric), stage.metrics)
