"""From the cells of a study to pieces of work: each a node, named by the hash of its settings and of what it reads.

```
 data ─► skill ─► relabel ─► policy ─► evaluate      a cell is an evaluation
```

Two cells that need the same training have the same node, and it runs once: no rule says what may be shared.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

from datamodules.relabelling import Relabelling
from dds_lightning.configs import run_defaults
from dds_lightning.errors import UserError
from dds_lightning.grid.cells import BUDGETS, OURS, PLAYERS, Cell, Study, argument
from dds_lightning.grid.checks import check_stage, has_codes
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.tasks import facts_to_keep, get_task, is_own
from dds_lightning.training.options import GENERAL, options
from dds_lightning.training.stages import STAGES, preset_configs

FORMAT = 1
WATCHED = ("policy", "online")
"""Stages that can be evaluated while they train."""
WATCH_EPISODES = 10


@dataclass(frozen=True)
class Node:
    """One piece of work.

    Attributes:
        kind: `data`, `relabel`, `evaluate` or a stage.
        work: "package.file:function": (node's settings, how, what it reads, folder, resuming) to outputs and facts.
        settings: Everything that its result depends on beside what it reads; JSON values.
        reads: Role -> node whose outputs it uses.
        title: What a person reads while it runs.
        how: What the work needs and the result does not depend on.
    """

    kind: str
    work: str
    settings: Mapping[str, Any]
    reads: Mapping[str, Node]
    title: str = ""
    how: Mapping[str, Any] | None = None

    @cached_property
    def key(self) -> str:
        """Name of its folder."""
        reads = {role: node.key for role, node in self.reads.items()}
        text = json.dumps([FORMAT, self.kind, self.work, self.settings, reads], sort_keys=True, default=str)
        return f"{self.kind}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"

    def job(self, root: str) -> dict[str, Any]:
        """What a worker needs to do it, as JSON values."""
        reads = {role: node.key for role, node in self.reads.items()}
        job = {"root": root, "key": self.key, "kind": self.kind, "work": self.work, "title": self.title}
        return {**job, "settings": dict(self.settings), "how": dict(self.how or {}), "reads": reads}


def plan(study: Study) -> dict[str, tuple[Cell, Node]]:
    """Key of the evaluation -> cell and evaluation, in the order of the cells.

    Raises:
        UserError: Two cells are the same.
    """
    found: dict[str, tuple[Cell, Node]] = {}
    planner = _Planner(study)
    for cell in study.cells():
        node = planner.evaluate(cell)
        if node.key in found:
            first = found[node.key][0]
            raise UserError(
                f"two cells are the same, '{first.name()}' and '{cell.name()}': the setting by which they differ "
                "changes nothing (it has the preset's own value, or belongs to another method); leave one out"
            )
        found[node.key] = cell, node
    return found


def in_order(nodes: Iterable[Node]) -> dict[str, Node]:
    """The nodes and all that they read, each after what it reads."""
    ordered: dict[str, Node] = {}

    def visit(node: Node) -> None:
        if node.key not in ordered:
            for read in node.reads.values():
                visit(read)
            ordered[node.key] = node

    for node in nodes:
        visit(node)
    return ordered


class _Planner:
    """Makes the nodes of one study's cells."""

    def __init__(self, study: Study) -> None:
        self.study = study
        self._defaults: dict[tuple[str, str], dict[str, Any]] = {}
        self._files: str | None = None
        if study.data is not None:
            from datamodules.sources.stat_hash import stat_hash

            self._files = stat_hash(study.data)

    def evaluate(self, cell: Cell) -> Node:
        """The evaluation that is a cell."""
        asked, stages = _of(cell.settings, "evaluate"), self._stages(cell)
        made: dict[str, Node] = {"data": self._data(cell)}
        for stage in stages:
            made[stage] = self._train(cell, stage, made)
        self._check_acting(cell, made, asked)
        episodes = self._scaled(asked.get("episodes") or get_task(cell.task).evaluation_episodes)
        settings = {**self._task(cell), "method": cell.method, "seed": cell.seed, **self._acting(cell)}
        settings["episodes"] = episodes
        return Node(
            "evaluate",
            "dds_lightning.grid.work:evaluate",
            settings,
            {stage: made[stage] for stage in stages},
            f"evaluate {cell.name()}",
        )

    def _check_acting(self, cell: Cell, made: Mapping[str, Node], asked: Mapping[str, Any]) -> None:
        """Refuse settings of acting with which the evaluation would fail.

        Raises:
            UserError: The agent has no skills, or no codes, or its skills do not last so long.
        """
        of_skills, title = sorted(asked.keys() - {"episodes"}), PLAYERS[cell.method].title
        if of_skills and "skill" not in made:
            raise UserError(f"evaluate.{of_skills[0]} is for agents over skills, and {title} has none: leave it out")
        if asked.get("selection") == "argmax_q" and not has_codes(made["skill"].settings):
            raise UserError(
                f"evaluate.selection is argmax_q, which needs codes, and the skills of {title} are continuous"
            )
        horizon = made["skill"].settings["data.horizon"] if "skill" in made else 0
        if asked.get("hold", 0) > horizon:
            raise UserError(f"evaluate.hold is {asked['hold']}, expected at most {horizon}, the steps that skills last")

    def _stages(self, cell: Cell) -> tuple[str, ...]:
        """What the cell trains; learning online over raw actions takes no skills."""
        stages = PLAYERS[cell.method].stages
        if "online" not in stages:
            return stages
        actions = {**self._preset(cell, "online")[0], **_of(cell.settings, "online")}["data.actions"]
        return tuple(stage for stage in stages if stage != "skill" or actions != "raw")

    def _acting(self, cell: Cell) -> dict[str, Any]:
        """How the agent acts: what was asked for, else the preset's choice where there are skills to choose."""
        run = run_defaults(self.study.preset or get_task(cell.task).family)
        skilled = "skill" in self._stages(cell)
        usual = {name: run[name] for name in ("selection", "temperature", "noise_scale")} if skilled else {}
        chosen = {**usual, **_of(cell.settings, "evaluate")}
        return {name: value for name, value in chosen.items() if value is not None and name != "episodes"}

    def _task(self, cell: Cell) -> dict[str, Any]:
        """The task in the variant in which given data were recorded, and the definition of one's own."""
        task = get_task(cell.task)
        if self.study.data is not None:
            from datamodules.sources import resolve_task

            task = resolve_task(self.study.data, task)
        return {**facts_to_keep(task), "task": cell.task if is_own(task) else task.name}

    def _data(self, cell: Cell) -> Node:
        study, task = self.study, get_task(cell.task)
        settings = self._task(cell)
        if study.data is not None:
            settings |= {"data": study.data, "files": self._files}
            return Node("data", "dds_lightning.grid.work:look_at_data", settings, {}, f"data {study.data}")
        asked = _of(cell.settings, "data")
        steps = self._scaled(asked.get("steps", run_defaults(study.preset or task.family)["data_steps"]))
        settings |= {"steps": steps, "seed": asked.get("seed", 0)}
        return Node("data", "dds_lightning.grid.work:collect_data", settings, {}, f"data {task.name}, {steps:,} steps")

    def _train(self, cell: Cell, stage: str, made: Mapping[str, Node]) -> Node:
        study, row = self.study, STAGES[stage]
        preset, config = self._preset(cell, stage)
        asked = {**PLAYERS[cell.method].settings.get(stage, {}), **_of(cell.settings, stage)}
        given = {key: float(value) if _whole(value, preset.get(key)) else value for key, value in asked.items()}
        settings = {**preset, **given}
        for name in BUDGETS:
            if isinstance(settings.get(name), int | float) and settings[name] > 0 and study.scale != 1:
                settings[name] = given[name] = self._scaled(settings[name])
        if any(key.startswith((f"{stage}.model.", f"{stage}.data.")) for key in cell.settings):
            skill = made["skill"].settings if "skill" in made else {}
            check_stage(stage, settings, cell.task, skill)
        reads = {"data": made["data"], **{name: made[name] for name in row.reads if name in made}}
        how: dict[str, Any] = {"config": config, "given": {k: v for k, v in given.items() if preset.get(k) != v}}
        if study.watch and stage == PLAYERS[cell.method].stages[-1] and stage in WATCHED:
            steps = int(settings["trainer.max_steps"])
            settings["watch"] = {"every": max(1, steps // study.watch), "episodes": WATCH_EPISODES}
            settings["watch"] |= self._acting(cell)
        if row.data == STAGES["policy"].data:
            own = {one.name: settings[f"data.{one.name}"] for one in fields(Relabelling)}
            own |= self._task(cell)
            reads["relabel"] = Node(
                "relabel", "dds_lightning.grid.work:relabel", own, dict(reads), self._title(cell, "relabel")
            )
        settings = {key: value for key, value in settings.items() if key not in row.added or value != row.added[key]}
        settings |= {"revision": row.revision} if row.revision else {}
        settings |= {**self._task(cell), "seed": cell.seed, "stage": stage}
        return Node(stage, "dds_lightning.grid.work:train", settings, reads, self._title(cell, stage), how)

    def _title(self, cell: Cell, kind: str) -> str:
        """What a person reads while a training or its relabelling runs: what it depends on, for cells may share it."""
        method = PLAYERS[cell.method]
        last = kind == method.stages[-1]
        stages = ("skill", "policy.data") if kind == "relabel" else method.stages[: method.stages.index(kind) + 1]
        begin = tuple(f"{room}." for room in ("data", *stages))
        place: dict[str, Any] = {} if last else dict(method.settings.get(kind, {}))
        for axis, value in cell.place.items():
            keys = self.study.variants.get(value, {}) if axis == "variant" else (axis,)
            if any(key.startswith(begin) for key in keys):
                place[axis] = value
        return f"{kind} {replace(cell, place=place).name(method=last)}"

    def _preset(self, cell: Cell, stage: str) -> tuple[dict[str, Any], str | None]:
        """All settings of a stage as its preset leaves them, defaults included, and the preset's file."""
        name = self.study.preset or get_task(cell.task).family
        config = preset_configs(name)[stage]
        if (name, stage) not in self._defaults:
            known = options(STAGES[stage])
            ours = {*OURS, *STAGES[stage].reads.values(), *GENERAL} - {"precision"}
            settings = {
                key: one.default for key, one in known.items() if key not in ours and not key.startswith("trainer.")
            }
            settings |= {"trainer.max_steps": STAGES[stage].steps}
            chosen = dict(_flat(read_yaml(config))) if config else {}
            chosen = {key: value for key, value in chosen.items() if key not in ours}
            self._defaults[name, stage] = json.loads(json.dumps({**settings, **chosen}, default=str))
        return self._defaults[name, stage], str(config) if config else None

    def _scaled(self, value: float) -> int:
        return max(2, round(value * self.study.scale)) if self.study.scale != 1 else int(value)


def arguments(stage: str, how: Mapping[str, Any], seed: int) -> list[str]:
    """What follows `dds STAGE` for a training, places apart."""
    words = ["fit", *(["--config", how["config"]] if how.get("config") else []), f"--seed_everything={seed}"]
    return [*words, *(argument(name, value) for name, value in how.get("given", {}).items())]


def needed(nodes: Mapping[str, Node], done: set[str]) -> dict[str, Node]:
    """The nodes that are to be done: not done themselves, and read by one that is to be done or a cell.

    Args:
        nodes: Of all cells, as `in_order` gives them.
        done: Keys of the finished ones.
    """
    read = {inner.key for node in nodes.values() for inner in node.reads.values()}
    wanted = {key for key in nodes if key not in read}
    for key in reversed(list(nodes)):
        if key in wanted and key not in done:
            wanted |= {inner.key for inner in nodes[key].reads.values()}
    return {key: node for key, node in nodes.items() if key in wanted - done}


def _whole(value: Any, usual: Any) -> bool:
    """Whether it is written without its decimals, 3 for 3.0: the same training."""
    return isinstance(value, int) and not isinstance(value, bool) and isinstance(usual, float)


def _of(settings: Mapping[str, Any], room: str) -> dict[str, Any]:
    """Settings that begin with `room.`, without it."""
    return {key.partition(".")[2]: value for key, value in settings.items() if key.partition(".")[0] == room}


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Groups of a configuration as dotted names; what is inside a setting stays there."""
    for group, inner in settings.items():
        if isinstance(inner, dict):
            yield from ((f"{group}.{key}", value) for key, value in inner.items())
        else:
            yield group, inner
