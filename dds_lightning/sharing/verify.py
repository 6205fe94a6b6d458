"""Whether a published directory is what it claims to be: all checks of `dds checkpoints verify`."""

from __future__ import annotations

import contextlib
import re
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from torch import nn

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.saving.published import CONFIG, SUMS, Published, load_published
from dds_lightning.tasks import restore_task
from dds_lightning.tasks.own import OwnCodeError
from dds_lightning.training.stages import STAGES

SECONDS = 4
"""Work that reading and checking may take each. Both take half a second for the largest of the shipped agents."""
_TASK = re.compile(r"[\w-]+(@\w+)?(\?(start|goal)=\d+,\d+(&goal=\d+,\d+)?)?")
TOLERANCE = 1e-3
"""Largest difference between stored and computed answers: processors and library versions round differently, but other
weights differ by more."""


def verify_published(directory: str | Path) -> dict[str, Any]:
    """Check everything: file hashes, header, shapes, finite numbers, and the answers to fixed questions.

    Args:
        directory: The published directory.

    Returns:
        Facts: `task`, `stages` (of its modules), `parameters`, `horizon` and `num_skills` (None without an agent),
        `golden` (largest difference from the stored answers; None for a directory that stores none).

    Raises:
        UserError: A check fails; the message names the file.
    """
    told = f"{directory} takes more than {SECONDS} s of work to verify: no sound agent does"
    with cpu_budget(SECONDS, told):
        published = load_published(directory)
    classes = {name: stage.module_class() for name, stage in STAGES.items()}  # imports much, which is not their fault
    with cpu_budget(SECONDS, told):
        return _verified(published, classes)


def _verified(published: Published, classes: Mapping[str, type[nn.Module]]) -> dict[str, Any]:
    directory = published.directory
    names = [name for name in STAGES if isinstance(published.config.get(name), dict)]
    modules = {name: published.module(classes[name], name) for name in names}
    if not modules:
        raise UserError(f"{directory} holds no module of a training stage, expected some of {', '.join(STAGES)}")
    for name, module in modules.items():
        _check_box(f"{directory} ({name})", module)
    published.acting()
    facts: dict[str, Any] = {
        "directory": str(directory),
        "task": _task(published),
        "stages": list(modules),
        "format": published.config["format_version"],
        "parameters": sum(value.numel() for module in modules.values() for value in module.parameters()),
        "horizon": None,
        "num_skills": None,
        "golden": None,
    }
    online: Any = modules.get("online")
    raw = online is not None and online.hparams.space == "raw"
    if "skill" not in modules and not raw:
        return facts
    modules.clear()  # the agent has its own
    agent = DDSAgent.load(directory)
    facts |= {"horizon": agent.horizon, "num_skills": agent.num_skills}
    stored = published.config.get("golden")
    if stored is not None:
        facts["golden"] = _compare(directory, stored, agent.golden())
    return facts


def _task(published: Published) -> str | None:
    """The name of the task, which must not lead to another file."""
    task, where = published.config.get("task"), published.directory / CONFIG
    if task is not None and not (isinstance(task, str) and _TASK.fullmatch(task)):
        raise UserError(f"{where}: task is {str(task)[:80]!r}, expected the name of a task")
    if published.config.get("task_definition") is not None:
        with contextlib.suppress(OwnCodeError):  # nothing is run here; whoever plays it names the task
            restore_task(published.config, where)
    return task


def _check_box(where: str, module: nn.Module) -> None:
    box = getattr(module, "action_box", None)
    if box is not None and not bool((box.low < box.high).all()):
        raise UserError(f"{where}: action_box is {box.low.tolist()} to {box.high.tolist()}, expected low below high")


@contextlib.contextmanager
def cpu_budget(seconds: float, message: str) -> Iterator[None]:
    """Stop what takes too much work, whatever it is; does nothing outside the main thread.

    Seconds of the processor count, not of the clock: a busy machine must not make a sound directory look bad.

    Raises:
        UserError: With `message`.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: object) -> None:
        raise UserError(message)

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _compare(directory: str | Path, stored: Any, given: dict[str, Any]) -> float:
    largest = 0.0
    for name, answer in given.items():
        try:
            expected = np.array(stored[name], dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            told = f"{type(error).__name__}: {str(error)[:80]}"
            raise UserError(f"{directory}: golden, {name}: expected a table of numbers ({told})") from error
        if expected.shape != np.shape(answer):
            raise UserError(
                f"{directory}: golden, {name}: found shape {expected.shape}, expected {np.shape(answer)}; the "
                "directory's files belong to different agents"
            )
        difference = float(np.abs(expected - np.array(answer)).max())
        if not difference <= TOLERANCE:
            raise UserError(
                f"{directory}: golden, {name}: this installation answers {difference:.2g} apart from what the agent "
                f"answered when it was published, expected at most {TOLERANCE:g}; its weights were changed, or the "
                "networks of this version compute something else"
            )
        largest = max(largest, difference)
    return largest


def find_published(roots: Iterable[str | Path] = ("checkpoints", "runs")) -> pd.DataFrame:
    """List published directories under some folders, without reading their weights.

    Returns:
        One row a directory: `checkpoint`, `task`, `score` (of the first contestant in metrics.json), `success`,
        `seed`, `megabytes`, `problem` (empty when hashes and header are sound).
    """
    rows = []
    for root in roots:
        for sums in sorted(Path(root).rglob(SUMS)):
            if (sums.parent / "model.safetensors").is_file() and not sums.parent.name.startswith("."):
                rows.append(_row(sums.parent))
    return pd.DataFrame(rows, columns=["checkpoint", "task", "score", "success", "seed", "megabytes", "problem"])


def _row(directory: Path) -> dict[str, Any]:
    size = sum(path.stat().st_size for path in directory.iterdir() if path.is_file()) / 1e6
    row: dict[str, Any] = {"checkpoint": str(directory), "megabytes": round(size, 1), "problem": ""}
    try:
        published = load_published(directory)
    except UserError as error:
        return {**row, "problem": str(error)}
    results = published.metrics.get("results")
    first = results[0] if isinstance(results, list) and results and isinstance(results[0], dict) else {}
    return {
        **row,
        "task": published.config.get("task"),
        "score": first.get("score"),
        "success": first.get("success"),
        "seed": published.metrics.get("seed"),
    }
