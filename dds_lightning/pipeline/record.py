"""What a run was asked for, kept in its folder: the command typed again with fewer words goes on with the same run.

Flags that could make a program run code, or that name files beside the data, are not taken from a folder, which may be
a stranger's: whoever wants them types them again.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dds_lightning.configs import RUN_DEFAULTS, families
from dds_lightning.errors import UserError, printable
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.saving.run_directory import write_json
from dds_lightning.saving.untrusted import mapping, read_json
from dds_lightning.tasks import get_task

RECORD = "asked.json"
NAMES = ("data", "seed", "preset", "evaluate_every", "episodes", "seeds", *RUN_DEFAULTS)
"""Settings that are kept; where and how fast a run works is not, nor how far it goes."""
PLAIN = (int, float, str)

Stages = Mapping[str, Sequence[str]]


def keep(settings: RunSettings, seeds: int | None = None) -> None:
    """Write what was asked for into the folder of the run; `seeds` as `dds run --seeds`."""
    asked = {name: value for name, value in settings.asked().items() if (name, value) != ("seed", 0)}
    asked |= {} if seeds is None else {"seeds": seeds}
    stages = {stage: list(words) for stage, words in settings.stages.items() if words}
    record = {"task": get_task(settings.task).name, "settings": asked, "stages": stages}
    write_json(settings.out / RECORD, record)


def recall(out: Path, task: str, typed: Mapping[str, Any], stages: Stages) -> tuple[dict[str, Any], dict[str, Any]]:
    """Add to what was typed what an earlier call in the same folder was asked for, and say what that is.

    Args:
        out: Folder of the run.
        task: Task of this call; the record of another one is not read.
        typed: Settings of this call; None for those that were not given.
        stages: Training stage -> its arguments, as they were given.

    Returns:
        The settings and the arguments of the stages.

    Raises:
        UserError: The record is damaged, or holds what has to be typed again.
    """
    path = out / RECORD
    settings, words = dict(typed), {stage: list(given) for stage, given in stages.items()}
    if not path.is_file():
        return settings, words
    record = mapping(read_json(path, root=out), path)
    if record.get("task") != get_task(task).name:
        return settings, words
    taken: list[str] = []
    refused: list[str] = []
    for name, value in mapping(record.get("settings"), path).items():
        if name in NAMES and settings.get(name) is None and type(value) in PLAIN:
            flag = f"--{name}={value}"
            (refused if name == "preset" and value not in families() else taken).append(flag)
            settings[name] = value
    for stage, kept in mapping(record.get("stages"), path).items():
        given = words.get(stage, [])
        left = [str(word) for word in kept if not any(_replaces(one, str(word)) for one in given)]
        shown = [f"--{stage}.{word.removeprefix('--')}" for word in left]
        for word, flag in zip(left, shown, strict=True):
            (taken if _is_plain(word) else refused).append(flag)
        words[stage] = [*left, *given]
    if refused:
        raise UserError(
            f"the run in {out} was made with {shlex.join(refused)}, which may name code and is not taken from a file: "
            f"type it again, or give another --out; to forget what the run was asked for, delete {path}"
        )
    if taken:
        told = f"as in the earlier call: {shlex.join(taken)} (what you type counts instead; delete {path} to forget)"
        print(printable(told), file=sys.stderr)
    return settings, words


def _replaces(typed: str, kept: str) -> bool:
    """Whether a word of a stage stands in place of a kept one: the same option, or one that holds it."""
    option, other = (word.partition("=")[0].removesuffix("+") for word in (typed, kept))
    return other == option or other.startswith(f"{option}.")


def _is_plain(word: str) -> bool:
    """Whether a kept word sets a number or a name: no configuration, no address of a class, no path."""
    option, _, value = word.partition("=")
    return not option.startswith(("--co", "-c")) and not re.search(r"[^\W\d]\w*\.[^\W\d]|[/\\]|class_path", value)
