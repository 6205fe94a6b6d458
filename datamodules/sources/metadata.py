"""Checks the `metadata.json` of a Minari data set; nothing that it names is ever run.

Minari's loader builds environments from this file, and thereby runs whatever callable it names. Here it is only
text, which must be what a genuine recording of one of our environments contains:

| entry | must be |
|---|---|
| both spaces | present (Minari would run the environment to find them out), and those of the task |
| `env_spec`: id | an environment of the task table |
| entry points, `eval_env_spec`'s too | what Gymnasium has registered under that id |
| wrappers | only ones that observe |
| arguments | only ones that do not change the physics, or the registered values |
| walls, subtasks | the task's |
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.sources.observations import Layout, box_shape, describe_space, find_layout, task_layout
from datamodules.sources.source import FIT
from datamodules.validation import DataError
from dds_lightning.envs.kitchen import SUBTASKS
from dds_lightning.errors import UserError
from dds_lightning.saving.files import neighbours
from dds_lightning.saving.untrusted import parse_json, read_text
from dds_lightning.tasks import Task, is_own, known_env_ids
from dds_lightning.tasks.task import bounds_text

MAX_BYTES = 2**20
"""Greatest size of a metadata.json; genuine ones have a few thousand bytes."""

HARMLESS = frozenset(
    {
        *("maze_map", "tasks_to_complete"),  # compared with the task's
        *("reward_type", "continuing_task", "reset_target", "position_noise_range"),  # in mazes, one goal is rewarded
        *("terminate_on_tasks_completed", "remove_task_when_completed"),  # subtasks are counted anew
        *("reset_noise_scale", "robot_noise_ratio", "object_noise_ratio"),
        *("render_mode", "width", "height", "camera_id", "camera_name", "default_camera_config"),
    }
)
"""Arguments of environments that change neither the physics nor the rewards that are learnt from."""

_WATCHING = re.compile(
    r"gymnasium\.wrappers\.\w+:(OrderEnforcing|PassiveEnvChecker|RecordEpisodeStatistics|RecordVideo|TimeLimit)"
)
"""Wrappers that change nothing that is recorded."""


def read_metadata(data: Path) -> dict[str, Any]:
    """Read a data set's metadata.json and refuse what no genuine recording contains.

    Args:
        data: Folder with `metadata.json` and `main_data.hdf5`.

    Returns:
        The file's entries. `dataset_id` is safe to print; both spaces are parsed; `env_spec` is None or has `id`
        and `kwargs`; `total_episodes` and `total_steps` are counts where they are present.

    Raises:
        DataError: When it is missing, damaged, lacks a space, or names an unknown environment or foreign
            code.
    """
    path = data / "metadata.json"
    if not path.is_file():
        raise DataError(f"data: {path} is missing, so {data} is not a Minari data set{neighbours(path)}")
    try:
        text = read_text(path, MAX_BYTES, root=data, verdict="is damaged")
    except UserError as error:
        raise DataError(f"data: {error}") from error
    metadata = _parse(text, f"data: {path}")
    name = _name(metadata, data)
    for key in ("observation_space", "action_space"):
        if not isinstance(metadata.get(key), str):
            raise DataError(
                f"data set '{name}': metadata.json has no {key}; Minari would run the environment that the "
                "file names to find out, so such data sets are refused"
            )
        metadata[key] = _parse(metadata[key], f"data set '{name}': {key} in metadata.json")
    if metadata.get("data_format", "hdf5") != "hdf5":
        raise DataError(f"data set '{name}': data_format is {_short(metadata['data_format'])}, expected 'hdf5'")
    for key in ("total_episodes", "total_steps"):
        count = metadata.get(key)
        if count is not None and (type(count) is not int or count < 0):
            raise DataError(f"data set '{name}': {key} in metadata.json is {_short(count)}, expected a count")
    _judge_env(name, "eval_env_spec", metadata.get("eval_env_spec"))
    env = _judge_env(name, "env_spec", metadata.get("env_spec"))
    if env is not None:
        _judge_arguments(name, env)
    return {**metadata, "dataset_id": name, "env_spec": env}


def _parse(text: Any, where: str) -> dict[str, Any]:
    """A JSON object."""
    try:
        value = parse_json(text, "it")
    except UserError as error:
        raise DataError(f"{where} is damaged: it is not a JSON object ({_short(error)})") from error
    if not isinstance(value, dict):
        raise DataError(f"{where} is damaged: expected a JSON object, got {_short(value)}")
    return value


def _name(metadata: dict[str, Any], data: Path) -> str:
    """Name of the data set in messages: its id if that is valid, else its folder."""
    name = metadata.get("dataset_id")
    folder = data.parent.name if data.name == "data" else data.name
    return name if isinstance(name, str) and re.fullmatch(r"\w[\w./-]{0,99}", name) and ".." not in name else folder


def _judge_env(name: str, key: str, text: Any) -> dict[str, Any] | None:
    """Id and arguments of an environment whose code is the registered one."""
    if text is None:
        return None
    where = f"data set '{name}': {key} in metadata.json"
    spec = _parse(text, where)
    env_id, arguments, wrappers = spec.get("id"), spec.get("kwargs") or {}, spec.get("additional_wrappers") or []
    if not isinstance(arguments, dict) or not isinstance(wrappers, list):
        raise DataError(f"{where} is damaged: expected an object for kwargs and a list for additional_wrappers")
    for wrapper in wrappers:
        code = wrapper.get("entry_point") if isinstance(wrapper, dict) else wrapper
        if not isinstance(code, str) or not _WATCHING.fullmatch(code):
            raise _foreign(name, key, code, "only wrappers of gymnasium.wrappers that observe")
    registered = _registered(name, env_id)
    for entry in ("entry_point", "vector_entry_point"):
        if spec.get(entry) not in (None, getattr(registered, entry)):
            raise _foreign(name, key, spec[entry], f"{getattr(registered, entry) or 'none'}, as {env_id} has it")
    return {"id": env_id, "kwargs": arguments}


def _foreign(name: str, key: str, found: Any, expected: str) -> DataError:
    return DataError(
        f"data set '{name}': {key} names the code {_short(found)}, expected {expected}; do not open this data set "
        "with other tools"
    )


def _registered(name: str, env_id: Any) -> Any:
    """Gymnasium's specification of an environment of the task table."""
    if not isinstance(env_id, str) or env_id not in known_env_ids():
        raise DataError(
            f"data set '{name}': it was recorded in {_short(env_id)}, which no task uses; see `dds tasks`, or, for a "
            "robot of your own, give its task with --task, a file that names this environment"
        )
    import gymnasium as gym  # slow, and not needed for data sets that are refused earlier

    from dds_lightning.envs.build import register_environments

    register_environments()
    if env_id not in gym.registry:
        raise DataError(
            f"data set '{name}': it was recorded in {env_id}, which is not among the installed environments; "
            "nothing says what its code should be"
        )
    return gym.registry[env_id]


