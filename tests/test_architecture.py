"""The plan of the house, held against the code: which room may import which, no circle, no file too long."""

import ast
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from dds_lightning._moved import MOVED

ROOT = Path(__file__).parents[1]
PACKAGES = ("dds_lightning", "datamodules")
LONGEST = 350

ROOMS = {
    # from the ground up: a room may import those of its row, which all stand above it in this table
    "dds_lightning._moved": "",
    "dds_lightning._version": "",
    "dds_lightning.errors": "",
    "dds_lightning.losses": "",
    "dds_lightning.saving": "_version errors",
    "dds_lightning.configs": "errors saving",
    "dds_lightning.console": "errors",
    "dds_lightning.nn": "errors losses",
    "dds_lightning.envs": "errors",
    "dds_lightning.tasks": "envs errors saving",
    # the method, to be read in this order
    "dds_lightning.finetune": "errors saving",
    "dds_lightning.module": "errors finetune nn saving",
    "dds_lightning.skill": "errors module nn saving",
    "dds_lightning.policy": "errors losses module nn",
    "dds_lightning.online": "envs errors losses module nn policy saving skill",
    "dds_lightning.agent": "envs errors online policy saving skill",
    "dds_lightning.rollout": "console errors envs saving tasks",
    # the data
    "datamodules.validation": "errors",
    "datamodules.windows": "datamodules.validation",
    "datamodules.storage": "errors saving datamodules.validation",
    "datamodules.trajectories": "datamodules.storage datamodules.validation datamodules.windows tasks",
    "datamodules.loader": "errors",
    "datamodules.sources": "console envs errors saving tasks datamodules.trajectories datamodules.validation "
    "datamodules.windows datamodules.storage",
    "datamodules.physics": "errors tasks datamodules.sources datamodules.validation datamodules.trajectories envs",
    "datamodules.behaviours": "errors saving datamodules.validation",
    "datamodules.collect": "console envs errors rollout saving tasks datamodules.behaviours datamodules.storage",
    "datamodules.behaviours.training": "console envs errors rollout saving tasks datamodules.behaviours "
    "datamodules.collect",
    "datamodules.inspection": "tasks datamodules.sources datamodules.trajectories",
    "datamodules.listing": "errors tasks datamodules.sources datamodules.storage datamodules.trajectories",
    "datamodules.partial_codes": "errors saving",
    "datamodules.relabelling": "envs errors tasks",
    "datamodules.robots": "errors saving skill tasks",
    "datamodules.semi_mdp": "errors saving",
    "datamodules.relabel": "console envs errors skill datamodules.partial_codes datamodules.relabelling "
    "datamodules.semi_mdp datamodules.trajectories",
    "datamodules.segments": "errors nn tasks datamodules.collect datamodules.loader datamodules.sources "
    "datamodules.trajectories",
    "datamodules.relabelled": "errors nn saving skill tasks datamodules.loader datamodules.partial_codes "
    "datamodules.relabel datamodules.relabelling datamodules.robots datamodules.semi_mdp datamodules.sources "
    "datamodules.trajectories",
    "datamodules.transitions": "envs errors skill datamodules.loader datamodules.relabel datamodules.relabelling "
    "datamodules.segments",
    "datamodules.online_batches": "errors online",
    "datamodules.online": "errors online skill tasks datamodules.loader datamodules.online_batches "
    "datamodules.relabelled datamodules.relabelling datamodules.robots datamodules.semi_mdp",
    # training
    "dds_lightning.callbacks": "agent console envs errors module online policy rollout skill tasks",
    "dds_lightning.training": "callbacks configs console errors finetune module nn saving tasks",
    "dds_lightning.baselines": "agent errors losses module nn online policy rollout saving skill tasks training",
    # what came of it
    "dds_lightning.interpret.views": "errors tasks",
    "dds_lightning.interpret.measure": "envs errors interpret.views tasks datamodules.physics datamodules.relabel "
    "datamodules.semi_mdp datamodules.trajectories",
    "dds_lightning.interpret.draw": "envs errors interpret.measure interpret.views rollout saving tasks "
    "datamodules.inspection datamodules.trajectories",
    "dds_lightning.interpret.atlas": "interpret.draw interpret.measure interpret.views rollout saving tasks "
    "datamodules.trajectories",
    "dds_lightning.study": "agent callbacks configs console errors interpret.atlas interpret.draw interpret.measure "
    "online policy rollout saving skill tasks datamodules.collect datamodules.relabel datamodules.relabelling "
    "datamodules.sources",
    "dds_lightning.sharing": "agent errors saving tasks training",
    "dds_lightning.pipeline": "agent baselines configs console envs errors interpret.draw online policy rollout saving "
    "skill study tasks training datamodules.collect datamodules.inspection datamodules.relabelled "
    "datamodules.relabelling datamodules.semi_mdp datamodules.sources",
    "dds_lightning.grid": "agent baselines configs console envs errors online rollout saving skill study tasks "
    "training datamodules.collect datamodules.relabelled datamodules.relabelling datamodules.sources",
    "dds_lightning.cli": "_version agent baselines configs console errors grid interpret.draw online pipeline policy "
    "rollout saving sharing skill study tasks training datamodules.collect datamodules.inspection datamodules.listing "
    "datamodules.physics datamodules.relabelled datamodules.relabelling datamodules.semi_mdp datamodules.sources",
    "dds_lightning.__main__": "cli",
}
"""Room -> those it may import, apart from itself; `dds_lightning.` is left out in the second column."""

