"""Reads mutated files in forked children, and watches what reading them does to the world.

A child has ten seconds and one gigabyte more than it began with. An audit hook of Python's notes what it opens,
deletes, starts and connects to, so that harm is seen even where no file of ours is hit.
"""

import contextlib
import hashlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dds_lightning.errors import UserError
from tests.faults.mutating import of_kind

SECONDS, BYTES = 10, 2**30
REFUSED, LOADED, TRACEBACK, HARM, LATE, LARGE, VAGUE = (
    *("refused", "loaded", "traceback", "harm", "beyond 10 s", "beyond 1 GB", "no clear sentence"),
)
BAD = (TRACEBACK, HARM, LATE, LARGE, VAGUE)
_STATUS = {3: REFUSED, 4: LOADED, 5: TRACEBACK, 6: HARM, 7: VAGUE}

CHANGES = {"os.remove", "os.rename", "os.rmdir", "os.truncate", "os.mkdir", "os.link", "os.symlink", "shutil.rmtree"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
STARTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.forkpty", "socket.connect"}


@dataclass(frozen=True)
class Target:
    """Something that is read.

    Attributes:
        name: Of the line in the table.
        make: Writes a sound one into a folder.
        files: Patterns of the files in it that are mutated.
        read: Reads it as a user's command would; may write into that folder.
        seal: What is done after the mutation, as an attacker would: hashes that fit.
    """

    name: str
    make: Callable[[Path], Any]
    files: tuple[str, ...]
    read: Callable[[Path], Any]
    seal: Callable[[Path, Path], Any] = lambda folder, changed: None


@dataclass
class Tally:
    """What became of the mutated files of a target.

    Attributes:
        counts: Outcome -> how many.
        stories: (Seed of the case, outcome, file, what was said) of those that should not be.
    """

    counts: Counter[str] = field(default_factory=Counter)
    stories: list[tuple[int, str, str, str]] = field(default_factory=list)


def fuzz(target: Target, cases: int, root: Path, seed: int = 0) -> Tally:
    """Mutate one file of a target at a time, read it in a child, and tell what happened.

    Args:
        target: What is read.
        cases: Number of mutated files.
        root: An empty folder.
        seed: Case i draws its mutation from seed + i.
    """
    sound, precious = root / "sound", root / "work" / "precious"
    sound.mkdir(parents=True)
    target.make(sound)
    outcome, said = _read_in_child(target, sound, sound)
    assert outcome == LOADED, f"{target.name}: the sound files are {outcome}: {said}"
    _write_precious(precious)
    before, tally = _digest(precious.parent.parent), Tally()
    for number in range(seed, seed + cases):
        rng, case = random.Random(number), precious.parent / "case"
        shutil.copytree(sound, case)
        files = sorted(path for pattern in target.files for path in case.glob(pattern) if path.is_file())
        chosen = rng.choice(files)
        of_kind(chosen, rng)
        with contextlib.suppress(OSError):
            target.seal(case, chosen)
        outcome, said = _read_in_child(target, case, case)
        shutil.rmtree(case)
        if _digest(precious.parent.parent) != before:
            outcome, said = HARM, f"files outside have changed; {said}"
            shutil.rmtree(precious)
            _write_precious(precious)
        tally.counts[outcome] += 1
        if outcome in BAD:
            tally.stories.append((number, outcome, str(chosen.relative_to(case)), said[-1500:]))
    return tally


def _write_precious(folder: Path) -> None:
    (folder / "folder").mkdir(parents=True)
    for name in ("secret", "folder/file"):
        (folder / name).write_text("years of work")


def _digest(root: Path) -> str:
    """Hash of every file outside of the case and of the sound files."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")):
        inside = path.relative_to(root).parts
        if inside[0] != "sound" and inside[:2] != ("work", "case"):
            digest.update(repr((inside, path.read_bytes() if path.is_file() else None)).encode())
    return digest.hexdigest()


def _read_in_child(target: Target, folder: Path, case: Path) -> tuple[str, str]:
    report = case.parent / f".{case.name}.said"
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    child = os.fork()
    if child == 0:
        status, said = 5, ""
        try:
            os.setsid()
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            nowhere = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(nowhere, stream)
            handle = os.open(report, os.O_WRONLY | os.O_CREAT, 0o644)
            status, said = _watched(target, folder)
        except BaseException:
            said = traceback.format_exc()
        finally:
            with contextlib.suppress(BaseException):
                os.write(handle, said.encode("utf-8", "replace"))
            os._exit(status)
    deadline = time.monotonic() + SECONDS
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > deadline + 20:  # its own clock counts the processor's seconds; a busy machine is no fault
            os.killpg(child, signal.SIGKILL)
        time.sleep(0.002)
    said = report.read_text(encoding="utf-8", errors="replace") if report.exists() else ""
    report.unlink(missing_ok=True)
    if os.WIFSIGNALED(status):
        late = os.WTERMSIG(status) in (signal.SIGALRM, signal.SIGPROF, signal.SIGXCPU, signal.SIGKILL)
        return (LATE if late else TRACEBACK), f"ended by {signal.Signals(os.WTERMSIG(status)).name}; {said}"
    if usage.ru_maxrss * 1024 > resident + BYTES:
        return LARGE, f"{usage.ru_maxrss / 2**20:.2f} GB; {said}"
    return _STATUS.get(os.WEXITSTATUS(status), TRACEBACK), said


def _watched(target: Target, folder: Path) -> tuple[int, str]:
    """Read, and return the status to end with and what was said."""
    harm: list[str] = []
    home = [str(folder), str(folder.resolve()), "/dev/null", f"{tempfile.gettempdir()}/dds-env-"]
    secret = str(folder.parent / "precious")

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in STARTS:
            harm.append(f"{event} {arguments!r:.200}")
        elif event in CHANGES or event == "open":
            if event == "open":
                if not isinstance(arguments[0], (str, bytes, os.PathLike)):
                    return
                writes = isinstance(arguments[2], int) and arguments[2] & WRITING
                place = os.path.abspath(os.fsdecode(arguments[0]))
                if not writes and not place.startswith(secret):
                    return
            else:
                named = isinstance(arguments[0], (str, bytes, os.PathLike))
                place = os.path.abspath(os.fsdecode(arguments[0])) if named else "?"
            allowed = any(place.startswith(prefix) for prefix in home) or "__pycache__" in place or "/.cache/" in place
            if not allowed and "/.config/" not in place:
                harm.append(f"{event} {place:.200}")

    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.chdir(folder)
    sys.addaudithook(watch)
    status, said = 4, ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            target.read(folder)
        except UserError as error:
            status, said = 3, str(error)
            fine = "\n" not in said and 10 < len(said) < 1500 and "\x1b" not in said
            status = 3 if fine else 7
        except BaseException:
            status, said = 5, traceback.format_exc()
    if harm or Path("ran").exists() or (folder.parent / "outside").exists():
        return 6, f"{harm[:3]} {said}"
    return status, said
