"""What Lightning, or the parser of the command line, refuses: told as one sentence, as our own refusals are."""

from __future__ import annotations

import contextlib
import difflib
import dis
import re
import sys
import traceback
from collections.abc import Iterable, Iterator

from dds_lightning.errors import UserError

LIBRARIES = ("lightning", "lightning_utilities", "torchmetrics", "jsonargparse")
"""Packages whose own `raise` statements mean that a setting cannot work."""
KINDS = {
    "<class 'int'>": "a whole number",
    "<class 'float'>": "a number",
    "<class 'bool'>": "true or false",
    "<class 'str'>": "text",
    "<class 'NoneType'>": "null",
    "<class 'dict'>": "a mapping such as {name: value}",
    "<class 'list'>": "a list such as [a,b]",
}
"""What the parser calls a type, and what people call it."""
EXTRAS = {"tensorboard": "log", "wandb": "log"}
"""Package that may be missing -> the extra that brings it."""


@contextlib.contextmanager
def as_user_errors(given: Iterable[str] = ()) -> Iterator[None]:
    """Raise what a library refuses on purpose as a `UserError`; errors that nobody meant pass as they are.

    Args:
        given: Arguments of the command; those that the refusal is about are named with it.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        if (told := _told_by_a_process(error)) or (told := _told(error) if is_refusal(error) else ""):
            about = [one for one in given if _is_about(told, one)]
            raise UserError(told.rstrip(".") + (f" (given: {' '.join(about)})" if about else "")) from error
        raise


def _told(error: BaseException) -> str:
    """What a refusal says; where it says nothing, what refused."""
    if str(error):
        return sentence(str(error))
    frame = [frame for frame, _ in traceback.walk_tb(error.__traceback__)][-1]
    name = type(frame.f_locals.get("self", frame)).__name__
    return f"{name}.{frame.f_code.co_name} raises {type(error).__name__}: {name} cannot be used as it is"


def is_refusal(error: BaseException) -> bool:
    """Whether the innermost frame of an error is a `raise` statement of one of `LIBRARIES`."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None or trace.tb_frame.f_globals.get("__name__", "").split(".")[0] not in LIBRARIES:
        return False
    return trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


def _told_by_a_process(error: BaseException) -> str:
    """The sentence of a `UserError` in one of the processes of `ddp_spawn`; empty if it is something else."""
    if type(error).__name__ != "ProcessRaisedException":
        return ""
    _, found, told = str(error).rpartition(f"{UserError.__module__}.{UserError.__name__}: ")
    return sentence(told) if found else ""


def _is_about(told: str, argument: str) -> bool:
    """Whether a refusal names the setting `--trainer.NAME=VALUE`, or a value that is a word."""
    name, _, value = argument.removeprefix("--trainer.").partition("=")
    words = set(re.findall(r"\w+", told))
    is_word = value.isalpha() and len(value) > 2
    return argument.startswith("--trainer.") and (name in words or (is_word and value in words))


def sentence(message: str) -> str:
    """One line that names the setting, what was found and what was expected, from a message of the parser's."""
    key, message = _key_of(message)
    if "Does not validate against any of the Union subtypes" in message:
        told = _of_union(key, message)
    elif (found := re.fullmatch(r"Expected an? (.+?)\. Got value: (.*)", message, flags=re.DOTALL)) is not None:
        told = f"{key or 'value'} is {found[2]}, expected {_expected([found[1]], found[2])}"
    else:
        told = f"{key}: {message}" if key else message
    for package, extra in EXTRAS.items():
        if re.search(rf"\b{package}\b", told, flags=re.IGNORECASE) and ("not met" in told or "No module" in told):
            told = f"{told.split('. HINT')[0]}; install it with `pip install -e '.[{extra}]' -c constraints.txt`"
    return " ".join(told.split())


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """End of a sentence: the known words that are nearest to a mistyped one; empty if none is near."""
    ending = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), ending, n=2, cutoff=0.66)
    return f": did you mean {' or '.join(ending[one] for one in near)}?" if near else ""


