"""A study file: a grid over tasks, methods, settings and seeds, read and checked before anything runs.

```yaml
title: Number of skills and their dimension
question: Does K matter?
tasks: [pointmaze-large]
seeds: [0, 1, 2]
budget: 240                                  # core-minutes that the whole study may take; told, not enforced
settings: {skill.trainer.max_steps: 2500}    # of every cell, STAGE.KEY as in `dds STAGE fit --KEY`
task_settings:                               # of every cell of one task
  pointmaze-large: {policy.trainer.max_steps: 4000}
grid:                                        # every combination
  skill.model.num_skills: [4, 16]
variants:                                    # or named departures, one at a time
  paper's start: {skill.model.codebook_init: uniform}
```

Beside stages, `data.steps`, `data.seed` and `evaluate.KEY` (`EVALUATE`) are settings.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dds_lightning.baselines.methods import METHODS, Method
from dds_lightning.configs import ROOT, run_defaults
from dds_lightning.console.refusals import did_you_mean
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.tasks import get_task
from dds_lightning.training.options import options
from dds_lightning.training.stages import STAGES
from dds_lightning.training.typos import refuse_typos

ONLINE = Method(
    "online", "DDS, online", "Discrete diffusion skills, section 5.3", ("skill", "online"), METHODS["dds"].actor
)
PLAYERS: dict[str, Method] = {**METHODS, ONLINE.name: ONLINE}
"""What `methods` may name; `all` are the offline ones."""
BASE = "base"
"""The variant without a departure."""
EVALUATE: dict[str, Any] = {
    "episodes": None,  # the task's
    "selection": None,  # the preset's, as for the next two
    "temperature": None,
    "noise_scale": None,
    "hold": None,
}
"""Settings of the evaluation, `evaluate.KEY`."""
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
_KEYS: dict[str, tuple[type, ...]] = {
    **{"title": (str,), "question": (str,), "tasks": (list,), "methods": (list, str), "seeds": (list,), "data": (str,)},
    **{"preset": (str,), "budget": (int, float), "settings": (dict,), "task_settings": (dict,), "grid": (dict,)},
    **{
        "variants": (dict,),
        "watch": (int,),
        "rows": (list,),
        "columns": (list,),
        "labels": (dict,),
        "paper": (str,),
        "reference": (str,),
    },
}


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

    def name(self) -> str:
        """In words, for people."""
        chosen = [f"{axis.rpartition('.')[2]} {value}" for axis, value in self.place.items() if value != BASE]
        return ", ".join([self.task, PLAYERS[self.method].title, *chosen, f"seed {self.seed}"])


@dataclass(frozen=True)
class Study:
    """A checked study file; see this file's head for the keys.

    Attributes:
        data: Where the data are; None collects them, once for all seeds.
        task_settings: Task -> settings of its cells.
        watch: Evaluations while the last stage trains, from which its best checkpoint is chosen; 0 for none.
        rows: Coordinates that name a row of the report's table: axes, `task`, `method` or `variant`.
        columns: Likewise.
        labels: Axis -> what the report calls it.
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


def packaged_studies() -> list[str]:
    """Names of the packaged study files."""
    return sorted(path.stem for path in (ROOT / "studies").glob("*.yaml"))


def find_study(name: str) -> Path:
    """Find a study file: the user's, or else a packaged one by its name.

    Raises:
        UserError: There is neither.
    """
    for path in (Path(name), ROOT / "studies" / f"{Path(name).stem}.yaml"):
        if path.is_file():
            return path
    known = packaged_studies()
    near = did_you_mean(name, known) or f", and the packaged ones are {', '.join(known)}"
    raise UserError(f"study: there is no file {name}{near}")


def read_study(path: Path, scale: float = 1.0) -> Study:
    """Read and check a study file.

    Args:
        path: YAML.
        scale: Factor on all budgets.

    Raises:
        UserError: Names the first thing that is wrong, before anything runs.
    """
    if not 0 < scale < float("inf"):
        raise UserError(f"--scale is {scale}, expected more than 0; 0.01 tries a study with a hundredth of its budgets")
    found = read_yaml(path)
    if not isinstance(found, dict):
        raise UserError(f"{path} is not a mapping, expected {', '.join(_KEYS)}")
    for key, value in found.items():
        if key not in _KEYS:
            near = did_you_mean(str(key), _KEYS) or f", expected some of {', '.join(_KEYS)}"
            raise UserError(f"{path}: {key} is no setting of a study{near}")
        if not isinstance(value, _KEYS[key]) or isinstance(value, bool):
            raise UserError(f"{path}: {key} is {value!r}, expected a {_KEYS[key][0].__name__}")
    for key in ("title", "tasks"):
        if not found.get(key):
            raise UserError(f"{path}: {key} is missing or empty")
    if isinstance(methods := found.get("methods"), str):
        found["methods"] = list(METHODS) if methods == "all" else [methods]
    lists: dict[str, Any] = {
        key: tuple(found.pop(key)) for key in ("tasks", "methods", "seeds", "rows", "columns") if key in found
    }
    numbers: dict[str, Any] = {
        key: _numbers(found.pop(key)) for key in ("settings", "task_settings", "grid", "variants") if key in found
    }
    study = Study(**found, **lists, **numbers, scale=scale)
    try:
        _check(study)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return study


