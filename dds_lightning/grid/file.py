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

Beside stages, `data.steps`, `data.seed` and `evaluate.KEY` are settings (`checks.SETTINGS`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from dds_lightning.baselines.methods import METHODS
from dds_lightning.configs import ROOT
from dds_lightning.console.refusals import did_you_mean
from dds_lightning.errors import UserError
from dds_lightning.grid.cells import Study, shown
from dds_lightning.grid.checks import check
from dds_lightning.saving.untrusted import parse_yaml, read_text

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


def packaged_studies() -> list[str]:
    """Names of the packaged study files."""
    return sorted(path.stem for path in (ROOT / "studies").glob("*.yaml"))


def find_study(name: str) -> Path:
    """Find a study file: the user's, or else a packaged one by its name.

    Raises:
        UserError: There is neither.
    """
    if Path(name).is_file():
        return Path(name)
    if name in (known := packaged_studies()):
        return ROOT / "studies" / f"{name}.yaml"
    near = did_you_mean(name, known) if Path(name).name == name and not Path(name).suffix else ""
    near = near or f", and the packaged studies are {', '.join(known)}"
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
    text = read_text(path)
    found = parse_yaml(text, path)
    _refuse_doubled(yaml.compose(text, Loader=yaml.SafeLoader), path)
    if not isinstance(found, dict):
        raise UserError(f"{path} is not a mapping, expected {', '.join(_KEYS)}")
    for key, value in found.items():
        if key not in _KEYS:
            near = did_you_mean(str(key), _KEYS) or f", expected some of {', '.join(_KEYS)}"
            raise UserError(f"{path}: {key} is not a setting of a study{near}")
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
    if "labels" in found:
        found["labels"] = {shown(name): given for name, given in found["labels"].items()}
    numbers: dict[str, Any] = {
        key: _numbers(found.pop(key)) for key in ("settings", "task_settings", "grid", "variants") if key in found
    }
    study = Study(**found, **lists, **numbers, scale=scale)
    try:
        check(study)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return study


def _refuse_doubled(node: Any, path: Path) -> None:
    """Refuse a key that a mapping has twice: YAML would take the last without a word.

    Raises:
        UserError: Names it and its line.
    """
    if isinstance(node, yaml.MappingNode):
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := [key for index, key in enumerate(keys) if key in keys[:index]]:
            line = next(key for key, _ in reversed(node.value) if key.value == twice[0]).start_mark.line + 1
            raise UserError(f"{path}: {twice[0]} is given twice, the second time in line {line}: leave one out")
    for inner in node.value if isinstance(node, yaml.CollectionNode) else ():
        for one in inner if isinstance(inner, tuple) else (inner,):
            _refuse_doubled(one, path)


def _numbers(value: Any) -> Any:
    """The same with numbers such as 1e-3 and 2e5, which YAML 1.1 reads as text, as numbers."""
    if isinstance(value, dict):
        return {key: _numbers(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_numbers(inner) for inner in value]
    if isinstance(value, str):
        try:
            number = float(value)
        except ValueError:
            return value
        return int(number) if number.is_integer() else number
    return value
