"""A policy that starts from another one's weights: for new rewards, with only one of its parts, in other states."""

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from tests.modules import changed, fit, state


class Transitions(pl.LightningDataModule):
    """Random semi-MDP transitions with rewards up to `reward`; codes 0 to 2 only when `seed` is 1."""

    def __init__(self, dim: int = 3, seed: int = 0, reward: float = 1.0) -> None:
        super().__init__()
        self.dim, self.seed, self.reward = dim, seed, reward

    def statistics(self):
        share = torch.tensor([0.25, 0.25, 0.5, 0.0]) if self.seed else torch.full((4,), 0.25)
        return {
            "observation_mean": torch.full((self.dim,), float(self.seed)),
            "observation_std": torch.full((self.dim,), 1.0 + self.seed),
            "code_share": share,
            "reward_range": (0.0, self.reward),
            "max_discount": 0.9,
        }

    def train_dataloader(self):
        stream = torch.Generator().manual_seed(self.seed)
        batches = [
            {
                "observations": torch.randn(32, self.dim, generator=stream),
                "codes": torch.randint(3, (32,), generator=stream),
                "rewards": self.reward * torch.rand(32, generator=stream),
                "next_observations": torch.randn(32, self.dim, generator=stream),
                "discounts": torch.full((32,), 0.9),
                "dones": torch.zeros(32),
            }
            for _ in range(20)
        ]
        return DataLoader(batches, batch_size=None)


def policy(dim: int = 3, seed: int = 1, **settings) -> PolicyModule:
    torch.manual_seed(seed)
    settings = {"hidden_dims": [16], "extraction": "joint", "lr": 1e-3, "fourier_features": 4} | settings
    return PolicyModule(dim, settings.pop("num_skills", 4), **settings)


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A checkpoint of a policy."""
    path = tmp_path_factory.mktemp("start") / "policy.ckpt"
    fit(policy(seed=0), Transitions(), 6).save_checkpoint(path)
    return path


@pytest.mark.parametrize(
    ("trainable", "frozen"), [("actor", ("value", "critic", "target_critic")), ("critic", "actor")]
)
@pytest.mark.parametrize("extraction", ["joint", "after"])
def test_frozen_parts_of_a_policy_stay_and_the_others_learn_from_the_first_step(start, trainable, frozen, extraction):
    settings = {"trainable": trainable, "extraction": extraction, "critic_steps": 2}
    module = policy(init_from=str(start), **settings)
    before = state(module)
    fit(module, Transitions(seed=1), 4)
    moved = {name.split(".")[0] for name in changed(before, state(module))} - {"support_mask", "value_range"}
    assert not moved & set([frozen] if isinstance(frozen, str) else frozen)
    assert moved == ({"actor"} if trainable == "actor" else {"value", "critic", "target_critic"})


def test_a_policy_keeps_its_normaliser_and_takes_support_and_value_range_of_the_new_rewards(start):
    module = policy(init_from=str(start))
    source = state(PolicyModule.load(start))
    assert changed(source, state(module)) == {"value_range"}
    fit(module, Transitions(seed=1, reward=5.0), 1)
    assert module.normaliser.mean.tolist() == [0.0, 0.0, 0.0]
    assert module.support_mask.tolist() == [True, True, True, False]
    assert module.value_range.tolist() == pytest.approx([0.0, 50.0])


def test_a_policy_of_other_observations_keeps_its_upper_layers(start):
    with pytest.warns(UserWarning, match=r"value\.0\.weight.*actor\.0\.weight"):
        module = policy(dim=5, init_from=str(start))
    source = state(PolicyModule.load(start))
    assert torch.equal(module.actor[2].weight, source["actor.2.weight"])
    fit(module, Transitions(dim=5, seed=1), 1)
    assert module.normaliser.mean.tolist() == [1.0] * 5


def test_resuming_wins_over_the_start(start, tmp_path):
    module = policy(init_from=str(start))
    fit(module, Transitions(seed=1, reward=5.0), 3).save_checkpoint(tmp_path / "tuned.ckpt")
    before = state(module)
    resumed = policy(init_from=str(start))
    fit(resumed, Transitions(seed=0), 3, ckpt_path=tmp_path / "tuned.ckpt")
    assert resumed.init_from is None
    assert changed(before, state(resumed)) == set()  # statistics included


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        ({"num_skills": 8}, ["model.num_skills is 8", "trained with 4", "data.skill"]),
        ({"hidden_dims": [8, 8]}, ["model.hidden_dims is [8, 8]", "--model.hidden_dims=[16]"]),
        ({"dim": 5, "trainable": "actor"}, ["value.0.weight", "train critic too"]),
    ],
)
def test_a_start_of_a_policy_that_makes_no_sense_is_refused(start, settings, parts):
    with pytest.raises(UserError) as caught:
        policy(**{"init_from": str(start), **settings})
    assert [part for part in parts if part not in str(caught.value)] == []


def test_freezing_part_of_a_policy_that_was_never_trained_is_refused():
    with pytest.raises(UserError, match=r"model.trainable is \['actor'\].*--model.init_from=CHECKPOINT"):
        fit(policy(trainable=["actor"]), Transitions(), 1)
