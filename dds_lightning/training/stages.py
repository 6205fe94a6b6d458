"""The registry of training stages: a stage is a module, the data it learns from, and one row here.

`dds STAGE fit`, `fit`, `dds run`, checkpoints, publishing and fine-tuning read this table. Importing it is cheap:
modules and data are named, and imported when they are used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.configs import find, preset_folder
from dds_lightning.errors import UserError

if TYPE_CHECKING:
    import lightning.pytorch as pl

    from dds_lightning.module import StageModule


@dataclass(frozen=True)
class Stage:
    """One training stage.

    Attributes:
        name: What a user types, stored in every checkpoint; the `STAGE` of its module.
        description: First line of its help.
        module: The `StageModule`, as "package.file:Class".
        data: The `LightningDataModule`, likewise.
        links: Attributes of the data that become settings of the module; never the user's to give.
        steps: Optimiser steps without a configuration.
        widths: The settings that take memory beside `data.batch_size`, for advice.
        in_presets: Whether every preset folder must have a `NAME.yaml` for it.
        preset: Packaged configuration where a preset folder has none; None takes the module's defaults.
        threads: Threads of torch while fitting; None leaves torch's own number.
        metrics: Names of everything that its `fit` can log, whatever its settings; empty where nobody has listed them.
        reads: Stages whose checkpoint it needs, and the setting that takes it.
        in_run: Whether `dds run` knows its settings; baselines are trained by `dds STAGE fit` and `dds study` alone.
        added: Settings that it has not had from the beginning, with the values that change nothing: a study goes on
            with what was trained without them.
        revision: Raised where the same settings come to train or to act otherwise: a study does not take what was found
            before for its own.
        commands: What its help lists beside `fit`, name to one line; None lists Lightning's others.
    """

    name: str
    description: str
    module: str
    data: str
    links: tuple[str, ...]
    steps: int
    widths: str
    in_presets: bool = False
    preset: str | None = None
    threads: int | None = None
    metrics: tuple[str, ...] = ()
    reads: Mapping[str, str] = field(default_factory=dict)
    in_run: bool = True
    added: Mapping[str, Any] = field(default_factory=dict)
    revision: int = 0
    commands: Mapping[str, str] | None = None

    def module_class(self) -> type[StageModule]:
        """Import the module."""
        return _import(self.module)

    def data_class(self) -> type[pl.LightningDataModule]:
        """Import the data module."""
        return _import(self.data)


def _named(**names: str) -> tuple[str, ...]:
    return tuple(f"{prefix}/{name}" for prefix, listed in names.items() for name in listed.split())


_SKILL_LOSSES = "loss denoising codebook commitment kl perplexity codes_used"
_POLICY_TERMS = (
    "value_loss q_loss actor_loss v_mean v_min v_max q_mean advantage_std clipped_share effective_sample_size"
)


_NO_FOURIER = {"model.fourier_features": 0, "model.fourier_scale": 1.0, "model.fourier_seen": 0}


def _baseline(
    name: str,
    description: str,
    module: str,
    data: str = "TransitionDataModule",
    links: tuple[str, ...] = ("observation_dim", "action_dim"),
    **more: Any,
) -> Stage:
    """The row of a baseline: a class in `baselines`, data of `datamodules.transitions`, a preset `NAME.yaml`."""
    return Stage(
        name=name,
        description=description,
        module=f"dds_lightning.baselines.{module}",
        data=f"datamodules.transitions:{data}",
        links=links,
        steps=1_000_000,
        preset=f"{name}.yaml",
        threads=1,
        in_run=False,
        **{"widths": "model.hidden_dims", "added": _NO_FOURIER, **more},
    )


STARTS = ("init_from", "offline")
"""Settings of a module that name a checkpoint from whose weights a new training starts."""
_LATENT = ("observation_dim", "skill_dim", "skill_hash")
_SKILL = {"skill": "data.skill"}

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            name="skill",
            description="Stage one: learn discrete skills from segments of trajectories.",
            module="dds_lightning.skill:SkillModule",
            data="datamodules.segments:SegmentDataModule",
            links=("observation_dim", "action_dim", "horizon"),
            steps=500_000,  # the paper's, as are the defaults of the module
            widths="data.horizon or model.hidden_dim",
            in_presets=True,
            metrics=_named(train=_SKILL_LOSSES, val=f"{_SKILL_LOSSES} reconstruction_rmse dead_codes"),
        ),
        Stage(
            name="policy",
            description="Stage two: learn from relabelled data when to use which skill.",
            module="dds_lightning.policy:PolicyModule",
            data="datamodules.relabelled:RelabeledDataModule",
            links=("observation_dim", "num_skills", "skill_hash"),
            steps=1_500_000,
            widths="model.hidden_dims",
            in_presets=True,
            metrics=_named(train=f"loss {_POLICY_TERMS}", val=f"{_POLICY_TERMS} code_accuracy entropy"),
            reads=_SKILL,
        ),
        Stage(
            name="clone",
            description="The baseline without skills: clone the data's actions.",
            module="dds_lightning.baselines.behaviour_cloning:BehaviourCloning",
            data="datamodules.segments:SegmentDataModule",
            links=("observation_dim", "action_dim"),
            steps=16_000,
            widths="model.hidden_dims",
            preset="clone.yaml",
            threads=1,  # more gain little on an idle machine and cost much on a busy one
            added=_NO_FOURIER,
            metrics=_named(train="loss", val="loss"),
        ),
        Stage(
            name="online",
            description="Online RL with trained skills: SAC over codes, continuous skills or raw actions.",
            module="dds_lightning.online.sac:SACModule",
            data="datamodules.online:OnlineDataModule",
            links=("observation_dim", "space", "choices", "prior_unknown", "skill_hash", "skill_settings"),
            steps=100_000,
            widths="model.hidden_dims or data.replay_size",
            preset="online.yaml",
            threads=1,
            metrics=_named(
                train="loss q_loss novelty_loss actor_loss temperature_loss decoder_loss q_mean q_min q_max entropy "
                "alpha",
                online="env_steps episodes return success cells",
            ),
            reads=_SKILL,
            commands={"compare": "Learn a task over discrete skills, continuous skills and raw actions, and compare."},
        ),
        _baseline("td3bc", "TD3+BC, by d3rlpy.", "d3:TD3BC"),
        _baseline("iql", "IQL over single steps, by d3rlpy.", "d3:IQL"),
        _baseline("cql", "CQL, by d3rlpy.", "d3:CQL"),
        _baseline(
            "dt",
            "Decision Transformer, by d3rlpy: actions from returns still wanted.",
            "decision_transformer:DecisionTransformer",
            "SequenceDataModule",
            ("observation_dim", "action_dim", "horizon"),
            widths="data.horizon or model.hidden_dim",
        ),
        _baseline(
            "idql",
            "IDQL: an IQL critic chooses among actions of a diffusion model.",
            "idql:IDQL",
            revision=1,  # noise of variance beta_t
        ),
        _baseline(
            "dql",
            "Diffusion-QL: a diffusion policy that climbs Q.",
            "diffusion_ql:DiffusionQL",
            added={**_NO_FOURIER, "model.temperature": 1.0},
        ),
        _baseline(
            "dd",
            "Decision Diffuser: plans of states for a wanted return, and the actions between them.",
            "decision_diffuser:DecisionDiffuser",
            "SequenceDataModule",
            ("observation_dim", "action_dim", "horizon"),
            widths="data.horizon or model.hidden_dim",
            added={},
        ),
        _baseline("opal", "OPAL: IQL over continuous skills.", "opal:OPAL", "LatentDataModule", _LATENT, reads=_SKILL),
        _baseline(
            "ldcq",
            "LDCQ: a diffusion prior over continuous skills and a critic that keeps to it.",
            "ldcq:LDCQ",
            "LatentDataModule",
            _LATENT,
            reads=_SKILL,
            revision=1,  # noise of variance beta_t
        ),
    )
}
"""Name -> stage, in the order of the method."""


def preset_configs(name: str) -> dict[str, Path | None]:
    """The configuration of every stage in a preset.

    Args:
        name: A packaged folder's name or a folder of the user's.

    Returns:
        Stage -> file; None where the module's defaults hold.

    Raises:
        UserError: There is no such preset, or it lacks the file of a stage that must be in it.
    """
    folder = preset_folder(name)
    files: dict[str, Path | None] = {}
    for stage in STAGES.values():
        path = folder / f"{stage.name}.yaml"
        if path.is_file():
            files[stage.name] = path
        elif stage.in_presets:
            raise UserError(f"preset: folder {folder} has no {path.name}")
        else:
            files[stage.name] = find(stage.preset) if stage.preset else None
    return files


def get_stage(name: str) -> Stage:
    """Look a stage up.

    Raises:
        UserError: There is no such stage.
    """
    if name not in STAGES:
        raise UserError(f"stage is '{name}', expected one of {', '.join(STAGES)}")
    return STAGES[name]


def run_stages() -> list[str]:
    """Names of the stages whose settings `dds run` takes."""
    return [name for name, stage in STAGES.items() if stage.in_run]


def _import(address: str) -> Any:
    module, _, name = address.partition(":")
    return getattr(import_module(module), name)
