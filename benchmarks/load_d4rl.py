"""The time and memory that loading a D4RL file of a million AntMaze steps takes.

    python benchmarks/load_d4rl.py [--rows 1000000] [--file FILE]

Makes a file of that size in D4RL's layout (the numbers are invented; widths, types and compression are D4RL's),
loads it in a new process, and prints seconds and peak resident memory, including imports. With --file, that file is
loaded; it is made first if it does not exist.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TASK = "antmaze-medium-play"
EPISODE = 1001
"""Rows per recording, as D4RL cut them."""


def make_file(path: Path, rows: int) -> None:
    """Write `rows` rows: recordings that pace up and down the first corridor, some reaching a goal there."""
    import h5py
    import numpy as np

    rng = np.random.default_rng(0)
    step = np.arange(rows) % EPISODE
    pace = np.sin(2 * np.pi * step / 400 + (np.arange(rows) // EPISODE) * 0.7)
    at_goal = pace > 0.99
    observations = rng.normal(size=(rows, 29)).astype(np.float32)
    observations[:, 0] = 2 + 2 * pace
    observations[:, 1] = rng.uniform(-0.5, 0.5, rows)
    arrays = {
        "observations": observations,
        "actions": rng.uniform(-1, 1, (rows, 8)).astype(np.float32),
        "rewards": np.append(at_goal[1:], False).astype(np.float32),
        "terminals": np.append(at_goal[1:], False).astype(np.float32),
        "timeouts": step == EPISODE - 1,
        "infos/goal": rng.uniform(0, 20, (rows, 2)).astype(np.float32),
        "infos/qpos": observations[:, :15],
        "infos/qvel": observations[:, 15:],
    }
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            file.create_dataset(key, data=array, compression="gzip")


def measure(path: Path) -> None:
    """Load a file in this process, which has done nothing else, and print time and memory."""
    started = time.perf_counter()
    from datamodules import load_trajectories

    imported = time.perf_counter()
    data = load_trajectories(f"d4rl:{path}", TASK)
    loaded = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    print(f"{data.num_steps:,} steps in {data.num_episodes:,} episodes, {int(data.terminations.sum()):,} at the goal")
    print(f"imports {imported - started:.2f} s, loading {loaded - imported:.2f} s, peak {peak:.0f} MiB resident")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--file", type=Path)
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        return measure(arguments.file)
    with tempfile.TemporaryDirectory() as folder:
        path = arguments.file or Path(folder) / "antmaze.hdf5"
        if not path.is_file():
            make_file(path, arguments.rows)
        print(f"{path.stat().st_size / 1e6:.0f} MB on disk", flush=True)
        command = [sys.executable, os.path.abspath(__file__), "--measure", "--file", str(path)]
        subprocess.run(command, check=True)  # noqa: S603 - this very file, no shell
    return None


if __name__ == "__main__":
    main()