def _judge_arguments(name: str, env: dict[str, Any]) -> None:
    registered = json.loads(json.dumps(_registered(name, env["id"]).kwargs))
    for key, value in env["kwargs"].items():
        if key not in HARMLESS and not (key in registered and registered[key] == value):
            expected = f"{key} = {_short(registered[key])}" if key in registered else f"no argument {_short(key)}"
            raise DataError(
                f"data set '{name}': it was recorded with the argument {one_line(key)} = {_short(value)}, so with "
                f"other physics or rewards than those of {env['id']}, which has {expected}"
            )
    if not _is_names(env["kwargs"].get("tasks_to_complete", [])):
        found = _short(env["kwargs"]["tasks_to_complete"])
        raise DataError(f"data set '{name}': tasks_to_complete is {found}, expected some of {', '.join(SUBTASKS)}")


def _is_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) and one in SUBTASKS for one in value)


# ---------------------------------------------------------------------- against a task


def check_task(metadata: dict[str, Any], task: Task) -> None:
    """Refuse data with other walls, other subtasks or of unknown origin.

    Args:
        metadata: From `read_metadata`.
        task: From `resolve_task`, so that it accepts data of this environment.

    Raises:
        DataError: When the recording is not of the task.
    """
    name, env = metadata["dataset_id"], metadata["env_spec"]
    if env is None and is_own(task):
        return
    if env is None:
        raise DataError(
            f"data set '{name}': metadata.json has no env_spec, so nothing says that it was recorded in "
            f"{task.env_id}, which task '{task.name}' needs; write its env_spec, or give the arrays as arrays:DIR"
        )
    maze_map = env["kwargs"].get("maze_map")
    if task.maze_map is not None and maze_map is not None:
        walls = _walls(maze_map)
        if walls != task.maze_map:
            raise DataError(
                f"data set '{name}' was recorded in {env['id']} with other walls ({one_line('/'.join(walls))}) than "
                f"task '{task.name}' has ({'/'.join(task.maze_map)}); {FIT}"
            )
    recorded = env["kwargs"].get("tasks_to_complete")
    if task.subtasks and recorded is not None and set(recorded) != set(task.subtasks):
        raise DataError(
            f"data set '{name}' was recorded for the subtasks {one_line(', '.join(recorded))}, but task "
            f"'{task.name}' has {', '.join(task.subtasks)}; choose a task that fits the data, or other data"
        )


