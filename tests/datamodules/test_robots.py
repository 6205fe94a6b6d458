"""Skills are loaded for a robot, from one reading of their file."""

import pytest
import torch

import dds_lightning.saving.checkpoint as checkpoints
from datamodules.robots import load_skills
from dds_lightning.errors import UserError
from dds_lightning.saving.published import publish
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task

SMALL = {"horizon": 3, "num_skills": 4, "skill_dim": 8, "hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2}


@pytest.fixture(params=["skill.ckpt", "agent"])
def skill(request, tmp_path):
    """A skill model that was trained for an AntMaze."""
    module = SkillModule(29, 8, **SMALL)
    about = {"stage": "skill", "hyper_parameters": dict(module.hparams), "settings": {"data.task": "antmaze-umaze"}}
    torch.save({**about, "state_dict": module.state_dict()}, tmp_path / "skill.ckpt")
    publish(tmp_path / "agent", {"skill": module}, {"task": "antmaze-umaze"})
    return str(tmp_path / request.param)


def test_skills_are_read_once_and_refused_for_another_robot(skill, monkeypatch):
    opened = []
    for name in ("load_ckpt", "load_published"):
        read = getattr(checkpoints, name)
        monkeypatch.setattr(checkpoints, name, lambda path, read=read: opened.append(path) or read(path))
    for task in (None, get_task("antmaze-large-diverse")):
        assert load_skills(skill, task).hparams.observation_dim == 29
    assert len(opened) == 2
    with pytest.raises(UserError, match=r"trained on antmaze-umaze \(.*data\.task is pointmaze-umaze-diverse"):
        load_skills(skill, get_task("pointmaze-umaze-diverse"))