TYPES = {
    "dds_lightning.envs": "tasks",
    "dds_lightning.finetune": "module",
    "dds_lightning.rollout": "agent",
    "dds_lightning.interpret.measure": "agent policy skill rollout",
    "dds_lightning.interpret.draw": "agent policy skill",
    "dds_lightning.interpret.atlas": "agent skill",
    "dds_lightning.study": "baselines policy datamodules.relabelled datamodules.trajectories",
    "datamodules.relabelling": "datamodules.trajectories",
    "dds_lightning.cli": "datamodules.trajectories",
}
"""The same for imports that only a type checker makes."""

EXCEPTIONS: dict[str, set[str]] = {}
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
    if module in ROOMS:
        return module
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


RUNTIME = [(arrow.source, arrow.target) for arrow in ARROWS if not arrow.typing_only]


def allowed(table: dict[str, str]) -> dict[str, set[str]]:
    return {
        room: {name if name.startswith("datamodules") else f"dds_lightning.{name}" for name in names.split()}
        for room, names in table.items()
    }


def test_no_files_import_each_other_in_a_circle():
    assert circles(graph_of(RUNTIME)) == []


def test_no_rooms_import_each_other_in_a_circle():
    assert circles(graph_of([(room_of(source), room_of(target)) for source, target in RUNTIME])) == []


def test_the_plan_leads_from_the_ground_up():
    above: set[str] = set()
    for room, below in allowed(ROOMS).items():
        assert below <= above, f"{room} may import {', '.join(below - above)}, which the plan has further down"
        above.add(room)


def test_rooms_import_only_what_the_plan_allows():
    plan, typing = allowed(ROOMS), allowed(TYPES)
    for arrow in ARROWS:
        source, target = room_of(arrow.source), room_of(arrow.target)
        may = plan.get(source, set()) | (typing.get(source, set()) if arrow.typing_only else set())
        known = source in PACKAGES or target == source or target in may
        assert known, f"{arrow.source} imports {arrow.target}: {source} may not import {target}"


@pytest.mark.parametrize("package", PACKAGES)
def test_nothing_imports_the_face_of_a_package(package):
    assert [arrow.source for arrow in ARROWS if arrow.target == package] == []


def test_no_file_is_longer_than_one_sitting():
    long = {
        str(path.relative_to(ROOT))
        for folder in (*PACKAGES, "benchmarks", "notebooks")
        for path in (ROOT / folder).rglob("*.py")
        if len(path.read_text(encoding="utf-8").splitlines()) > LONGEST and not path.name[0].isdigit()
    }
    assert long == EXCEPTIONS.get("too long", set())


def test_few_files_lie_flat():
    assert len(list((ROOT / "dds_lightning").glob("*.py"))) <= 11


@pytest.mark.parametrize(("old", "new"), MOVED.items())
def test_import_paths_of_earlier_versions_give_the_file_of_today(old, new):
    if new == "datamodules.behaviours.training.train":
        pytest.importorskip("stable_baselines3")  # it trains; the other files of the room do without
    sys.modules.pop(old, None)
    with pytest.warns(DeprecationWarning, match=f"{old} has moved to {new}"):
        assert importlib.import_module(old) is importlib.import_module(new)
