"""Baselines of our own resume bit for bit, their targets, averages and noise included."""

import pytest
import torch

from datamodules.segments import SegmentDataModule
from datamodules.transitions import LatentDataModule, SequenceDataModule, TransitionDataModule
from dds_lightning.baselines.decision_diffuser import DecisionDiffuser
from dds_lightning.baselines.diffusion_ql import DiffusionQL
from dds_lightning.baselines.idql import IDQL
from dds_lightning.baselines.ldcq import LDCQ
from dds_lightning.baselines.opal import OPAL
from dds_lightning.skill import SkillModule
from tests.baselines.toys import assert_resumes, train, two_modes

SMALL = {"hidden_dim": 8, "diffusion_steps": 3}
STEPS = {"batch_size": 16, "reward_scale": "auto"}
MODULES = {
    "idql": lambda: IDQL(2, 1, [8], dropout=0.1, blocks=1, **SMALL),
    "dql": lambda: DiffusionQL(2, 1, [8], blocks=1, actor_ema_start=2, actor_ema_every=1, **SMALL),
    "dd": lambda: DecisionDiffuser(2, 1, 4, blocks=1, **SMALL),
    "opal": lambda: OPAL(2, 4, [8]),
    "ldcq": lambda: LDCQ(2, 4, [8], blocks=1, prior_steps=3, backup_samples=2, **SMALL),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Makes the data of each baseline, over skills that hardly learnt."""
    torch.manual_seed(0)
    shape = {"skill_dim": 4, "hidden_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1}
    skill = SkillModule(2, 1, 2, bottleneck="gaussian", **shape)
    train(skill, SegmentDataModule.from_trajectories(two_modes(20), horizon=2, batch_size=16), 1)
    path = tmp_path_factory.mktemp("skill") / "skill.ckpt"
    skill.trainer.save_checkpoint(path)
    flat = (TransitionDataModule, {})
    latent = (LatentDataModule, {"skill": str(path)})
    kinds = {"dd": (SequenceDataModule, {"horizon": 4}), "opal": latent, "ldcq": latent}

    def make(name):
        kind, more = kinds.get(name, flat)
        return kind.from_trajectories(two_modes(20), **STEPS, **more)

    return make


@pytest.mark.parametrize("name", MODULES)
def test_a_training_that_stopped_goes_on_bit_for_bit(name, data, tmp_path):
    assert_resumes(MODULES[name], lambda: data(name), tmp_path)
