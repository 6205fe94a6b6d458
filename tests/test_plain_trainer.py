"""The modules under a plain `L.Trainer`, as in scripts of one's own, with and without our data modules."""

import warnings

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from datamodules import RelabeledDataModule, SegmentDataModule
from dds_lightning.agent import DDSAgent
from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task
from tests.fits import TASK, of_data

SMALL = {"hidden_dim": 16, "skill_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1}


def trainer(**settings):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return pl.Trainer(**{"max_steps": 4, "enable_checkpointing": False, "limit_val_batches": 1, **quiet, **settings})


@pytest.fixture(autouse=True)
def _quiet():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning, module="lightning")
        yield


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    words = of_data(tmp_path_factory.mktemp("data"))
    return next(word.removeprefix("--data.data=") for word in words if word.startswith("--data.data="))


def segments(count=64):
    torch.manual_seed(0)
    return [{"observations": torch.randn(5, 4), "actions": torch.rand(5, 2) * 2 - 1} for _ in range(count)]


def fitted(module):
    module.normaliser.fit(torch.zeros(4), torch.ones(4))
    module.action_box.fit(-torch.ones(2), torch.ones(2))
    return module


def test_skills_then_a_policy_then_an_agent_with_our_data(spec):
    data = SegmentDataModule(TASK, spec, horizon=5, batch_size=32, validation_fraction=0.2)
    skill = SkillModule(data.observation_dim, data.action_dim, data.horizon, num_skills=4, **SMALL)
    first = trainer(val_check_interval=2)
    first.fit(skill, data)
    assert {"val/loss", "val/codes_used"} <= set(first.callback_metrics)
    first.save_checkpoint("skill.ckpt")
    transitions = RelabeledDataModule(TASK, spec, "skill.ckpt", batch_size=32)
    policy = PolicyModule(transitions.observation_dim, transitions.num_skills, (16,), skill_hash=transitions.skill_hash)
    second = trainer()
    second.fit(policy, transitions)
    assert second.global_step == 4
    second.test(policy, transitions, verbose=False)
    agent = DDSAgent(SkillModule.load("skill.ckpt"), policy)
    env = get_task(TASK).make_env()
    agent.reset(seed=0)
    assert agent.act(env.reset(seed=0)[0]).shape == (2,)
    env.close()


@pytest.mark.parametrize(
    "make", [lambda: SkillModule(4, 2, 5, num_skills=4, **SMALL), lambda: BehaviourCloning(4, 2, (16,))]
)
def test_segments_of_ones_own_in_a_plain_loader(make):
    """Its story: skills ended in a TypeError, after what the message had advised."""
    loader = DataLoader(segments(), batch_size=16, shuffle=True)
    module = fitted(make())
    plain = trainer()
    plain.fit(module, loader, DataLoader(segments(16), batch_size=16))
    assert plain.global_step == 4
    assert plain.callback_metrics["val/loss"].isfinite()
    if isinstance(module, SkillModule):
        assert bool(module.bottleneck.initted)
        plain.predict(module, DataLoader(segments(16), batch_size=16))


def test_without_statistics_the_sentence_says_which_calls_are_missing():
    with pytest.raises(UserError, match=r"normaliser\.fit\(mean, std\) and action_box\.fit\(low, high\)"):
        trainer().fit(SkillModule(4, 2, 5, num_skills=4, **SMALL), DataLoader(segments(), batch_size=16))


def test_transitions_of_ones_own_in_a_plain_loader():
    rows = [
        {
            "observations": torch.randn(4),
            "codes": torch.tensor(j % 3),
            "rewards": torch.rand(()),
            "next_observations": torch.randn(4),
            "discounts": torch.tensor(0.9),
            "dones": torch.tensor(0.0),
        }
        for j in range(64)
    ]
    policy = PolicyModule(4, 3, (16,), extraction="joint")
    policy.fit_statistics(torch.zeros(4), torch.ones(4), torch.full((3,), 1 / 3), (0.0, 1.0), 0.9)
    plain = trainer()
    plain.fit(policy, DataLoader(rows, batch_size=16), DataLoader(rows, batch_size=16))
    assert plain.callback_metrics["val/value_loss"].isfinite()


def test_resuming_under_a_plain_trainer(spec):
    def data():
        return SegmentDataModule(TASK, spec, horizon=5, batch_size=32)

    def skill():
        torch.manual_seed(1)
        return SkillModule(4, 2, 5, num_skills=4, dropout=0.0, **SMALL)

    half, rest, through = skill(), skill(), skill()
    first = trainer(max_steps=2)
    first.fit(half, data())
    first.save_checkpoint("half.ckpt")
    resumed = trainer()
    resumed.fit(rest, data(), ckpt_path="half.ckpt", weights_only=True)
    assert resumed.global_step == 4
    trainer().fit(through, data())
    assert not any(torch.equal(a, b) for a, b in zip(half.encoder.parameters(), rest.encoder.parameters(), strict=True))
