"""Custom tasks: a YAML file, or a `Task` in a Python module, accepted wherever a task's name is.

```yaml
env_id: Reacher-v5            # any environment that Gymnasium knows, or "package:Name-v0" to import it first
max_episode_steps: 50
score_min: -43                # the return that scores 0, for example of random actions
score_max: -4                 # the return that scores 100, for example of an expert
```

Other attributes of a `Task` are optional; if not given, widths and action bounds are read from the environment. Where
its observations are a dictionary, `observation_keys` says which entries are put end to end, in which order:
`[observation, desired_goal]` shows the goal to the agent, `[observation]` does not. `action_low` and `action_high` are
the bounds of actions, a number each or a list with one for every entry, `measures_success: true` counts episodes whose
`info` says `success` or `is_success`.
A file may also give a maze of the table another goal or start cell: `task: pointmaze-large-diverse` with
`goal: [7, 1]` or `start: [1, 1]`, (row, column), is what `pointmaze-large-diverse?goal=7,1` is on the command line.

`positions` and `velocities` say which observations are the simulator's qpos and qvel, which `dds data check --replay`
needs.
"""

from __future__ import annotations

import difflib
import importlib
import math
import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.tasks.bodies import BODIES, Body, StateLayout, has_state, state_layout
from dds_lightning.tasks.task import Task

LARGEST = 100_000
"""Bytes of a task file."""
GIVEN = (
    *(
        "name",
        "env_id",
        "env_options",
        "observation_keys",
        "observation_dim",
        "action_dim",
        "action_low",
        "action_high",
    ),
    *("max_episode_steps", "step_seconds", "observation_layout", "family", "measures_success"),
    *("reward_scale", "reward_shift", "score_min", "score_max", "evaluation_episodes"),
)
"""Attributes of a `Task` that a file may give."""
BOUNDS = ("action_low", "action_high")
"""Those that may be a list."""
STATE = ("positions", "velocities", "hidden")
"""Fields that say where the simulator's state is in an observation."""
NEEDED = ("env_id", "max_episode_steps", "score_min", "score_max")
_FLAT = "expected a Box (n,); wrap the environment so that they are flat, and register it with Gymnasium"
FAMILY = "default"
"""Preset of tasks that do not name one."""
_KINDS: dict[str, tuple[str, type | tuple[type, ...]]] = {
    "str": ("a string", str),
    "int": ("a whole number", int),
    "float": ("a number", (int, float)),
    "bool": ("true or false", bool),
    "Mapping[str, Any]": ("a mapping of names to values", dict),
    "tuple[str, ...]": ("a list of names", list),
    "float | tuple[float, ...]": ("a number, or a list with one for each entry of an action", (int, float, list)),
}


class OwnCodeError(UserError):
    """The environment of a definition that came with an agent needs code or files, which only the user may name."""


def is_address(name: str) -> bool:
    """Whether a task's name says where its definition is: a YAML file, or `package.module:NAME`."""
    return name.endswith((".yaml", ".yml")) or re.fullmatch(r"[\w.]+:\w+", name) is not None


def load_task(address: str) -> Task | str:
    """Read a task from a YAML file or from a Python module; a file may also change the cells of a task of the table.

    Args:
        address: Path that ends in `.yaml`, or `package.module:NAME` of a `Task`; the module is imported, which executes
            its code.

    Returns:
        The task, or the name of one, `NAME?goal=ROW,COLUMN`.

    Raises:
        UserError: It cannot be read or is not a task; the message names the field, its value and what was expected.
    """
    if not address.endswith((".yaml", ".yml")):
        return _from_module(address)
    path = Path(address).expanduser()
    if not path.is_file():
        raise UserError(f"task: there is no file {path}")
    if path.stat().st_size > LARGEST:
        raise UserError(f"task: {path} has {path.stat().st_size} bytes, expected at most {LARGEST}")
    given = read_yaml(path, LARGEST, verdict="is not valid YAML", remedy="mend it")
    if not isinstance(given, dict):
        raise UserError(f"task: {path} is not a mapping, expected for example env_id: Reacher-v5")
    return _cells(given, str(path)) if "task" in given else build_task({"name": path.stem, **given}, str(path))


def _cells(given: Mapping[str, Any], where: str) -> str:
    """Return the name that a file with `task`, and `start` or `goal` or both, stands for."""
    found = {which: given[which] for which in ("start", "goal") if given.get(which) is not None}
    if unknown := set(given) - {"task", "start", "goal"}:
        raise UserError(f"task: {where} sets task and {min(unknown)}; beside a task it may set start and goal")
    for which, cell in found.items():
        if not isinstance(cell, list) or len(cell) != 2 or not all(type(i) is int and i >= 0 for i in cell):
            raise UserError(f"task: {where} sets {which} to {cell!r}, expected a cell, [row, column]")
    return f"{given['task']}?{'&'.join(f'{which}={i},{j}' for which, (i, j) in found.items())}"


