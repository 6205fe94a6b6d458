"""Does a training on ten million transitions stay small, with the data in a memory map?

    python benchmarks/ten_million.py [--steps 10000000] [--batches 200] [--folder /tmp/ten-million]

Writes a data set with AntMaze's widths as `arrays:` reads it (1.5 GB), opens it as `dds skill fit` does, takes the
statistics and some shuffled batches, and prints milliseconds a batch and the greatest memory of the process that is not
the page cache's (RssAnon of Linux), in MiB, with what the imports took alone.
"""

from __future__ import annotations

import argparse
import json
import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.segments import SegmentDataModule
from datamodules.trajectories import ARRAY_TYPES, Trajectories
from dds_lightning.saving.untrusted import remove_tree

OBSERVATIONS, ACTIONS, LENGTH = 29, 8, 1000


def resident() -> float:
    """MiB of this process that no file holds."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    found = re.search(r"RssAnon:\s+(\d+)", status)
    assert found is not None
    return int(found[1]) / 1024


class Peak(threading.Thread):
    """Watches memory twenty times a second."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.most = 0.0

    def run(self) -> None:
        """Watch."""
        while True:
            self.most = max(self.most, resident())
            time.sleep(0.05)


def write(folder: Path, steps: int) -> None:
    """Write the data set: one episode is saved as usual, then its arrays are repeated on disk."""
    random = np.random.default_rng(0)
    episode = {
        "observations": random.standard_normal((LENGTH + 1, OBSERVATIONS)).astype(np.float32),
        "actions": random.uniform(-1, 1, (LENGTH, ACTIONS)).astype(np.float32),
        "rewards": np.zeros(LENGTH, np.float32),
        "terminations": np.zeros(LENGTH, bool),
        "truncations": np.arange(LENGTH) == LENGTH - 1,
    }
    Trajectories.from_episodes("ten-million", [episode]).save(folder)
    count = steps // LENGTH
    for name in ARRAY_TYPES.keys() - {"action_low", "action_high"}:
        path = folder / f"{name}.npy"
        one = np.load(path)
        many = np.lib.format.open_memmap(path, "w+", one.dtype, (count * len(one), *one.shape[1:]))
        for start in range(0, len(many), len(one)):
            many[start : start + len(one)] = one
        many.flush()
    arrays: dict[str, Any] = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in ARRAY_TYPES}
    about = folder / "trajectories.json"
    facts = json.loads(about.read_text())
    about.write_text(json.dumps({**facts, "fingerprint": Trajectories(name=facts["name"], **arrays).fingerprint()}))


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--batches", type=int, default=200)
    parser.add_argument("--folder", type=Path, default=Path("/tmp/ten-million"))  # noqa: S108 - only by default
    asked = parser.parse_args()
    before = resident()
    write(asked.folder, asked.steps)
    try:
        watch = Peak()
        watch.start()
        data = SegmentDataModule(data=f"arrays:{asked.folder}", horizon=10, batch_size=128)
        data.setup()
        opened = watch.most
        data.statistics()
        batches = iter(data.train_dataloader())
        next(batches)
        started = time.process_time()
        for _ in range(asked.batches):
            next(batches)
        spent = 1000 * (time.process_time() - started) / asked.batches
        print(f"{len(data.training_segments):,} segments; {spent:.2f} ms a batch of 128")
        print(f"MiB beside the page cache: imports {before:.0f}, opened {opened:.0f}, at most {watch.most:.0f}")
    finally:
        remove_tree(asked.folder, asked.folder.parent)


if __name__ == "__main__":
    main()
