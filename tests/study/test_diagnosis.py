"""What the behaviour policy would have scored, by hand."""

import numpy as np
import pytest

from datamodules.trajectories import Trajectories
from dds_lightning.envs.kitchen import SUBTASKS, goal_vector
from dds_lightning.study.diagnosis import behaviour_scores
from dds_lightning.tasks import get_task


def trajectories(task, observations, rewards):
    episodes = [
        {
            "observations": seen,
            "actions": np.zeros((len(paid), task.action_dim), np.float32),
            "rewards": np.asarray(paid, float),
            "terminations": np.zeros(len(paid), bool),
            "truncations": np.arange(len(paid)) == len(paid) - 1,
        }
        for seen, paid in zip(observations, rewards, strict=True)
    ]
    return Trajectories.from_episodes("by hand", episodes)


def test_a_runners_behaviour_is_scored_by_its_return():
    task = get_task("hopper-medium")
    rewards = [[1000.0, 617.15], [3234.3]]
    data = trajectories(task, [np.zeros((len(r) + 1, 11), np.float32) for r in rewards], rewards)
    middle = 100 * (1617.15 + 20.272305) / (3234.3 + 20.272305)
    assert behaviour_scores(data, task) == {"mean": pytest.approx((middle + 100) / 2, abs=0.01), "best": 100.0}


def test_in_the_kitchen_a_subtask_counts_once_however_long_it_stays_done():
    task = get_task("kitchen-partial")
    seen = np.zeros((5, 60), np.float32)
    seen[:, 30:] = goal_vector(task.subtasks)
    busy = seen.copy()
    for name, start in (("microwave", 1), ("slide cabinet", 3)):
        columns, values = SUBTASKS[name]
        busy[start:, list(columns)] = values
    data = trajectories(task, [seen, busy], [[0.0] * 4, [1.0, 1.0, 2.0, 2.0]])
    assert behaviour_scores(data, task) == {"mean": 25.0, "best": 50.0}
