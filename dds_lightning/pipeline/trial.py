"""Settings of models and data, tried before a run begins: what would be refused an hour later is said at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch

from datamodules.relabelling import Relabelling
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task
from dds_lightning.training.stage_cli import StageCLI
from dds_lightning.training.stages import STARTS


def refuse_settings(parsed: Mapping[str, StageCLI], task: Task) -> None:
    """Refuse settings that a model or its data cannot have.

    Args:
        parsed: The command line of every stage.
        task: The task, whose sizes the models get.

    Raises:
        UserError: Names the stage and the first such setting.
    """
    skill: dict[str, Any] = parsed["skill"].settings.as_dict()
    sizes: dict[str, Any] = {"observation_dim": task.observation_dim, "action_dim": task.action_dim}
    sizes |= {"horizon": skill["data"]["horizon"], "skill_hash": None, "prior_unknown": False}
    sizes |= {"num_skills": skill["model"]["num_skills"], "space": "discrete", "choices": skill["model"]["num_skills"]}
    sizes["skill_settings"] = {**_chosen(skill["model"]), **{name: sizes[name] for name in parsed["skill"].stage.links}}
    for name, cli in parsed.items():
        settings = cli.settings.as_dict()
        try:
            _try_data(cli, settings["data"])
            if settings["data"].get("actions") == "raw":
                raise UserError(
                    "data.actions is raw, expected skills: a run learns online over the skills that it has trained; "
                    f"for raw actions, which need none, use `dds online fit --data.task={task.name} --data.actions=raw`"
                )
            with torch.device("meta"):  # shapes without numbers
                cli.stage.module_class()(**_chosen(settings["model"]), **{one: sizes[one] for one in cli.stage.links})
        except UserError as error:
            raise UserError(f"{name}: {error}") from error


def _chosen(model: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a model without the checkpoints that it would read."""
    return {name: value for name, value in model.items() if name not in STARTS}


def _try_data(cli: StageCLI, data: Mapping[str, Any]) -> None:
    if data["batch_size"] < 1:
        raise UserError(f"data.batch_size is {data['batch_size']}, expected at least 1")
    if not 0 <= data.get("validation_fraction", 0) < 1:
        raise UserError(f"data.validation_fraction is {data['validation_fraction']}, expected a share in [0, 1)")
    if "skill" not in data:
        cli.stage.data_class()(**data)  # reads nothing yet
    else:
        Relabelling(**{one.name: data[one.name] for one in fields(Relabelling) if one.name in data})
