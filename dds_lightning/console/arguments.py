"""One value of an option that takes a list is a list of one: `--selection greedy` is `--selection=[greedy]`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Sequence
from typing import Any


def list_options(function: Callable[..., Any], prefix: str = "") -> set[str]:
    """Return the parameters of a function or class that take nothing but lists, as options: `--PREFIXname`."""
    return {
        f"--{prefix}{name}"
        for name, parameter in inspect.signature(function).parameters.items()
        if takes_lists(parameter.annotation)
    }


def takes_lists(annotation: Any) -> bool:
    """Whether a type takes nothing but lists."""
    text = str(annotation).removeprefix("collections.abc.")
    return text.startswith(("list[", "Sequence[")) and "|" not in text


def without_files(arguments: Sequence[str], flag: str = "--config") -> list[str]:
    """Return the arguments without the files of settings that they name."""
    rest, out = iter(arguments), []
    for argument in rest:
        if argument == flag:
            next(rest, None)
        elif not argument.startswith(f"{flag}="):
            out.append(argument)
    return out


def as_lists(arguments: Sequence[str], options: Collection[str]) -> list[str]:
    """Return the arguments with brackets around every value of `options` that has none."""
    out: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        flag, equals, value = argument.partition("=")
        if flag in options and not equals and (following := next(rest, None)) is not None:
            value = following
        elif flag not in options or not equals:
            out.append(argument)
            continue
        out.append(f"{flag}={value}" if value.lstrip().startswith("[") else f"{flag}=[{value}]")
    return out
