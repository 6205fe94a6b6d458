"""Toy work for the nodes of a study: it says in a file how often it was done."""

import os
import time
from pathlib import Path

from dds_lightning.grid.nodes import Node


def sleep(settings, how, reads, folder, resuming):
    """Count up to `seconds`, a tenth at a time; what was counted survives a kill, as a checkpoint does."""
    state = folder / "state.txt"
    begun = int(state.read_text() or 0) if resuming and state.exists() else 0
    for tenth in range(begun, round(10 * settings["seconds"])):
        time.sleep(0.1)
        state.write_text(str(tenth + 1))
    if settings.get("fails"):
        raise ValueError(f"cell {settings['index']} cannot work")
    if settings.get("dies") and not resuming:
        os._exit(9)
    (folder / "out.txt").write_text(str(settings["index"]))
    with (Path(how["count"])).open("a") as file:
        file.write(f"{settings['index']} {begun}\n")
    return {
        "out": folder / "out.txt",
        "read": sorted(done.facts.get("index", -1) for done in reads.values()),
        "index": settings["index"],
    }


def toy_node(index, count, seconds=0.0, reads=(), kind="toy", **settings):
    """A node that sleeps, and notes in the file `count` that it was done."""
    chosen = {"index": index, "seconds": seconds, **settings}
    names = {f"read{place}": node for place, node in enumerate(reads)}
    return Node(kind, "tests.grid.toy:sleep", chosen, names, f"{kind} {index}", {"count": str(count)})


def counted(count):
    """Index of each time that some work was finished."""
    return [int(line.split()[0]) for line in Path(count).read_text().splitlines()] if Path(count).exists() else []
