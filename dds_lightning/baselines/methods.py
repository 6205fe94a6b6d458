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


_SKILLS = "dds_lightning.baselines.actors:of_latents"
_CONTINUOUS = {"skill": {"model.bottleneck": "gaussian"}}
_MODULE = "dds_lightning.baselines.actors:of_module"

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
        Method("td3bc", "TD3+BC", "Fujimoto and Gu (2021), equations 3 to 5", ("td3bc",), _MODULE, extra="baselines"),
        Method("iql", "IQL", "Kostrikov et al. (2021), equations 5 to 7", ("iql",), _MODULE, extra="baselines"),
        Method("cql", "CQL", "Kumar et al. (2020), equation 4", ("cql",), _MODULE, extra="baselines"),
        Method(
            "dt",
            "DT",
            "Chen et al. (2021), section 3, algorithm 1",
            ("dt",),
            "dds_lightning.baselines.decision_transformer:of_transformer",
            extra="baselines",
        ),
        Method("idql", "IDQL", "Hansen-Estruch et al. (2023), equations 3, 4, 9, algorithm 2", ("idql",), _MODULE),
        Method("dql", "Diffusion-QL", "Wang et al. (2022), equations 3 to 5", ("dql",), _MODULE),
        Method("dd", "Decision Diffuser", "Ajay et al. (2022), equations 5 to 8", ("dd",), _MODULE),
        Method(
            "opal",
            "OPAL",
            "Ajay et al. (2020), skills; Kostrikov et al. (2021), equations 5 to 7 over them",
            ("skill", "opal"),
            _SKILLS,
            _CONTINUOUS,
        ),
        Method("ldcq", "LDCQ", "Venkatraman et al. (2023), equations 6 to 8", ("skill", "ldcq"), _SKILLS, _CONTINUOUS),
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
