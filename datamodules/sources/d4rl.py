"""`d4rl:FILE`: D4RL's HDF5 files, flat rows of steps that do not say which environment they are from.

Row t holds the state before step t, its action, and what the step gave. The state after it is in row t + 1,
unless the recording was cut there:

    row              0      1      2      3      4      5
    observations     s0     s1     s2     s3     s0'    s1'
    actions          a0     a1     a2    (a3)    a0'    a1'
    timeouts         -      -      -      1      -      -
    terminals        -      -      -      -      -      1

    episode 0: s0 a0 s1 a1 s2 a2 s3          truncated; where a3 led is unknown, so that step is left out
    episode 1: s0' a0' s1' a1' s1'           terminated; see below

A file with `next_observations` says where each last step led, so none is lost. Without them a *termination* is
kept nevertheless: it shows the learner where the task ends. The state after it repeats the last one, and since
nothing is bootstrapped from there, its value never counts.

An episode ends at a terminal, at a time-out, at the end of the file, in mazes where the position jumps farther
than the body can move in one step (old files lack some time-outs), and where `next_observations` differ from the
next row. Where a file has neither time-outs nor `next_observations` (the kitchen's), episodes are cut at the
task's cap, as D4RL does.

AntMaze is different. The recorded ant walks on through the evaluation goal, and rewards and terminals were
computed afterwards, each from the position in the *next row*, whatever was recorded there:

    row              0      1      2      3      4      5      6
    on the goal      -      -     yes    yes     -      -     yes
    rewards          0      1      1      0      0      1      0
    terminals        0      1      1      0      0      1      0
    timeouts         -      -      -      -      -      1      -

    episode 0: s0 a0 s1 a1 s2                terminated: the reward of a1 is paid for s2
               s3                            left out, like all that stands on the goal
    episode 1: s4 a4 s5                      truncated: row 6 is another recording, so terminals[5] speaks of its
                                             first state, which is left out

So `terminals[t]` says that row t + 1 stands on the goal. Only where a recording ends without a time-out does a
terminal mean what it means elsewhere: the episode was over then and there.

Rewards stay as recorded; in the kitchen's files they count the subtasks done in the row's state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from datamodules.sources.d4rl_recording import open_d4rl
from datamodules.sources.d4rl_rows import Rows, read_all
from datamodules.sources.fetch import find_d4rl
from datamodules.sources.goal import cut_at_goal, ends_of
from datamodules.sources.hdf5 import open_hdf5
from datamodules.sources.source import Source
from datamodules.trajectories import Trajectories
from datamodules.validation import DataError
from datamodules.windows import ranges
from dds_lightning.tasks import Task


def load_d4rl(name: str, task: Task | None) -> Trajectories:
    """Read one of D4RL's files, or another file in the same layout; nothing in it is ever run.

    Args:
        name: Path of the file, or a name that `find_d4rl` knows.
        task: The task that the data must fit; None only checks that they are valid.

    Raises:
        DataError: For anything missing, damaged, dangerous or of another task.
    """
    path = find_d4rl(name)
    where = f"data set '{path.name}'"
    low, high = task.action_box() if task else (-1.0, 1.0)
    with open_hdf5(path, where) as file:
        rows = read_all(file, where, task, (low, high))
    if not (rows.last[:-1].any() or rows.terminals.any() or rows.timeouts.any()):
        raise DataError(
            f"{where}, terminals: none of the {len(rows.last)} rows is marked as an episode's last, there or in "
            "timeouts, so it has no complete episode"
        )
    return _episodes(rows, path.stem, where, low, high)


def _episodes(rows: Rows, name: str, where: str, low: ArrayLike, high: ArrayLike) -> Trajectories:
    """Cut rows into episodes; see the pictures above.

    S states are laid out first: those of the rows, and after a `last` row one more where it is known or where the
    task ended there. `cut_at_goal` then ends episodes where a state stands on the goal, or is such an end.
    """
    terminals, timeouts, last = rows.terminals, rows.timeouts, rows.last
    over = terminals & last & ~(timeouts & rows.walks_on)  # the task ended in what follows this very row
    extra = last if rows.following is not None else over
    row_of = np.repeat(np.arange(len(last)), 1 + extra)  # (S,)
    end_of = np.cumsum(1 + extra) - 1  # (N,) the last state that a row has part in
    added = np.zeros(len(row_of), bool)
    added[end_of[extra]] = True
    ended = np.zeros(len(row_of), bool)
    if rows.walks_on:
        ended[1:] = (terminals & (~last | timeouts))[row_of - 1][1:]
        ended[added] = False
    ended[end_of[over]] = True

    first, final, reached = cut_at_goal(ended, np.diff(np.append(-1, end_of[last])))
    if not len(first):
        raise DataError(f"{where}, observations: no row leads to another one, so it has no complete episode")
    lengths = final - first
    steps, states = row_of[ranges(first, lengths)], ranges(first, lengths + 1)
    observations = rows.observations[row_of[states]]
    if rows.following is not None:
        known = added[states]
        observations[known] = rows.following[np.searchsorted(np.flatnonzero(added), states[known])]
    terminations, truncations = ends_of(lengths, reached)
    return Trajectories(
        name=name,
        observations=observations,
        actions=rows.actions[steps],
        rewards=rows.rewards[steps],
        terminations=terminations,
        truncations=truncations,
        lengths=lengths,
        steps_left_out=len(last) - len(steps),
        action_low=np.full(rows.actions.shape[1], low, np.float32),
        action_high=np.full(rows.actions.shape[1], high, np.float32),
    )


D4RL = Source("FILE", "an HDF5 file in D4RL's layout", load_d4rl, find_d4rl, open_d4rl, "get or write the file anew")