def _walls(maze_map: Any) -> tuple[str, ...]:
    """Rows of "1" wall and "0" free; cells of the file are numbers or letters (r start, g goal, c both)."""
    rows = maze_map if isinstance(maze_map, list) else [maze_map]
    cells = (row if isinstance(row, (list, str)) else [row] for row in rows)
    return tuple("".join("1" if value in (1, "1") else "0" for value in row) for row in cells)


def observation_layout(metadata: dict[str, Any], task: Task | None) -> Layout:
    """How to read the observations, from their space.

    Args:
        metadata: From `read_metadata`.
        task: The task whose layout they must have; None accepts every known layout.

    Raises:
        DataError: For a space that is not the task's, or is unknown.
    """
    space, env = metadata["observation_space"], metadata["env_spec"]
    subtasks = (env or {"kwargs": {}})["kwargs"].get("tasks_to_complete", list(SUBTASKS))
    layout = task_layout(task) if task else find_layout(space, subtasks)
    if layout is None or not layout.fits(space):
        needed = f"task '{task.name}' needs {layout}; {FIT}" if task else "no task has such a space; give a --task file"
        found = one_line(describe_space(space))
        raise DataError(f"data set '{metadata['dataset_id']}': its observation space is {found}, but {needed}")
    return layout


def action_box(metadata: dict[str, Any], task: Task | None) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lower and upper bounds of actions, (A,) each.

    Args:
        metadata: From `read_metadata`.
        task: The task whose box it must be; None accepts any.

    Raises:
        DataError: For anything but a bounded Box, and for a Box that is not the task's.
    """
    space, where = metadata["action_space"], f"data set '{metadata['dataset_id']}': its action space"
    shape = box_shape(space)
    try:
        low, high = (np.array(space[key], np.float32).reshape(-1) for key in ("low", "high"))
        sound = shape is not None and len(shape) == 1 and low.shape == high.shape == shape and bool((low < high).all())
    except (KeyError, TypeError, ValueError, OverflowError):
        sound = False
    if not sound or not np.isfinite([low, high]).all():
        raise DataError(f"{where} is {_short(space)}, expected a bounded Box")
    if task is None:
        return low, high
    needed = task.action_box()
    if low.shape != needed[0].shape or not np.allclose([low, high], needed):
        raise DataError(
            f"{where} is a Box ({len(low)},) from {bounds_text(low)} to {bounds_text(high)}, but task '{task.name}' "
            f"needs a Box ({task.action_dim},) from {bounds_text(needed[0])} to {bounds_text(needed[1])}; {FIT}"
        )
    return needed


def _short(value: Any) -> str:
    """A value of the file, or an error about it, as part of a message."""
    try:
        return one_line(f"{type(value).__name__}: {value}" if isinstance(value, Exception) else repr(value))
    except RecursionError:
        return f"a deeply nested {type(value).__name__}"


def one_line(text: str) -> str:
    """Text of a file, cut to one line and without control characters."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= 120 else f"{text[:117]}..."
