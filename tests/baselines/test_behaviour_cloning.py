"""Behaviour cloning learns what can be learnt, and its actor stays in the box."""

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from datamodules.segments import SegmentDataModule
from datamodules.trajectories import Trajectories
from dds_lightning.baselines.behaviour_cloning import BehaviourCloning, CloneActor, fit_clone
from dds_lightning.errors import UserError

MAP = torch.tensor([[0.4, -0.2], [0.1, 0.3], [-0.3, 0.2]])  # (O, A): actions are linear in observations


def linear_data(episodes: int = 8, steps: int = 60) -> Trajectories:
    random = np.random.default_rng(0)
    made = []
    for _ in range(episodes):
        observations = random.uniform(-1, 1, (steps + 1, 3)).astype(np.float32)
        ends = np.arange(steps) == steps - 1
        made.append(
            {
                "observations": observations,
                "actions": observations[:-1] @ MAP.numpy(),
                "rewards": np.zeros(steps, np.float32),
                "terminations": np.zeros(steps, bool),
                "truncations": ends,
            }
        )
    return Trajectories.from_episodes("linear", made)


def fit(module: BehaviourCloning, steps: int, **options) -> BehaviourCloning:
    data = SegmentDataModule.from_trajectories(linear_data(), horizon=5, batch_size=64, **options)
    trainer = pl.Trainer(
        max_steps=steps,
        max_epochs=-1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        accelerator="cpu",
        limit_val_batches=0,
        check_val_every_n_epoch=None,
    )
    trainer.fit(module, datamodule=data)
    return module


def test_the_clone_learns_a_linear_map_in_a_few_steps():
    torch.manual_seed(0)
    clone = BehaviourCloning(3, 2, hidden_dims=[32, 32], lr=1e-2)
    x = 2 * torch.rand(256, 3) - 1
    before = (clone(x) - x @ MAP).square().mean().item()
    fit(clone, 200)
    after = (clone(x) - x @ MAP).square().mean().item()
    assert after < 1e-3 < before


def test_statistics_come_from_the_data():
    clone = fit(BehaviourCloning(3, 2, hidden_dims=[4]), 1)
    assert clone.normaliser.std.tolist() == pytest.approx([0.577] * 3, abs=0.05)  # uniform on -1..1
    assert clone.action_box.low.tolist() == [-1.0, -1.0]


def test_the_loss_is_the_mean_square_in_the_unit_box():
    clone = BehaviourCloning(1, 1, hidden_dims=[])
    clone.action_box.fit(torch.tensor([0.0]), torch.tensor([4.0]))
    torch.nn.init.zeros_(clone.net[0].weight)
    torch.nn.init.constant_(clone.net[0].bias, 0.5)
    batch = {"observations": torch.zeros(1, 2, 1), "actions": torch.tensor([[[4.0], [2.0]]])}
    mean = np.tanh(0.5)  # the actions are 1 and 0 in the unit box
    assert clone.loss(batch).item() == pytest.approx(((1 - mean) ** 2 + mean**2) / 2, rel=1e-6)
    assert clone(torch.zeros(1, 1)).item() == pytest.approx(2 + 2 * mean, rel=1e-6)


def test_the_actor_acts_inside_the_box_for_any_observation():
    torch.manual_seed(0)
    clone = BehaviourCloning(3, 2, hidden_dims=[16])
    clone.action_box.fit(torch.tensor([-0.5, 0.0]), torch.tensor([0.5, 3.0]))
    actor = CloneActor(clone)
    actor.reset(5, seed=0)
    observations = np.random.default_rng(0).normal(0, 1e4, (5, 3)).astype(np.float32)
    actions = actor.act(observations, np.zeros(5, bool), np.arange(5)).actions
    assert actions.shape == (5, 2)
    assert actions.dtype == np.float32
    assert (actions >= [-0.5, 0.0]).all()
    assert (actions <= [0.5, 3.0]).all()
    np.testing.assert_allclose(actor.act(observations[3:], np.ones(2, bool), np.array([3, 4])).actions, actions[3:])


def test_a_clone_without_statistics_says_so():
    module = BehaviourCloning(3, 2, hidden_dims=[4])
    trainer = pl.Trainer(logger=False, enable_checkpointing=False, accelerator="cpu", max_steps=1)
    batch = {"observations": torch.zeros(2, 5, 3), "actions": torch.zeros(2, 5, 2)}
    with pytest.raises(UserError, match="no observation statistics"):
        trainer.fit(module, DataLoader([batch], batch_size=None))


@pytest.mark.parametrize(("setting", "value"), [("lr", 0.0), ("hidden_dims", [8, 0])])
def test_settings_that_cannot_work_are_named(setting, value):
    with pytest.raises(UserError, match=f"model.{setting} is"):
        BehaviourCloning(3, 2, **{setting: value})


def test_fit_clone_writes_a_checkpoint_that_acts_alike_and_is_not_trained_twice(tmp_path, monkeypatch):
    import datamodules.segments
    from dds_lightning.tasks import get_task

    task = get_task("pointmaze-umaze-diverse")
    random = np.random.default_rng(0)
    steps = 40
    episode = {
        "observations": random.uniform(-1, 1, (steps + 1, 4)).astype(np.float32),
        "actions": random.uniform(-1, 1, (steps, 2)).astype(np.float32),
        "rewards": np.zeros(steps, np.float32),
        "terminations": np.zeros(steps, bool),
        "truncations": np.arange(steps) == steps - 1,
    }
    data = Trajectories.from_episodes("two", [episode] * 2)
    monkeypatch.setattr(datamodules.segments, "load_trajectories", lambda spec, task: data.for_task(task))
    options = {"steps": 4, "batch_size": 16, "hidden_dims": [8], "progress": False}
    path = fit_clone(task, "local:anything", tmp_path / "clone", **options)
    assert path == tmp_path / "clone" / "last.ckpt"
    observations = random.uniform(-1, 1, (3, 4)).astype(np.float32)
    actions = CloneActor.load(path).act(observations).actions
    written = path.read_bytes()
    assert fit_clone(task, "local:anything", tmp_path / "clone", **options) == path
    assert path.read_bytes() == written
    fit_clone(task, "local:anything", tmp_path / "again", **options)
    np.testing.assert_array_equal(CloneActor.load(tmp_path / "again" / "last.ckpt").act(observations).actions, actions)
