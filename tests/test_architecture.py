"""The plan of the house, held against the code: which room may import which, no circle, no file too long."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGES = ("dds_lightning", "datamodules")
LONGEST = 350

EXCEPTIONS = {
    "too long": {"dds_lightning/policy.py", "dds_lightning/skill.py", "dds_lightning/training/stage_cli.py"},
}
"""What does not keep the plan yet; this list may only shrink."""


class Arrow(NamedTuple):
    """One file imports another."""

    source: str
    target: str
    typing_only: bool


def module_of(path: Path) -> str:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


FILES = {module_of(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def targets_of(node: ast.Import | ast.ImportFrom) -> Iterator[str]:
    """The files that a statement imports: `from room import file` means the file, and a name the room's face."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    else:
        assert node.level == 0, "imports are absolute here"
        for alias in node.names:
            inner = f"{node.module}.{alias.name}"
            yield inner if inner in FILES else str(node.module)


def arrows_of(module: str) -> Iterator[Arrow]:
    tree = ast.parse(FILES[module].read_text(encoding="utf-8"))
    guarded = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for target in targets_of(node):
                if target in FILES and target != module:
                    yield Arrow(module, target, node in guarded)


ARROWS = [arrow for module in FILES for arrow in arrows_of(module)]


def room_of(module: str) -> str:
    """A folder; in `interpret` and `behaviours` the folders inside; a flat file is a room of its own."""
    parts = module.split(".")
    if len(parts) > 2 and (inner := ".".join(parts[:3])) in FILES and FILES[inner].name == "__init__.py":
        return inner
    return ".".join(parts[:2])


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected parts of more than one node (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            part = [stack.pop()]
            while part[-1] != node:
                part.append(stack.pop())
            if len(part) > 1:
                found.append(sorted(part))

    for node in list(graph):
        if node not in index:
            visit(node)
    return found


def graph_of(arrows: list[tuple[str, str]]) -> dict[str, set[str]]:
    graph: dict[str, set[str]] = {}
    for source, target in arrows:
        if source != target:
            graph.setdefault(source, set()).add(target)
    return graph
