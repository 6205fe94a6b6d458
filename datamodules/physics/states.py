"""Draws single steps from a recording, with the simulator's state before each, without loading the whole file.

| observations | qpos | qvel |
|---|---|---|
| hopper, walker2d, halfcheetah | without x, which no force depends on: 0 | all; cut to +-10 in the first two |
| antmaze (29), pointmaze (4) | all | all |
| kitchen, 59 as Minari stores them | all, with noise | all, with noise |
| kitchen, 60 as D4RL stores them | all, with noise | not recorded: differences of positions |

If a D4RL file has `infos/qpos` and `infos/qvel` for the same rows, the state is read from there: nothing is cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.sources.rows import Recording, open_recording
from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import StateLayout, body_of, state_layout

FALLS = 4
"""In locomotion one step in this many, at most, ends its episode: these are where versions of an environment differ."""

SPARE = 8
"""Factor on the steps read if some may be unusable because their velocities were cut when they were recorded."""

SAME = 1e-3
"""`infos` and observations of one state differ by no more than this, absolutely or relatively."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RecordedSteps:
    """Recorded steps, n of them; L is the layout's `lead`.

    Attributes:
        layout: The layout of the W columns.
        qpos: (n, nq) positions L steps before.
        qvel: (n, nv) velocities there.
        observations: (n, L + 1, W) up to the state that the step starts from.
        actions: (n, L + 1, A).
        following: (n, W) the state that the step led to; NaN if the file does not have it.
        rewards: (n,).
        ended: (n,) bool, whether the step terminated its episode.
        notes: Remarks for the user, one sentence each.
    """

    layout: StateLayout
    qpos: Floats
    qvel: Floats
    observations: Floats
    actions: Floats
    following: Floats
    rewards: Floats
    ended: NDArray[np.bool_]
    notes: tuple[str, ...] = ()


def draw_steps(spec: str, task: Task, count: int, seed: int = 0) -> RecordedSteps:
    """Draw steps from all over a recording; in locomotion a quarter of them end an episode, if there are that many.

    Args:
        spec: As in `load_trajectories`.
        task: The task from `resolve_task`, with the recording's observations and actions.
        count: Number of steps to draw; fewer are returned if the recording is shorter.
        seed: Seed of the draw.

    Raises:
        UserError: The count is below 1.
        DataError: The data are damaged, belong to another task, or hold no usable step.
    """
    if count < 1:
        raise UserError(f"steps to replay is {count}, expected at least 1")
    rng = np.random.default_rng(seed)
    with open_recording(spec, task, rng) as recording:
        return _draw(recording, task, count, rng)


# ---------------------------------------------------------------------- drawing


