"""A run directory that knows what has been done: steps with markers, which are skipped, resumed or redone.

```
 runs/TASK/
   run.lock              held while a `dds run` works here
   STEP/…                what the step wrote
   STEP/stage.json       state, settings, hashes of its inputs and outputs, seconds
   previous/STEP/…       the last result that other settings replaced
```

A step is *done* when its marker says so, its settings and the outputs of the steps it reads have not changed, and its
own outputs are still there. It is *resumed* when it was started with exactly these settings and inputs and did not
finish. Otherwise what is there moves to `previous/` and the step starts over.
"""

import errno
import hashlib
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from rich.console import Console

from dds_lightning.errors import UserError
from dds_lightning.saving.files import refuse_newer, sha256, written_whole
from dds_lightning.saving.untrusted import (
    TEXT,
    conform,
    is_inside,
    mapping,
    read_json,
    refuse_links,
    regular_file,
    remove_tree,
)

FORMAT = 1
MARKER = "stage.json"
LOCK, PREVIOUS = "run.lock", "previous"
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)
"""What Lustre, NFS and other shares answer where locks are not set up."""
Work = Callable[[Path, bool], Mapping[str, Any]]


@dataclass
class Done:
    """A finished step.

    Attributes:
        name: Name of the step.
        folder: Where its files are.
        outputs: Name -> path of what later steps read.
        facts: Small results worth keeping in the marker; the same for the same outputs.
        digest: Hash of outputs and facts, which the markers of later steps hold.
        seconds: How long the work took, not counting interruptions.
        skipped: Whether it had been done before.
    """

    name: str
    folder: Path
    outputs: dict[str, Path]
    facts: dict[str, Any] = field(default_factory=dict)
    digest: str = ""
    seconds: float = 0.0
    skipped: bool = False


class RunDirectory:
    """The steps of one run directory.

    Args:
        root: The run directory.
        console: Where progress is printed.
        fresh: Do everything again.
    """

    def __init__(self, root: Path, console: Console, fresh: bool = False) -> None:
        self.root, self.console, self.fresh = root, console, fresh
        self.done: list[Done] = []

    def do(
        self,
        name: str,
        title: str,
        settings: Mapping[str, Any],
        reads: Sequence[Done],
        work: Work,
        former: Mapping[str, Any] | None = None,
    ) -> Done:
        """Do one step, or find that it is done.

        Args:
            name: Name of the step and its folder.
            title: What a person reads while it runs.
            settings: Everything that its result depends on apart from `reads`; JSON values.
            reads: The steps whose outputs it uses.
            work: Called with (folder, resuming); returns outputs (values that are paths in the folder) and facts.
            former: `settings` as an earlier version wrote them, which count as the same.

        Raises:
            UserError: A newer version of this package did the step; nothing is touched.
        """
        folder, marker, expected, same = self._look(name, settings, reads, former)
        if found := self._finished(folder, marker, same):
            self._say(f"{title}: done before, in {duration(found.seconds)}", "dim")
            self.done.append(found)
            return found

        resuming = same and marker.get("state") == "started" and not self.fresh
        if resuming:
            self._say(f"{title}: going on after {duration(marker.get('seconds', 0.0))}", "bold")
        else:
            reason = "" if not marker or self.fresh else f" again ({_difference(marker, expected)})"
            self._say(f"{title}{reason}", "bold")
            _put_away(folder, self.root)
        folder.mkdir(parents=True, exist_ok=True)
        before = float(marker.get("seconds", 0.0)) if resuming else 0.0
        record = {"format": FORMAT, "stage": name, "state": "started", **expected, "seconds": before}
        write_json(folder / MARKER, record)
        started = time.monotonic()
        try:
            made = dict(work(folder, resuming))
        except BaseException:
            write_json(folder / MARKER, {**record, "seconds": before + time.monotonic() - started})
            raise
        outputs = {key: value for key, value in made.items() if isinstance(value, Path)}
        facts = _json({key: value for key, value in made.items() if key not in outputs})
        seconds = before + time.monotonic() - started
        files = {key: _digest(path) for key, path in outputs.items()}
        record |= {
            "state": "finished",
            "seconds": round(seconds, 2),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "outputs": {key: os.path.relpath(path, folder) for key, path in outputs.items()},
            "files": files,
            "facts": facts,
        }
        write_json(folder / MARKER, record)
        result = Done(name, folder, outputs, facts, _join(files, facts), seconds)
        self._say(f"{title}: {duration(seconds)}", "green")
        self.done.append(result)
        return result

    def find(
        self,
        name: str,
        settings: Mapping[str, Any],
        reads: Sequence[Done],
        former: Mapping[str, Any] | None = None,
    ) -> Done | None:
        """The step if it is done; arguments as of `do`, which would find it."""
        folder, marker, _, same = self._look(name, settings, reads, former)
        return self._finished(folder, marker, same)

    def _look(
        self, name: str, settings: Mapping[str, Any], reads: Sequence[Done], former: Mapping[str, Any] | None
    ) -> tuple[Path, dict[str, Any], dict[str, Any], bool]:
        """A step's folder, its marker, what a marker of this call would say, and whether they say the same."""
        folder = self.root / name
        expected = {"settings": _json(settings), "inputs": {stage.name: stage.digest for stage in reads}}
        marker = read_marker(folder)
        there = {key: marker.get(key) for key in expected}
        same = there in (expected, {**expected, "settings": _json(settings if former is None else former)})
        return folder, marker, expected, same

    def _finished(self, folder: Path, marker: dict[str, Any], same: bool) -> Done | None:
        usable = same and marker.get("state") == "finished" and not self.fresh
        return _found(folder, marker) if usable else None

    def _say(self, text: str, style: str) -> None:
        self.console.print(text, style=style, highlight=False, markup=False)


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Keep a second `dds run` out of the directory while this one works.

    Raises:
        UserError: Another run is working there, or it is not a folder.
    """
    if root.exists() and not root.is_dir():
        raise UserError(f"out: {root} is a file, expected a folder for the run")
    created = not root.exists()
    root.mkdir(parents=True, exist_ok=True)
    refuse_links(root)
    path = root / LOCK
    try:
        with _opened(path) as file:
            _lock(file, root)
            yield
    finally:
        # A run that ended before its first stage leaves nothing behind.
        if created and [entry.name for entry in root.iterdir()] == [path.name]:
            path.unlink()
            root.rmdir()


def _opened(path: Path) -> IO[bytes]:
    """The lock's file, created if need be; what it holds stays, and a link is not followed."""
    try:
        if path.exists():
            regular_file(path)  # a pipe or a device may do something when it is opened
        return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666), "rb")
    except (OSError, UserError) as error:
        if isinstance(error, OSError) and error.errno != errno.ELOOP:
            raise
        raise UserError(f"out: the lock of this run cannot be opened: {error}; delete it") from None


