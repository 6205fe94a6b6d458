"""Task environments from what `EnvSpec.from_json` reads; `TaskEnv.spec` names `wrapped` as their entry point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from dds_lightning.tasks.env import ADAPTERS, TaskEnv
from dds_lightning.tasks.task import Task


def wrapped(env: gym.Env[Any, Any], task: Task | Mapping[str, Any]) -> TaskEnv:
    """Wrap an environment as a task's.

    Args:
        env: As `build_env` makes it.
        task: The task, or its attributes as plain values, with lists in place of tuples.
    """
    known = task if isinstance(task, Task) else Task(**{name: _tuples(value) for name, value in task.items()})
    return ADAPTERS[known.adapter](env, known)


def _tuples(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _tuples(inner) for name, inner in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
