"""Recording episodes on all cores, in rounds that are functions of the seed and their number alone.

```
 recorder(0) recorder(1) recorder(2) recorder(3) │ recorder(4) ...    a round is some episodes, a parcel some rounds
 └────────────────── parcel 0 ───────────────────┘
        │  kept as a file until the data set is whole, so that an interrupted collection goes on
        ▼
 episodes in order ─► the data set
```
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dds_lightning.errors import UserError
from dds_lightning.saving.files import written_whole

Episode = dict[str, Any]


class EpisodeRecorder(Protocol):
    """Records round i of a data set; picklable, and everything about a round follows from its number."""

    steps: int
    """Steps of the whole set."""
    rounds: int
    """Rounds of the whole set."""

    def __call__(self, number: int) -> list[Episode]:
        """Record one round, one episode or more: Minari's field names to arrays or mappings of arrays."""


def record(
    recorder: EpisodeRecorder,
    workers: int | None = None,
    *,
    parcel: int = 4,
    kept: Kept | None = None,
    title: str | None = None,
) -> Iterator[Episode]:
    """Every episode in order.

    Args:
        recorder: What records them.
        workers: Processes; None takes every core, 1 stays in this process.
        parcel: Rounds that a worker fetches at once; has no influence on the data.
        kept: Parcels of an earlier, interrupted call, and where to put the new ones.
        title: Of a progress bar on standard error; None shows none.

    Raises:
        UserError: For a number of workers below 1, or when a worker process died.
    """
    if workers is not None and workers < 1:
        raise UserError(f"workers: found {workers}, expected at least 1, or none for every core")
    if kept is not None:
        kept.open()
    parcels = range(0, recorder.rounds, parcel)
    missing = [first for first in parcels if kept is None or not kept.has(first)]
    workers = min(workers or _cores(), max(len(missing), 1))
    parts = [range(first, min(first + parcel, recorder.rounds)) for first in missing]
    made = _in_parallel(recorder, parts, workers) if workers > 1 else (_parcel(recorder, part) for part in parts)
    episodes = _in_order(parcels, set(missing), made, kept)
    return _with_progress(episodes, recorder.steps, title) if title else episodes


class Kept:
    """Parcels on disk, beside the data set that they will become; other settings start anew.

    Args:
        folder: Of the data set; the parcels lie in a hidden folder beside it.
        settings: Everything that the data depend on.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        text = json.dumps(settings, sort_keys=True, default=str)
        self.folder = folder.parent / f".{folder.name}.recording"
        self.key = hashlib.sha256(text.encode()).hexdigest()

    def open(self) -> None:
        """Make the folder ready: parcels of other settings go."""
        note = self.folder / "settings"
        if not note.is_file() or note.read_text(encoding="utf-8") != self.key:
            shutil.rmtree(self.folder, ignore_errors=True)
            self.folder.mkdir(parents=True)
            note.write_text(self.key, encoding="utf-8")

    def has(self, first: int) -> bool:
        """Whether the parcel that begins with a round is there."""
        return self._path(first).is_file()

    def write(self, first: int, episodes: list[Episode]) -> None:
        """Keep a parcel, whole or not at all."""
        arrays = {f"{i}/{name}": array for i, episode in enumerate(episodes) for name, array in _flat(episode)}
        with written_whole(self._path(first)) as part, part.open("wb") as file:
            np.savez(file, **arrays)

    def read(self, first: int) -> list[Episode]:
        """The episodes of a parcel."""
        episodes: dict[int, Episode] = {}
        with np.load(self._path(first), allow_pickle=False) as stored:
            for key in stored.files:
                number, *path, name = key.split("/")
                place = episodes.setdefault(int(number), {})
                for step in path:
                    place = place.setdefault(step, {})
                place[name] = stored[key]
        return [episodes[number] for number in sorted(episodes)]

    def remove(self) -> None:
        """Forget the parcels: the data set is whole."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, first: int) -> Path:
        return self.folder / f"{first:06d}.npz"


def _flat(fields: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in fields.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}/")
        else:
            yield prefix + name, value


def _in_order(
    parcels: Iterable[int], missing: set[int], made: Iterator[list[Episode]], kept: Kept | None
) -> Iterator[Episode]:
    for first in parcels:
        if first not in missing:
            assert kept is not None
            yield from kept.read(first)
            continue
        episodes = next(made)
        if kept is not None:
            kept.write(first, episodes)
        yield from episodes


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _in_parallel(recorder: EpisodeRecorder, parcels: list[range], workers: int) -> Iterator[list[Episode]]:
    # No fork: a parent that runs deep-learning threads must not be copied.
    method = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context(method), _keep, (recorder,))
    try:
        yield from pool.map(_record, parcels)
    except (BrokenProcessPool, ConnectionError, EOFError) as error:
        raise UserError(
            "workers: a collecting process died; a script must call this under `if __name__ == '__main__':`, "
            "and workers=1 needs no other processes"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_recorder: EpisodeRecorder | None = None


def _keep(recorder: EpisodeRecorder) -> None:
    global _recorder
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    _recorder = recorder


def _record(rounds: range) -> list[Episode]:
    assert _recorder is not None
    return _parcel(_recorder, rounds)


def _parcel(recorder: EpisodeRecorder, rounds: range) -> list[Episode]:
    return [episode for number in rounds for episode in recorder(number)]


def _with_progress(episodes: Iterator[Episode], steps: int, title: str) -> Iterator[Episode]:
    from dds_lightning.console.progress import track

    layout = ("{task.description}", "bar", "count", "steps", "elapsed")
    return track(episodes, layout, steps, title, lambda episode: len(episode["rewards"]), transient=False)
