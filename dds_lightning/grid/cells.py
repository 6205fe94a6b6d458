"""The cells of a study: what a study file says, checked, and what it spans."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from dds_lightning.baselines.methods import METHODS, Method

ONLINE = Method(
    "online", "DDS, online", "Discrete diffusion skills, section 5.3", ("skill", "online"), METHODS["dds"].actor
)
PLAYERS: dict[str, Method] = {**METHODS, ONLINE.name: ONLINE}
"""What `methods` may name; `all` are the offline ones."""
BASE = "base"
"""The variant without a departure."""
OURS = (
    *("data.task", "data.data", "data.skill", "data.relabelled", "data.cache", "data.seed", "ckpt_path", "config"),
    *("seed_everything", "trainer.default_root_dir", "checkpoint.dirpath", "print_config", "json"),
)
"""Settings of a stage that the study sets itself."""
BUDGETS = (
    "trainer.max_steps",
    "trainer.val_check_interval",
    "model.prior_steps",
    "model.critic_steps",  # a critic that never stops would leave the actor no step
    "model.freeze_codes_after",
    "model.warmup_steps",
    "model.actor_ema_start",
    "stop.min_steps",
    "stop.decay",
)
"""Settings of a stage that `--scale` multiplies."""


@dataclass(frozen=True)
class Cell:
    """One number of a study.

    Attributes:
        task: Name of the task.
        method: Name of the method.
        seed: Of the trainings and of the evaluation.
        place: Where it stands in the grid: axis -> value, and `variant`.
        settings: What was asked of it: STAGE.KEY -> value.
    """

    task: str
    method: str
    seed: int
    place: Mapping[str, Any]
    settings: Mapping[str, Any]

    def name(self, method: bool = True) -> str:
        """In words, for people; with its method or without."""
        departures = ((axis, value) for axis, value in self.place.items() if (axis, value) != ("variant", BASE))
        chosen = [f"{axis.rpartition('.')[2]} {shown(value)}" for axis, value in departures]
        title = [PLAYERS[self.method].title] if method else []
        return ", ".join([self.task, *title, *chosen, f"seed {self.seed}"])


@dataclass(frozen=True)
class Study:
    """A checked study file; see this file's head for the keys.

    Attributes:
        data: Where the data are; None collects them, once for all seeds.
        task_settings: Task -> settings of its cells.
        watch: Evaluations while the last stage trains, from which its best checkpoint is chosen; 0 for none.
        rows: Coordinates that name a row of the report's table: axes, `task`, `method` or `variant`.
        columns: Likewise.
        labels: Axis, variant, method or value -> what the report calls it.
        paper: Which of the paper's tables or figures it is set beside.
        reference: Variant or method with which the others are compared.
        scale: Factor on all budgets.
    """

    title: str
    tasks: tuple[str, ...]
    methods: tuple[str, ...] = ("dds",)
    seeds: tuple[int, ...] = (0,)
    question: str = ""
    data: str | None = None
    preset: str | None = None
    budget: float | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    task_settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    grid: Mapping[str, list[Any]] = field(default_factory=dict)
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    watch: int = 0
    rows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)
    paper: str = ""
    reference: str | None = None
    scale: float = 1.0

    def cells(self) -> Iterator[Cell]:
        """All cells, seeds last, so that the first results of every setting come early."""
        variants = {BASE: {}, **self.variants} if self.variants else {"": {}}
        combinations = [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]
        for seed, task, method, chosen in itertools.product(self.seeds, self.tasks, self.methods, combinations):
            for variant, departure in variants.items():
                place = {**chosen, **({"variant": variant} if variant else {})}
                common = {**self.settings, **self.task_settings.get(task, {})}
                yield Cell(task, method, seed, place, {**common, **chosen, **departure})

    def coordinates(self) -> list[str]:
        """Everything by which two cells may differ, beside the seed."""
        more = ["variant"] if self.variants else []
        return [
            *(["task"] if len(self.tasks) > 1 else []),
            *(["method"] if len(self.methods) > 1 else []),
            *self.grid,
            *more,
        ]


def counted(count: int, noun: str) -> str:
    """`1 cell`, `2 cells`."""
    return f"{count} {noun}" + "s" * (count != 1)


def shown(value: Any) -> str:
    """A value of a setting, as a study file may say it: `5`, `0.5`, `gru`, `[64, 64]`, `null`."""
    if isinstance(value, float):
        return f"{value:g}"
    return json.dumps(value) if value is None or isinstance(value, bool | list | dict) else str(value)


def label(labels: Mapping[str, str], name: Any) -> str:
    """What a report calls an axis or a value: the file's label, a method's title, else the name itself."""
    text = shown(name)
    return str(labels.get(text, PLAYERS[text].title if text in PLAYERS else text))


def argument(name: str, value: Any) -> str:
    """The argument of `dds STAGE fit` for a setting."""
    return f"--{name}={value if isinstance(value, str) else json.dumps(value)}"