def definition(task: Task) -> dict[str, Any]:
    """Return a custom task as plain values, from which `build_task` restores it."""
    values: dict[str, Any] = {name: getattr(task, name) for name in GIVEN}
    values = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    values["env_options"] = dict(values["env_options"])
    if not values["observation_keys"]:
        del values["observation_keys"]
    if task.body == task.name and has_state(task):
        layout = state_layout(task, task.observation_dim)
        values |= {"positions": list(layout.positions), "velocities": list(layout.velocities), "hidden": layout.hidden}
    return values


def build_task(given: Mapping[str, Any], where: str, trusted: bool = True) -> Task:
    """Build a task from the values of a file or of a `definition`.

    Args:
        given: Names to values; see `GIVEN` and `STATE`.
        where: The file, for messages.
        trusted: Whether `env_id` may name a module to import, and `env_options` files; False for definitions that
            come with an agent. In that case the environment is not built before it is played.

    Raises:
        UserError: See `load_task`; an `OwnCodeError` where only `trusted` stands in the way.
    """
    for name in given:
        if name not in (*GIVEN, *STATE):
            near = difflib.get_close_matches(str(name), (*GIVEN, *STATE), n=1)
            hint = f"did you mean {near[0]}?" if near else f"expected some of {', '.join((*GIVEN, *STATE))}"
            raise UserError(f"task: {where} sets {name}, which is not known; {hint}")
    if missing := [name for name in NEEDED if given.get(name) is None]:
        raise UserError(f"task: {where} lacks {', '.join(missing)}")
    types = {field.name: str(field.type) for field in fields(Task)}
    values: dict[str, Any] = {}
    for name in (name for name in GIVEN if given.get(name) is not None):
        description, kind = _KINDS[types[name]]
        value: Any = given[name]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise UserError(f"task: {where} sets {name} to {value!r}, expected {description}")
        entries = value if isinstance(value, list) and name in BOUNDS else [value]
        if name in BOUNDS and not all(type(entry) in (int, float) for entry in entries):
            raise UserError(f"task: {where} sets {name} to {value!r}, expected {description}")
        numbers = tuple(float(str(entry)) for entry in entries) if "float" in types[name] else ()
        values[name] = (numbers if isinstance(value, list) else numbers[0]) if numbers else value
    values["observation_keys"] = tuple(values.get("observation_keys", ()))
    _check(values, where, trusted)
    asked = {} if not trusted and "observation_dim" in values else _read_environment(values, where)
    values = {"family": FAMILY, "measures_success": False, **asked, **values}
    task = Task(**values, body=values["name"])
    _check_box(task, where)
    layout = {name: given[name] for name in STATE if given.get(name) is not None}
    BODIES[task.name] = _body(task, layout, where) if layout else Body()
    return task


def _check(values: Mapping[str, Any], where: str, trusted: bool) -> None:
    rules = [
        ("name", re.fullmatch(r"[\w-]+", values["name"]) is not None, "letters, digits, '_' and '-'"),
        ("family", trusted or re.fullmatch(r"[\w-]+", values.get("family", FAMILY)) is not None, "a preset's name"),
        ("env_id", re.fullmatch(r"([\w.]+:)?[\w./-]+", values["env_id"]) is not None, "a name that Gymnasium knows"),
        ("max_episode_steps", values["max_episode_steps"] >= 1, "at least 1"),
        ("max_episode_steps", trusted or values["max_episode_steps"] <= 10**6, "at most a million"),
        ("evaluation_episodes", trusted or values.get("evaluation_episodes", 1) <= 10**5, "at most 100,000"),
        ("score_max", values["score_max"] > values["score_min"], f"more than score_min={values['score_min']}"),
        ("observation_keys", _are_names(values["observation_keys"]), "names of entries, each once"),
        *((name, values.get(name, 1) >= 1, "at least 1") for name in ("observation_dim", "action_dim")),
        ("evaluation_episodes", values.get("evaluation_episodes", 1) >= 1, "at least 1"),
        ("step_seconds", values.get("step_seconds", 1.0) > 0, "a positive number"),
        ("reward_scale", values.get("reward_scale", 1.0) > 0, "a positive number"),
    ]
    for name, fine, expected in rules:
        if not fine:
            raise UserError(f"task: {where} sets {name} to {values[name]!r}, expected {expected}")
    for name in ("score_min", "score_max", "reward_scale", "reward_shift"):
        if not np.isfinite(values.get(name, 0.0)):
            raise UserError(f"task: {where} sets {name} to {values[name]!r}, expected a finite number")
    options, yours = values.get("env_options", {}), "if that is your own, name its task file with --task"
    if not trusted and ":" in values["env_id"]:
        raise OwnCodeError(f"task: {where} sets env_id to {values['env_id']!r}, which imports code: {yours}")
    if not trusted and not all(type(value) in (bool, int, float) for value in options.values()):
        raise OwnCodeError(f"task: {where} sets env_options to {options!r}, expected numbers, true or false: {yours}")