def _lock(file: IO[bytes], root: Path) -> None:
    """Lock the file of a run directory; where the file system knows no locks, warn and go on."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(f"out: another run or study works in {root}: wait for it, or choose another --out") from None
    except ImportError:
        reason = "this system has none"
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        reason = str(error.strerror)
    else:
        return
    told = f"out: {root} cannot be locked ({reason}): do not start a second `dds run` there while this one works"
    warnings.warn(told, stacklevel=2)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically: a reader sees the old file or the new one."""
    text = json.dumps(value, indent=2, allow_nan=False)
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")


def duration(seconds: float) -> str:
    """`83` as `1 min 23 s`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s" if seconds >= 10 else f"{seconds:.1f} s"


def read_marker(folder: Path) -> dict[str, Any]:
    """The marker in a step's folder; empty if it is missing or damaged, about which a warning tells.

    Raises:
        UserError: A newer version of this package wrote it.
    """
    path = folder / MARKER
    if not path.exists():
        return {}
    try:
        value = mapping(read_json(path, largest=16 * TEXT, root=folder.parent), path)
        if value.get("format", FORMAT) == FORMAT:
            _check_marker(value, folder)
    except UserError as error:
        warnings.warn(f"{error}; the stage counts as not done, and `dds run` does it again", stacklevel=2)
        return {}
    refuse_newer(path, value.get("format", FORMAT), FORMAT)
    return value


def finished(folder: Path) -> Done | None:
    """The step in a folder, if it was finished, whatever its settings, and its outputs have not changed."""
    marker = read_marker(folder)
    return _found(folder, marker) if marker.get("state") == "finished" else None


def _check_marker(marker: Mapping[str, Any], folder: Path) -> None:
    """Refuse a marker that no step wrote, or whose outputs lie outside of the run."""
    what = str(folder / MARKER)
    form: dict[str, Any] = {"settings": {}, "inputs": {}, "facts": {}, "outputs": {}}
    found = conform(
        {**form, "state": "", "seconds": 0.0, **marker}, {**form, "state": (str,), "seconds": (int, float)}, what
    )
    if "files" in marker:
        conform(marker, {"files": dict.fromkeys(found["outputs"], (str,)), "stage": (str,)}, what)
    for name, place in found["outputs"].items():
        if not isinstance(place, str) or not is_inside(folder / place, folder.parent):
            raise UserError(f"{what}: output {name} is {place!r}, expected a place in the run directory")


def _found(folder: Path, marker: dict[str, Any]) -> Done | None:
    """The step as it was finished, if none of its outputs has changed."""
    if not {"outputs", "files", "facts", "stage", "seconds"} <= marker.keys():
        return None
    outputs = {key: folder / relative for key, relative in marker["outputs"].items()}
    if any(not path.exists() or _digest(path) != marker["files"][key] for key, path in outputs.items()):
        return None
    digest, seconds = _join(marker["files"], marker["facts"]), float(marker["seconds"])
    return Done(marker["stage"], folder, outputs, marker["facts"], digest, seconds, skipped=True)


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of every file under a folder with its name."""
    if path.is_file():
        return sha256(path)
    files = sorted(entry for entry in path.rglob("*") if entry.is_file())
    return _join({str(entry.relative_to(path)): sha256(entry) for entry in files}, {})


def _join(files: Mapping[str, str], facts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps([files, facts], sort_keys=True).encode()).hexdigest()


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value, default=str))


def _put_away(folder: Path, root: Path) -> None:
    """Move a step's folder to `previous/`, in place of what was there, unless only that was finished."""
    if not folder.exists():
        return
    previous = root / PREVIOUS / folder.relative_to(root)
    states = [read_marker(place).get("state") for place in (previous, folder)]
    if states[0] == "finished" != states[1]:
        remove_tree(folder, root)
        return
    remove_tree(previous, root)
    previous.parent.mkdir(parents=True, exist_ok=True)
    os.replace(folder, previous)


def _difference(marker: dict[str, Any], expected: dict[str, Any]) -> str:
    """Why a step is done again, in a few words."""
    old, new = _flat(marker.get("settings") or {}), _flat(expected["settings"])
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    if changed:
        shown = ", ".join(f"{name} {old.get(name)!r} -> {new.get(name)!r}" for name in changed[:3])
        return shown + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
    inputs = marker.get("inputs") or {}
    stale = [name for name, digest in expected["inputs"].items() if inputs.get(name) != digest]
    return f"{', '.join(stale)} changed" if stale else "its files changed"


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat.update(_flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value})
    return flat