def _check(study: Study) -> None:
    """Refuse what cannot work.

    Raises:
        UserError: Names the first.
    """
    for name, values in (
        ("tasks", study.tasks),
        ("methods", study.methods),
        ("seeds", study.seeds),
        *study.grid.items(),
    ):
        if not isinstance(values, list | tuple) or not values:
            raise UserError(f"{name} is {values!r}, expected a list of one or more: the grid would be empty")
        if twice := [value for index, value in enumerate(values) if value in values[:index]]:
            raise UserError(f"{name} holds {twice[0]!r} twice: the same cells would run twice")
    for seed in study.seeds:
        if not isinstance(seed, int) or isinstance(seed, bool):
            raise UserError(f"seeds holds {seed!r}, expected whole numbers")
        refuse_seed("seeds", seed)
    for method in study.methods:
        if method not in PLAYERS:
            near = did_you_mean(str(method), PLAYERS) or f", expected some of {', '.join(PLAYERS)}, or all"
            raise UserError(f"methods: there is no method {method}{near}")
    for name in study.tasks:
        task = get_task(name)
        if study.data is None:
            from datamodules.collect.collectors import refuse_uncollectable

            refuse_uncollectable(task)
        run_defaults(study.preset or task.family)
    if study.data is not None and len(study.tasks) > 1:
        raise UserError(
            f"data is {study.data} for {len(study.tasks)} tasks, expected one task, or none to collect data"
        )
    for name, given in study.task_settings.items():
        if name not in study.tasks:
            near = did_you_mean(str(name), study.tasks) or f", expected some of {', '.join(study.tasks)}"
            raise UserError(f"task_settings: {name} is no task of this study{near}")
        if not isinstance(given, dict) or not given:
            raise UserError(f"task_settings: {name} is {given!r}, expected settings, STAGE.KEY: value")
    if study.watch < 0:
        raise UserError(f"watch is {study.watch}, expected 0 (no evaluation while training) or more")
    for name, departure in study.variants.items():
        if not isinstance(departure, dict) or not departure or name == BASE:
            raise UserError(
                f"variants: {name} is {departure!r}, expected settings; {BASE} is there without being named"
            )
    trained = {stage for method in study.methods for stage in PLAYERS[method].stages}
    for key, values in _asked(study).items():
        for value in values:
            _check_setting(key, value, trained)
    for name, listed in (("rows", study.rows), ("columns", study.columns)):
        for one in listed:
            if one not in (known := ["task", "method", *study.grid, *(["variant"] if study.variants else [])]):
                near = did_you_mean(str(one), known) or f", expected some of {', '.join(known)}"
                raise UserError(f"{name} names {one}, which the study has not{near}")


def _asked(study: Study) -> dict[str, list[Any]]:
    """Every setting that some cell is given, with its values."""
    asked: dict[str, list[Any]] = {}
    for settings in (study.settings, *study.task_settings.values(), *study.variants.values()):
        for key, value in settings.items():
            asked.setdefault(key, []).append(value)
    for key, values in study.grid.items():
        asked.setdefault(key, []).extend(values)
    return asked


def _check_setting(key: str, value: Any, trained: set[str]) -> None:
    """Refuse a setting that no stage of the study has, and a value that is of another type.

    Raises:
        UserError: It is misspelt, the study's own, or of a stage that nothing here trains.
    """
    room, _, name = str(key).partition(".")
    if room == "evaluate" or key in ("data.steps", "data.seed"):
        known = ["data.steps", "data.seed", *(f"evaluate.{one}" for one in EVALUATE)]
        if key not in known:
            near = did_you_mean(str(key), known) or f", expected some of {', '.join(known)}"
            raise UserError(f"{key} is no setting of the data or the evaluation{near}")
        if not (value in ("greedy", "sample", "argmax_q", "random") if name == "selection" else _is_number(value)):
            expected = "greedy, sample, argmax_q or random" if name == "selection" else "a number"
            raise UserError(f"{key} is {value!r}, expected {expected}")
        return
    if room not in STAGES or not name:
        known = [f"{stage}.{one}" for stage in trained for one in options(STAGES[stage])]
        near = did_you_mean(key, known) or f": write STAGE.KEY with a stage of {', '.join(sorted(trained))}"
        raise UserError(f"{key} is no setting{near}")
    if room not in trained:
        raise UserError(
            f"{key} is a setting of {room}, which no method of this study trains ({', '.join(sorted(trained))})"
        )
    if name in OURS:
        raise UserError(f"{key} is set by the study itself: leave it out")
    refuse_typos(room, ["fit", argument(name, value)], prefix=f"{room}.")


def argument(name: str, value: Any) -> str:
    """The argument of `dds STAGE fit` for a setting."""
    return f"--{name}={value if isinstance(value, str) else json.dumps(value)}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(value: Any) -> Any:
    """The same with numbers such as 1e-3, which YAML 1.1 reads as text, as numbers."""
    if isinstance(value, dict):
        return {key: _numbers(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
