"""Records episodes on all cores, in rounds that depend on the seed and their number alone.

```
 recorder(0) recorder(1) recorder(2) recorder(3) │ recorder(4) ...    a round is one or more episodes,
 └────────────────── chunk 0 ───────────────────┘                     a chunk one or more rounds
        │  kept as a file until the data set is complete, so that an interrupted collection can continue
        ▼
 episodes in order ─► the data set
```
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_npz
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import read_text, remove_tree

Episode = dict[str, Any]


class EpisodeRecorder(Protocol):
    """Records round i of a data set; picklable, and a round depends on nothing but its number."""

    steps: int
    """Steps of the complete set."""
    rounds: int
    """Rounds of the complete set."""

    def __call__(self, number: int) -> list[Episode]:
        """Record one round, one episode or more: Minari's field names to arrays or mappings of arrays."""


def record(
    recorder: EpisodeRecorder,
    workers: int | None = None,
    *,
    chunk: int = 4,
    partial: PartialRecording | None = None,
    title: str | None = None,
) -> Iterator[Episode]:
    """Every episode in order.

    Args:
        recorder: What records them.
        workers: Processes; None takes every core, 1 stays in this process.
        chunk: Rounds that a worker records at once; does not affect the data.
        partial: Chunks of an earlier, interrupted call; new ones are added to it.
        title: Of a progress bar on standard error; None shows none.

    Raises:
        UserError: For a number of workers below 1, or when a worker process died.
    """
    if workers is not None and workers < 1:
        raise UserError(f"workers: got {workers}, expected at least 1, or none for every core")
    if partial is not None:
        partial.open()
    chunks = range(0, recorder.rounds, chunk)
    missing = [first for first in chunks if partial is None or not partial.has(first)]
    workers = min(workers or _cores(), max(len(missing), 1))
    parts = [range(first, min(first + chunk, recorder.rounds)) for first in missing]
    made = _in_parallel(recorder, parts, workers) if workers > 1 else (_chunk(recorder, part) for part in parts)
    episodes = _in_order(chunks, set(missing), made, partial)
    return _with_progress(episodes, recorder.steps, title) if title else episodes


class PartialRecording:
    """Chunks on disk beside the data set that they will become; those of other settings are discarded.

    Args:
        folder: Of the data set; the chunks are stored in a hidden folder beside it.
        settings: Everything that the data depend on.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        text = json.dumps(settings, sort_keys=True, default=str)
        self.folder = folder.parent / f".{folder.name}.recording"
        self.key = hashlib.sha256(text.encode()).hexdigest()

    def open(self) -> None:
        """Create the folder; chunks of other settings are deleted."""
        note = self.folder / "settings"
        if not note.is_file() or read_text(note) != self.key:
            self.remove()
            self.folder.mkdir(parents=True)
            note.write_text(self.key, encoding="utf-8")

    def has(self, first: int) -> bool:
        """Whether the chunk that begins with round `first` is stored."""
        return self._path(first).is_file()

    def write(self, first: int, episodes: list[Episode]) -> None:
        """Store a chunk atomically."""
        arrays = {f"{i}/{name}": array for i, episode in enumerate(episodes) for name, array in _flat(episode)}
        with written_whole(self._path(first)) as part, part.open("wb") as file:
            np.savez(file, **arrays)

    def read(self, first: int) -> list[Episode]:
        """The episodes of the chunk that begins with round `first`."""
        episodes: dict[int, Episode] = {}
        for key, array in read_npz(self._path(first), remedy=f"delete {self.folder} and collect again").items():
            number, *path, name = key.split("/")
            fields = episodes.setdefault(int(number), {})
            for step in path:
                fields = fields.setdefault(step, {})
            fields[name] = array
        return [episodes[number] for number in sorted(episodes)]

    def remove(self) -> None:
        """Delete the chunks once the data set is complete."""
        remove_tree(self.folder, self.folder.parent)

    def _path(self, first: int) -> Path:
        return self.folder / f"{first:06d}.npz"


def _flat(fields: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in fields.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}/")
        else:
            yield prefix + name, value


def _in_order(
    chunks: Iterable[int], missing: set[int], made: Iterator[list[Episode]], partial: PartialRecording | None
) -> Iterator[Episode]:
    for first in chunks:
        if first not in missing:
            assert partial is not None
            yield from partial.read(first)
            continue
        episodes = next(made)
        if partial is not None:
            partial.write(first, episodes)
        yield from episodes


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _in_parallel(recorder: EpisodeRecorder, chunks: list[range], workers: int) -> Iterator[list[Episode]]:
    # No fork: a parent with deep-learning threads must not be copied.
    method = "spawn" if sys.platform in ("win32", "darwin") else "forkserver"
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context(method), _set_recorder, (recorder,))
    try:
        yield from pool.map(_record, chunks)
    except (BrokenProcessPool, ConnectionError, EOFError) as error:
        raise UserError(
            "workers: a collecting process died; a script must call this under `if __name__ == '__main__':`, "
            "and workers=1 needs no other processes"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_recorder: EpisodeRecorder | None = None


def _set_recorder(recorder: EpisodeRecorder) -> None:
    global _recorder
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, signal.SIG_IGN)  # the parent decides
    _recorder = recorder


def _record(rounds: range) -> list[Episode]:
    assert _recorder is not None
    return _chunk(_recorder, rounds)


def _chunk(recorder: EpisodeRecorder, rounds: range) -> list[Episode]:
    return [episode for number in rounds for episode in recorder(number)]


def _with_progress(episodes: Iterator[Episode], steps: int, title: str) -> Iterator[Episode]:
    from dds_lightning.console.progress import track

    layout = ("{task.description}", "bar", "count", "steps", "elapsed")
    return track(episodes, layout, steps, title, lambda episode: len(episode["rewards"]), transient=False)
