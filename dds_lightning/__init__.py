"""Discrete diffusion skills: learn a dictionary of skills from logged trajectories, then choose among them.

The three lines most people need, with a directory that `dds run` or `checkpoints/` holds::

    from dds_lightning import DDSAgent
    agent = DDSAgent.load("checkpoints/pointmaze-large")
    action = agent.act(observation)

The names below are imported on first use, so that `dds --version` need not wait for torch.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dds_lightning._moved import redirect_old_paths, use_our_datamodules
from dds_lightning._version import __version__ as __version__

# Threads that wait for each other must not spin: with one other busy process on two cores a training step took 12 times
# as long (2,000 ms instead of 160). Read when torch is first imported; whoever sets it otherwise is heard.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
redirect_old_paths()
use_our_datamodules()

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent as DDSAgent
    from dds_lightning.errors import UserError as UserError
    from dds_lightning.policy import PolicyModule as PolicyModule
    from dds_lightning.skill import SkillModule as SkillModule
    from dds_lightning.tasks import get_task as get_task
    from dds_lightning.tasks import task_names as task_names

_HOMES = {
    "DDSAgent": "agent",
    "PolicyModule": "policy",
    "SkillModule": "skill",
    "UserError": "errors",
    "get_task": "tasks",
    "task_names": "tasks",
}

__all__ = ["DDSAgent", "PolicyModule", "SkillModule", "UserError", "__version__", "get_task", "task_names"]


def __getattr__(name: str) -> Any:
    """Import a public name from its room on first use (PEP 562)."""
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the lazily imported names as well, for tab completion."""
    return sorted({*globals(), *__all__})