def _draw(recording: Recording, task: Task, count: int, rng: np.random.Generator) -> RecordedSteps:
    layout = state_layout(task, recording.width)
    falls = body_of(task).falls
    spare = SPARE if np.isfinite(layout.speed_limit) else 1
    rows, inner = [], []
    for episode, step in _choose(recording, layout.lead, count * spare, rng, falls=falls):
        start = step - layout.lead
        known = step < recording.known[episode]
        seen = recording.states(episode, start, step + 1 + known)[:, : len(layout.names)]
        actions, rewards = recording.taken(episode, start, step + 1)
        fell = bool(recording.ended[episode] and step == recording.steps[episode] - 1)
        # A repeated state stands for one that was not recorded.
        led = seen[-1] if known and not (fell and np.array_equal(*seen[-2:])) else np.full(len(layout.names), np.nan)
        rows.append((seen[: layout.lead + 1], actions, led, rewards[-1], fell))
        inner.append(recording.inner(episode, start))
    columns = [np.array(values, dtype=np.float64) for values in zip(*rows, strict=True)]
    for name, values in zip(("observations", "actions", "observations", "rewards"), columns, strict=False):
        if np.isinf(values).any() or (np.isnan(values).any() and values is not columns[2]):
            raise DataError(f"{recording.where}, {name}: expected finite numbers, got NaN or infinity")
    qpos, qvel, whole, notes = _states(layout, columns[0], inner, task.step_seconds)
    ended = columns[4] > 0
    few = [rng.permutation(np.flatnonzero(whole & kind)) for kind in (ended & falls, ~(ended & falls))]
    few[0] = few[0][: count // FALLS]
    kept = np.sort(np.append(few[0], few[1][: count - len(few[0])]))
    if not np.isfinite(columns[2][kept]).all(axis=1).any():
        raise DataError(
            f"{recording.where}: none of {len(rows)} steps leads from one complete recorded state to another"
        )
    observations, actions, following, rewards = (values[kept] for values in columns[:4])
    return RecordedSteps(layout, qpos[kept], qvel[kept], observations, actions, following, rewards, ended[kept], notes)


def _states(
    layout: StateLayout, observations: Floats, inner: list[Any], seconds: float
) -> tuple[Floats, Floats, NDArray[np.bool_], tuple[str, ...]]:
    """Return the simulator's states at the start of every replay: qpos, qvel, whether they are complete, and notes."""
    first = observations[:, 0]
    whole: NDArray[np.bool_] = np.ones(len(first), bool)
    if inner[0] is not None and all(_agrees(layout, state, seen) for state, seen in zip(inner, first, strict=True)):
        qpos, qvel = (np.array(part, dtype=np.float64) for part in zip(*inner, strict=True))
        return qpos, qvel, whole, ()
    qpos = np.pad(first[:, list(layout.positions)], ((0, 0), (layout.hidden, 0)))
    if layout.velocities:
        qvel = first[:, list(layout.velocities)]
        return qpos, qvel, whole & (np.abs(qvel) < layout.speed_limit).all(axis=1), ()
    # Four of the kettle's seven position numbers are a quaternion: assume that it does not spin.
    rates = (observations[:, 1] - first)[:, list(layout.positions)] / seconds
    note = (
        f"the file holds no velocities: they are estimated from positions {layout.lead} steps earlier and have "
        "mostly decayed since, so the verdict is weaker than with velocities"
    )
    return qpos, np.pad(rates[:, :-4], ((0, 0), (0, 3))), whole, (note,)


def _agrees(layout: StateLayout, inner: tuple[Floats, Floats], seen: Floats) -> bool:
    """Whether the simulator's state matches an observation; D4RL's recorders were not always in step."""
    if (len(inner[0]), len(inner[1])) != (layout.hidden + len(layout.positions), layout.degrees):
        return False
    recorded = [*layout.positions, *layout.velocities]
    expected = layout.observe(*inner)[recorded]
    near = np.abs(expected - seen[recorded]) <= SAME * (1 + np.abs(expected))
    return bool(near.all() and np.isfinite(inner[0]).all())


def _choose(
    recording: Recording, lead: int, count: int, rng: np.random.Generator, *, falls: bool
) -> list[tuple[int, int]]:
    """Return (episode, step) of the steps to read, in the order of the file; each has `lead` steps before it."""
    ends = np.flatnonzero(recording.ended & (recording.steps > lead)) if falls else np.zeros(0, np.int64)
    ends = rng.permutation(ends)[: count // FALLS]
    room = np.maximum(recording.known - lead, 0)
    total = int(room.sum())
    drawn = np.zeros(0, np.int64)
    if total:
        drawn = np.sort(rng.choice(total, min(count - len(ends), total), replace=False))
    episode = np.searchsorted(np.cumsum(room), drawn, side="right")
    step = drawn - (np.cumsum(room) - room)[episode] + lead
    pairs = {(int(e), int(t)) for e, t in zip(episode, step, strict=True)}
    pairs |= {(int(e), int(recording.steps[e]) - 1) for e in ends}
    if not pairs:
        raise DataError(f"{recording.where}: no step leads to a recorded state, so nothing can be replayed")
    return sorted(pairs)