def _key_of(message: str) -> tuple[str, str]:
    """A message of the parser's in two parts: the setting that it is about, empty if none, and what it says."""
    found = re.match(r"(?:Validation failed: )?(?:Parser key|Key) \"([^\"]+)\": ?(.*)", message, re.DOTALL)
    return (found[1], found[2].strip().removeprefix("- ")) if found else ("", message.strip())


def _of_union(key: str, message: str) -> str:
    """Of all the types that a value does not fit, the one that it was meant for."""
    listed = message.partition("Errors:\n")[2].rpartition("Given value type:")[0]
    given = message.rpartition("Given value: ")[2].strip()
    dash = re.match(r"\s*- ", listed)  # those of a union inside it are further to the right
    parts = [one.strip() for one in re.split(f"^{dash[0]}", listed, flags=re.MULTILINE)] if dash else []
    errors = [" ".join(one.split()) for one in parts if one]
    for part in parts:
        if (found := re.match(r"Problem with given class_path '([^']+)':\s*(.*)", part, re.DOTALL)) is not None:
            return f"{key or 'trainer'}: {_of_class(key, *found.groups())}"
    for error in errors:
        if not re.match(r"Expected an? |Not a valid |Unexpected import|Import of|Problem with", error):  # its own words
            made = re.search(r"class_path='[\w.]*?(\w+)'", given)
            return f"{made[1]}: {error}" if made else f"{key}: {error}" if key else error
    for error in errors:
        if (found := re.match(r"Expected a dot import path string: (\S+)", error)) is not None:
            return f"{key} is {found[1]}, and there is no such class{did_you_mean(found[1], _class_names())}"
    expected = [found[1] for one in errors if (found := re.match(r"Expected an? (.+?)(?:\. Got value: .*|\.?)$", one))]
    return f"{key or 'value'} is {given}, expected {_expected(expected, given)}"


def _of_class(key: str, path: str, problem: str) -> str:
    """What is wrong with the arguments of a logger or callback, and the flag that mends it."""
    name = path.rpartition(".")[2]
    if (missing := re.search(r"arguments are required: (.*)", problem)) is not None:
        first = missing[1].split(",")[0].strip()
        return f"{name} needs {missing[1]}: give --{key}.{first}=VALUE"
    if (strange := re.search(r"Option '([^']+)' is not accepted", problem)) is not None:
        module = sys.modules.get(path.rpartition(".")[0])
        code = getattr(getattr(getattr(module, name, None), "__init__", None), "__code__", None)
        known = code.co_varnames[1 : code.co_argcount + code.co_kwonlyargcount] if code else ()
        return f"{name} has no argument {strange[1]}{did_you_mean(strange[1], known)}"
    return f"{name}: {sentence(problem)}"


def _class_names() -> list[str]:
    """Names of Lightning's loggers and callbacks."""
    rooms = (sys.modules.get(f"lightning.pytorch.{room}") for room in ("loggers", "callbacks", "profilers"))
    return [name for room in rooms for name in getattr(room, "__all__", ())]


def _expected(types: Iterable[str], given: str = "") -> str:
    """What values are expected, from the types as the parser prints them; a near one is suggested."""
    choices: list[str] = []
    kinds: list[str] = []
    for one in types:
        if "Literal[" in one:
            choices += [c.strip(" '\"") for c in one.partition("[")[2].rstrip("]").split(",")]
        elif not re.search(r"Iterable|lightning\.|Not a valid", one):
            kinds.append(KINDS.get(one, one))
    if choices:
        kinds = [kind for kind in kinds if kind != "a whole number"]
    choices = list(dict.fromkeys(choices))
    listed = ", ".join([*choices, *kinds])
    return f"one of {listed}{did_you_mean(given, choices)}" if choices else " or ".join(kinds)
