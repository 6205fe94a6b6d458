"""Rollouts: who plays, on which schedule, the match, and its table.

The names below are imported on first use: a process that only steps environments needs neither torch nor pandas.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dds_lightning.rollout.actors import Acted as Acted
    from dds_lightning.rollout.actors import Actor as Actor
    from dds_lightning.rollout.actors import Contestant as Contestant
    from dds_lightning.rollout.actors import RandomActor as RandomActor
    from dds_lightning.rollout.actors import single_skills as single_skills
    from dds_lightning.rollout.play import rollout as rollout
    from dds_lightning.rollout.result import RolloutPath as RolloutPath
    from dds_lightning.rollout.result import RolloutResult as RolloutResult
    from dds_lightning.rollout.schedule import episode_seed as episode_seed
    from dds_lightning.rollout.schedule import slots_needed as slots_needed

_FILES = {
    "actors": ("Acted", "Actor", "Contestant", "RandomActor", "single_skills"),
    "play": ("rollout",),
    "result": ("RolloutPath", "RolloutResult"),
    "schedule": ("episode_seed", "slots_needed"),
}
_HOMES = {name: file for file, names in _FILES.items() for name in names}

__all__ = [
    *("Acted", "Actor", "Contestant", "RandomActor", "RolloutPath", "RolloutResult"),
    *("episode_seed", "rollout", "single_skills", "slots_needed"),
]


def __getattr__(name: str) -> Any:
    """Import a name from its file on first use (PEP 562)."""
    if name in _HOMES:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the lazily imported names as well, for tab completion."""
    return sorted({*globals(), *_HOMES})
