"""One job of a study, wherever it runs: `do_logged` is what every engine calls."""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from dds_lightning.errors import UserError
from dds_lightning.saving.run_directory import RunDirectory, finished, locked, write_json

NODES, LOGS, LOCKS, MADE = "nodes", "logs", "locks", "made.json"
PACKAGES = ("dds-lightning", "torch", "lightning", "numpy", "gymnasium", "mujoco")
PATIENCE = 60.0
"""Seconds to wait for a worker of an earlier launch that is still saving in the same folder."""

Job = Mapping[str, Any]


def do(job: Job) -> dict[str, Any]:
    """Do a job, or find that it is done, in its folder under `nodes/`.

    Args:
        job: As `Node.job` gives it.

    Returns:
        `seconds`, and `error`: why it failed, in one line, or None.
    """
    from rich.console import Console

    root = Path(job["root"]) / NODES
    folder = root / job["key"]
    started = time.monotonic()
    try:
        with _locked(Path(job["root"]) / LOCKS / job["key"]):
            reads = {role: finished(root / key) for role, key in job["reads"].items()}
            if missing := [job["reads"][role] for role, done in reads.items() if done is None]:
                raise UserError(f"{missing[0]}, which this job reads, is gone: run the study again")
            module, _, name = job["work"].partition(":")
            work = getattr(importlib.import_module(module), name)
            directory = RunDirectory(root, Console(stderr=True))
            directory.do(
                job["key"],
                job["title"],
                job["settings"],
                [done for done in reads.values() if done is not None],
                lambda place, resuming: work(job["settings"], job["how"], reads, place, resuming),
            )
            if not (folder / MADE).exists():
                write_json(folder / MADE, provenance())
    except Exception as error:  # whatever it is, the other cells go on
        told = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        traceback.print_exc()
        return {"seconds": time.monotonic() - started, "error": " ".join(told.split())[:500] or type(error).__name__}
    return {"seconds": time.monotonic() - started, "error": None}


def do_logged(job: Job) -> dict[str, Any]:
    """`do`, with all that it and its child processes print in the job's log, on whatever engine."""
    path = Path(job["root"]) / LOGS / f"{job['key']}.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    file, kept = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), {one: os.dup(one) for one in (1, 2)}
    try:
        for stream in kept:  # not sys.stdout: what libraries log goes where it pointed when they were imported
            os.dup2(file, stream)
        return do(job)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for stream, copy in kept.items():
            os.dup2(copy, stream)
            os.close(copy)
        os.close(file)


@cache
def provenance() -> dict[str, Any]:
    """By what a result was made: versions, the commit where there is a checkout, the machine."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {"versions": versions, "commit": _commit(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}


def _commit() -> str | None:
    """The commit of the checkout that this package runs from, with `+` where files have changed since."""
    words = ["git", "-C", str(Path(__file__).parent)]
    try:
        found = subprocess.run([*words, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)  # noqa: S603
        changed = subprocess.run([*words, "status", "--porcelain", "."], capture_output=True, check=True)  # noqa: S603
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()[:12] + ("+" if changed.stdout else "")


class _locked:  # noqa: N801
    """`run_directory.locked`, with patience."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __enter__(self) -> None:
        until = time.monotonic() + PATIENCE
        while True:
            self.lock = locked(self.folder)
            try:
                return self.lock.__enter__()
            except UserError:
                if time.monotonic() > until:
                    raise
            time.sleep(0.2)

    def __exit__(self, *about: Any) -> None:
        self.lock.__exit__(*about)
