"""The registry of methods: what trains, in which order, and who plays with what was trained.

A baseline is one file, a row of `training.stages.STAGES` and a row here. Importing this file is cheap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from dds_lightning.errors import UserError


@dataclass(frozen=True)
class Method:
    """One row of the paper's tables.

    Attributes:
        name: What a user types, such as "iql".
        title: What a table prints.
        source: The paper that its equations are from.
        stages: Rows of `STAGES`, in the order in which they are trained; each takes the checkpoints of earlier ones
            as its `Stage.reads` says.
        actor: "package.file:function" that turns stage -> checkpoint into an `Actor` or an agent.
        settings: What a stage needs to be told for this method, stage -> setting -> value.
        extra: The optional dependencies of pyproject.toml that it takes.
    """

    name: str
    title: str
    source: str
    stages: tuple[str, ...]
    actor: str
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    extra: str | None = None

    def play(self, checkpoints: Mapping[str, str]) -> Any:
        """Return the actor over the checkpoints of its stages, an `Actor` or a `DDSAgent`.

        Args:
            checkpoints: Stage -> `.ckpt` or published directory.

        Raises:
            UserError: A checkpoint is missing, unreadable or another stage's.
        """
        if missing := [stage for stage in self.stages if not checkpoints.get(stage)]:
            raise UserError(f"{self.title} plays with checkpoints of {', '.join(self.stages)}: {missing[0]} is missing")
        module, _, name = self.actor.partition(":")
        return getattr(import_module(module), name)({stage: str(checkpoints[stage]) for stage in self.stages})


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            name="dds",
            title="DDS",
            source="Discrete diffusion skills, sections 4.1 to 4.4",
            stages=("skill", "policy"),
            actor="dds_lightning.baselines.actors:of_skills",
        ),
        Method(
            name="clone",
            title="BC",
            source="Behaviour cloning, squared error",
            stages=("clone",),
            actor="dds_lightning.baselines.actors:of_clone",
        ),
    )
}
"""Name -> method, ours first."""


def get_method(name: str) -> Method:
    """Look a method up.

    Raises:
        UserError: There is none of this name.
    """
    if name not in METHODS:
        raise UserError(f"method is '{name}', expected one of {', '.join(METHODS)}")
    return METHODS[name]


def method_of(stage: str | None) -> Method | None:
    """Return the method whose last stage this is."""
    return next((method for method in METHODS.values() if method.stages[-1] == stage), None)
