"""Evidence about stages: shares of episodes, ranks of values, and how far a policy has moved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from datamodules.collect.planner import planner_for
from datamodules.relabelled import RelabeledDataModule
from datamodules.trajectories import Trajectories
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from dds_lightning.study.evidence import data_evidence, policy_evidence, policy_shift
from dds_lightning.tasks import get_task

SMALL = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 8}


def walks(lengths, terminated) -> Trajectories:
    """Episodes along one axis; every step pays its position."""
    episodes = []
    for steps, fell in zip(lengths, terminated, strict=True):
        last = np.arange(steps) == steps - 1
        place = np.linspace(0.0, 1.0, steps + 1, dtype=np.float32)
        episodes.append(
            {
                "observations": np.stack([place, np.ones_like(place)], axis=1),
                "actions": np.zeros((steps, 1), np.float32),
                "rewards": place[1:],
                "terminations": last & fell,
                "truncations": last & (not fell),
            }
        )
    return Trajectories.from_episodes("walks", episodes)


def test_episodes_that_end_early_and_those_that_say_why():
    task = get_task("hopper-medium")  # at most 1000 steps
    assert data_evidence(walks([1000, 100, 50, 899], [False, True, False, False]), task) == {
        "ends_early": 0.75,
        "terminates": 0.25,
    }


def test_the_way_through_a_maze_at_the_pace_of_the_data():
    """Two walks at 0.1 m a step, one of them swaying across its way: 12 cells of 1 m, in 120 of 800 steps."""
    task = get_task("pointmaze-large-diverse")
    along = np.arange(201, dtype=np.float32) * 0.1
    episodes = [
        {
            "observations": np.stack([along, sway * (-1.0) ** np.arange(201), 0 * along, 0 * along], axis=1),
            "actions": np.zeros((200, 2), np.float32),
            "rewards": np.zeros(200),
            "terminations": np.zeros(200, bool),
            "truncations": np.arange(200) == 199,
        }
        for sway in (0.0, 0.02)
    ]
    cells = len(planner_for(task.maze_map).path(task.start_cell, task.goal_cell)) - 1
    found = data_evidence(Trajectories.from_episodes("walks", episodes), task)
    assert found["way_share"] == pytest.approx(cells / 0.1 / task.max_episode_steps, rel=0.02)


def relabelled(trajectories, tmp_path, gamma) -> RelabeledDataModule:
    """All of them as transitions under some skills."""
    torch.manual_seed(0)
    skill = SkillModule(2, 1, horizon=3, num_skills=4, **SMALL)
    path = tmp_path / "skill.ckpt"
    torch.save({"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}, path)
    data = RelabeledDataModule.from_trajectories(
        trajectories, str(path), gamma=gamma, discount="per_step", validation_fraction=0.0
    )
    data.prepare_data()
    data.setup()
    return data


def test_the_critic_is_ranked_by_returns_to_go(tmp_path):
    data = relabelled(walks([40, 40], [False, False]), tmp_path, gamma=0.5)
    policy = PolicyModule(2, 4, hidden_dims=[8], awr="regression")
    policy.v = lambda observations: observations[:, 0]  # returns to go rise along the way, but for the last steps
    assert policy_evidence(data, policy) == {"critic_rank": pytest.approx(1.0, abs=0.05)}
    policy.v = lambda observations: -observations[:, 0]
    assert policy_evidence(data, policy)["critic_rank"] == pytest.approx(-1.0, abs=0.05)
    policy.v = lambda observations: torch.zeros(len(observations))
    assert policy_evidence(data, policy)["critic_rank"] == 0.0


def test_a_recording_that_is_cut_off_does_not_end_what_every_step_costs(tmp_path):
    """Ten bodies rest at ten places; a step costs 1, and the goal is the farther the lower their place."""
    places = np.linspace(0.0, 1.0, 10, dtype=np.float32)
    resting = walks([20] * 10, [False] * 10)
    observations = np.repeat(np.stack([places, 1 + 0 * places], axis=1), 21, axis=0)
    data = relabelled(
        replace(resting, observations=observations, rewards=np.full(200, -1.0, np.float32)), tmp_path, gamma=0.99
    )
    policy = PolicyModule(2, 4, hidden_dims=[8], awr="regression")
    policy.v = lambda observations: -(1 - 0.99 ** (100 * (1 - observations[:, 0]))) / 0.01
    assert policy_evidence(data, policy)["critic_rank"] > 0.9


def test_the_policy_of_the_data_is_asked_about_held_out_skills(tmp_path):
    """An actor with equal logits gives each of four codes a quarter; shares are those of the training data."""
    torch.manual_seed(0)
    skill = SkillModule(2, 1, horizon=3, num_skills=4, **SMALL)
    path = tmp_path / "skill.ckpt"
    torch.save({"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}, path)
    data = RelabeledDataModule.from_trajectories(walks([40] * 4, [False] * 4), str(path), validation_fraction=0.5)
    data.prepare_data()
    data.setup()
    policy = PolicyModule(2, 4, hidden_dims=[8], awr="closed_form")
    for parameter in policy.actor.parameters():
        torch.nn.init.zeros_(parameter)
    found = policy_evidence(data, policy)
    assert found["beta_loss"] == pytest.approx(math.log(4), abs=1e-5)
    counts = torch.bincount(data.transitions.codes[data.train_index], minlength=4).float()
    shares = (counts / counts.sum()).clamp_min(1e-6)
    held = data.transitions.codes[data.validation_index]
    assert found["share_loss"] == pytest.approx(-shares[held].log().mean().item(), abs=1e-5)


def test_the_shift_runs_from_the_datas_policy_to_the_critics_best_code():
    torch.manual_seed(0)
    policy = PolicyModule(2, 4, hidden_dims=[16], awr="closed_form", alpha=0.0)
    states = torch.randn(200, 2)
    shifts = []
    for alpha in (0.0, 1.0, 10.0, 1e4):
        policy.hparams.alpha = alpha
        shifts.append(policy_shift(policy, states, policy.actor(policy.embed(states))))
    assert shifts[0] == pytest.approx(0.0, abs=1e-6)
    assert shifts == sorted(shifts)
    assert shifts[-1] == pytest.approx(1.0, abs=0.02)