def _check_box(task: Task, where: str) -> None:
    """Refuse bounds of actions that are not finite, the wrong way round, or of another width than the actions."""
    for name in BOUNDS:
        bound = getattr(task, name)
        if isinstance(bound, tuple) and len(bound) != task.action_dim:
            expected = f"one number, or {task.action_dim}, one for each entry of an action"
            raise UserError(f"task: {where} sets {name} to {list(bound)}, expected {expected}")
    low, high = task.action_box()
    wrong = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high) & (low < high)))
    if len(wrong):
        j = int(wrong[0])
        raise UserError(
            f"task: {where}: action_low is {low[j]:g} and action_high {high[j]:g} in entry {j} of an action, expected "
            "finite numbers, the lower one first"
        )


def _are_names(keys: tuple[Any, ...]) -> bool:
    return all(isinstance(key, str) for key in keys) and len(set(keys)) == len(keys)


def _read_environment(values: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Read widths, action bounds and the length of a step from the environment.

    Raises:
        UserError: Gymnasium does not know it, or its spaces are not those of one flat array.
    """
    import gymnasium as gym

    from dds_lightning.envs.build import build_env

    try:
        env = build_env(values["env_id"], **values.get("env_options", {}))
    except (gym.error.Error, ImportError, TypeError, ValueError) as error:
        raise UserError(f"task: {where} sets env_id to {values['env_id']}: {str(error).splitlines()[0]}") from None
    try:
        width, taken = _observation_width(env.observation_space, values, where), env.action_space
        if not isinstance(taken, gym.spaces.Box) or len(taken.shape) != 1:
            told = "expected a Box: skills make continuous actions, discrete ones are not supported"
            told = told if "Discrete" in type(taken).__name__ else _FLAT
            raise UserError(f"task: {where}: the actions of {values['env_id']} are {taken}, {told}")
        box = {"action_low": taken.low, "action_high": taken.high}
        if not all(name in values or np.isfinite(bound).all() for name, bound in box.items()):
            raise UserError(
                f"task: {where}: the actions of {values['env_id']} have bounds {taken.low} to {taken.high}, expected "
                "finite ones: set action_low and action_high, a number each or a list with one for every entry"
            )
        found = {"observation_dim": width, "action_dim": taken.shape[0]}
        for name, width in found.items():
            if values.get(name, width) != width:
                raise UserError(f"task: {where} sets {name} to {values[name]}, but {values['env_id']} has {width}")
        seconds = getattr(env.unwrapped, "dt", None) or 1.0
        bounds = {name: tuple(bound.tolist()) if np.ptp(bound) else float(bound[0]) for name, bound in box.items()}
        return {**found, **bounds, "step_seconds": float(seconds)}
    finally:
        env.close()


def _observation_width(space: Any, values: Mapping[str, Any], where: str) -> int:
    """O of a Box, or of the entries of a Dict that `observation_keys` names.

    Raises:
        UserError: It is another space, or the names do not fit it; the message lists the entries.
    """
    import gymnasium as gym

    keys, about = list(values["observation_keys"]), f"the observations of {values['env_id']} are"
    if isinstance(space, gym.spaces.Dict):
        shapes = {name: inner.shape for name, inner in space.items() if isinstance(inner, gym.spaces.Box)}
        if keys and set(keys) <= set(shapes):
            return sum(math.prod(shapes[key]) for key in keys)
        entries = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        plain = [name for name in shapes if name not in ("achieved_goal", "desired_goal")]
        goal = f" or, with the goal, [{', '.join([*plain, 'desired_goal'])}]" if "desired_goal" in shapes else ""
        problem = (
            f"{about} a dictionary of {entries}: set observation_keys to those that are put end to end, for example "
            f"[{', '.join(plain)}]{goal}{f'; it is {keys}' if keys else ''}"
        )
    elif not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        problem = f"{about} {space}, {_FLAT}"
    elif keys:
        problem = f"{about} one array, {space}: leave out observation_keys, which is {keys}"
    else:
        return int(space.shape[0])
    raise UserError(f"task: {where}: {problem}")


def _body(task: Task, layout: Mapping[str, Any], where: str) -> Body:
    """Return a robot whose observations hold the simulator's state in the columns that the file gives."""
    for name in STATE[:2]:
        columns = layout.get(name)
        if not isinstance(columns, list) or not all(type(c) is int and 0 <= c < task.observation_dim for c in columns):
            expected = f"a list of columns of 0 to {task.observation_dim - 1}; give both positions and velocities"
            raise UserError(f"task: {where} sets {name} to {columns!r}, expected {expected}")
    hidden = layout.get("hidden", 0)
    if type(hidden) is not int or hidden < 0:
        raise UserError(f"task: {where} sets hidden to {hidden!r}, expected the number of positions left out")
    names = tuple(f"observation {j}" for j in range(task.observation_dim))
    positions, velocities = tuple(layout["positions"]), tuple(layout["velocities"])
    return Body(layouts={0: StateLayout(names, positions, velocities, len(velocities), hidden)})


def _from_module(address: str) -> Task:
    module, _, name = address.partition(":")
    from dds_lightning.envs.build import find_modules_here

    find_modules_here()
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise UserError(f"task: '{address}' cannot be imported: {error}") from None
    if not isinstance(found, Task):
        raise UserError(f"task: '{address}' is a {type(found).__name__}, expected a dds_lightning.tasks.Task")
    return found
