"""The kitchen's two rewards: the number of subtasks done, which is learnt from, and +1 once for each, which is scored.

    state                    0   1   2   3   4   5
    microwave is open        .   .   x   x   x   x
    kettle is on the burner  .   .   .   x   .   x      one that slides off is no longer done
    step                       0   1   2   3   4
    done afterwards            0   1   2   1   2        `relabel_subtasks`: learnt from
    done for the first time    0   1   1   0   0        `subtasks_completed` is their sum, 2: scored

Which of the two a recording has depends on its origin. gymnasium-robotics' environment gives the lower one, and the
upper one with `remove_task_when_completed=False`, as in Minari's published sets. D4RL's files give each row the number
done in that row's state: the upper one, a step later. All of them follow from the states, so they are counted there,
and every source of the same episode gives the same rewards.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datamodules.trajectories import Trajectories
from dds_lightning.envs.kitchen import subtasks_done
from dds_lightning.tasks import Task


def relabel_subtasks(trajectories: Trajectories, task: Task) -> Trajectories:
    """Give every step the number of the task's subtasks that are done in the state it reaches, 0 to M.

    Terminations stay: recordings of people go on, or end, when everything is done.

    Args:
        trajectories: Data of the kitchen; recorded rewards are ignored.
        task: The task whose M subtasks count.
    """
    return replace(trajectories, rewards=_done(trajectories, task).sum(axis=1).astype(np.float32))


def subtasks_completed(trajectories: Trajectories, task: Task) -> NDArray[np.int64]:
    """How many of the task's M subtasks were ever done in each episode, (E,): its environment's return."""
    ever = np.logical_or.reduceat(_done(trajectories, task), trajectories.step_offsets[:-1])
    return ever.sum(axis=1)


def _done(trajectories: Trajectories, task: Task) -> NDArray[np.bool_]:
    """Which subtasks are done after each step, (N, M)."""
    reached = np.ones(len(trajectories.observations), bool)
    reached[trajectories.observation_offsets[:-1]] = False  # no step leads to an episode's first state
    return subtasks_done(trajectories.observations[reached], task.subtasks)
