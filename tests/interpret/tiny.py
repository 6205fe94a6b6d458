"""Small models and skills whose meaning is known, for the tests of this folder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from datamodules.trajectories import Trajectories
from dds_lightning.agent import DDSAgent
from dds_lightning.interpret.views import VIEWS
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from tests.recordings import record

SIZES = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 4}


def tiny_skill(task, num_skills=3, horizon=5, seed=0, **settings):
    """An untrained skill model of a task, its normaliser and codebook filled in."""
    torch.manual_seed(seed)
    width = task.observation_dim
    skill = SkillModule(width, task.action_dim, horizon=horizon, num_skills=num_skills, **SIZES, **settings)
    skill.normaliser.fit(torch.zeros(width), torch.ones(width))
    if skill.discrete:
        skill.bottleneck.set_vectors(torch.arange(num_skills), torch.randn(num_skills, SIZES["skill_dim"]))
        skill.bottleneck.initted.fill_(True)
    return skill.eval()


def tiny_agent(task, **settings):
    """An untrained agent of a task."""
    skill = tiny_skill(task, **settings)
    policy = PolicyModule(task.observation_dim, skill.num_skills, hidden_dims=[8])
    policy.normaliser.fit(torch.zeros(task.observation_dim), torch.ones(task.observation_dim))
    return DDSAgent(skill, policy.eval())


def recorded(task, steps=120, **settings):
    """Real steps of a task as data."""
    return Trajectories.from_episodes("recorded", record(task, steps, **settings))


class Compass:
    """Four skills of a point mass: right, up, left, down; the encoder looks where it went."""

    horizon, num_skills = 6, 4
    ways = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])

    def decode(self, observations, codes, noise_scale=None, generator=None):
        return self.ways[codes]

    def encode(self, observations, actions, lengths=None):
        last = self.horizon - 1 if lengths is None else lengths - 1
        rows = torch.arange(len(observations))
        moved = observations[rows, last, :2] - observations[:, 0, :2]
        return (moved @ self.ways.T).argmax(dim=-1)


class Deaf(Compass):
    """Skills that all do the same."""

    def decode(self, observations, codes, noise_scale=None, generator=None):
        return self.ways[torch.zeros_like(codes)]


class Played:
    """One skill that takes given actions (T, A), one after the other, whatever it sees."""

    num_skills = 1

    def __init__(self, actions):
        self.actions, self.horizon, self.turn = torch.as_tensor(np.asarray(actions)), len(actions), 0

    def decode(self, observations, codes, noise_scale=None, generator=None):
        self.turn += 1
        return self.actions[self.turn - 1].expand(len(codes), -1)

    def encode(self, observations, actions, lengths=None):
        return torch.zeros(len(observations), dtype=torch.int64)


def hold_shorter(patch, **seconds):
    """Let pictures of a robot hold their skills for so many seconds, because replays take time."""
    for name, held in seconds.items():
        patch.setitem(VIEWS, name, replace(VIEWS[name], held=held))
