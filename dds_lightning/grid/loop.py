"""Do the nodes of a study on an engine, each after what it reads, and tell how far it is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import Any

from dds_lightning.grid.engines import Engine
from dds_lightning.grid.nodes import Node
from dds_lightning.saving.run_directory import duration


@dataclass
class Progress:
    """What has been done, and how long the rest may take.

    Attributes:
        total: Jobs in all.
        slots: Jobs at once.
        past: Kind -> seconds of each finished job, those of earlier launches included.
        failed: Key -> why.
        done: Number of jobs that have ended, well or not.
    """

    total: int
    slots: int
    past: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    failed: dict[str, str] = field(default_factory=dict)
    done: int = 0

    def left(self, open_nodes: Mapping[str, Node]) -> float | None:
        """Seconds that are left; None while some kind of job has never been done."""
        if any(not self.past[node.kind] for node in open_nodes.values()):
            return None
        means = {kind: sum(seconds) / len(seconds) for kind, seconds in self.past.items() if seconds}
        return sum(means[node.kind] for node in open_nodes.values()) / max(1, min(self.slots, len(open_nodes)))


def run_nodes(
    nodes: Mapping[str, Node], root: str, engine: Engine, progress: Progress, tell: Callable[[str], None]
) -> dict[str, str]:
    """Do nodes; one that fails keeps only those back that read it.

    Args:
        nodes: To be done, each after what it reads; what they read beside is done already.
        root: Folder of the study.
        engine: Does the jobs.
        progress: Is kept up to date.
        tell: Takes one line for each job that has ended.

    Returns:
        Key -> why it failed.
    """
    open_nodes, running = dict(nodes), dict[Future[dict[str, Any]], str]()
    waiting = {key: {read.key for read in node.reads.values()} & nodes.keys() for key, node in nodes.items()}
    while open_nodes:
        busy = set(running.values())
        ready = [key for key in open_nodes if key not in busy and not waiting[key]]
        for key in ready[: max(0, engine.slots - len(running))]:
            running[engine.submit(nodes[key].job(root))] = key
        ended, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in ended:
            key = running.pop(future)
            answer = _answer(future)
            for gone, why in _outcome(key, answer["error"], waiting, nodes, open_nodes).items():
                del open_nodes[gone]
                progress.done += 1
                if why is not None:
                    progress.failed[gone] = why
            if answer["error"] is None:
                progress.past[nodes[key].kind].append(answer["seconds"])
            tell(_line(nodes[key], answer, progress, open_nodes))
    return progress.failed


def _outcome(
    key: str, error: str | None, waiting: dict[str, set[str]], nodes: Mapping[str, Node], open_nodes: Mapping[str, Node]
) -> dict[str, str | None]:
    """The nodes that are over with this one, and why; None for one that went well."""
    if error is None:
        for reads in waiting.values():
            reads.discard(key)
        return {key: None}
    over: dict[str, str | None] = {key: error}
    for other in open_nodes:  # in order: those further down come later
        if other not in over and waiting[other] & over.keys():
            over[other] = f"not done because '{nodes[key].title}' failed"
    return over


def _answer(future: Future[dict[str, Any]]) -> dict[str, Any]:
    error = future.exception()
    if error is not None:
        return {"seconds": 0.0, "error": f"{type(error).__name__}: {' '.join(str(error).split())[-300:]}"}
    return future.result()


def _line(node: Node, answer: Mapping[str, Any], progress: Progress, open_nodes: Mapping[str, Node]) -> str:
    left = progress.left(open_nodes)
    rest = "" if not open_nodes else f"; about {duration(left)} left" if left is not None else ""
    said = f"failed: {answer['error']}" if answer["error"] else duration(answer["seconds"])
    return f"[{progress.done}/{progress.total}] {node.title}: {said}{rest}"
