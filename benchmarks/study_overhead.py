"""How much time does `dds study run` lose beside the work itself?

    python benchmarks/study_overhead.py --cells 200 --seconds 1 --workers 2

Runs cells that sleep, each a job of its own with a folder, a marker and hashes, on the local engine. Prints the wall
time, the time that the same sleeping takes on as many workers, and the overhead in per cent; the start of the workers
counts as overhead. Exit status 1 if it is 15 % or more. The jobs are those of `tests/grid/toy.py`.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from dds_lightning.grid.engines import Local
from dds_lightning.grid.loop import Progress, run_nodes
from tests.grid.toy import counted, toy_node


def main() -> int:
    """Measure, print, and say whether it is little."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        nodes = [toy_node(index, root / "count", asked.seconds) for index in range(asked.cells)]
        begun, engine = time.perf_counter(), Local(asked.workers)
        failed = run_nodes(
            {node.key: node for node in nodes}, folder, engine, Progress(asked.cells, asked.workers), lambda line: None
        )
        spent = time.perf_counter() - begun
        engine.close()
        done = len(counted(root / "count"))
    least = -(-asked.cells // asked.workers) * asked.seconds
    overhead = 100 * (spent / least - 1)
    print(f"{done} cells of {asked.seconds:g} s on {asked.workers} workers: {spent:.1f} s, at least {least:.1f} s")
    print(f"overhead {overhead:.1f} %, {len(failed)} failed")
    return int(overhead >= 15 or done != asked.cells)


if __name__ == "__main__":
    sys.exit(main())
