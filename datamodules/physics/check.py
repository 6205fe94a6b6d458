"""Does a recording fit an environment? Puts the simulator into recorded states and compares one step.

    recorded    s0 ── a0 ──► s1         s7 ── a7 ──► s8          N steps from all over the file
                │            ▲          │            ▲
    simulated   s0 ── a0 ──► s1'        s7 ── a7 ──► s8'         error = |s' - s|, per dimension

In the right physics the two differ by the rounding of stored numbers, in the wrong one by a good part of what a step
changes. An error is reported relative to that change: the 95 % quantile of |error|, divided by the root mean square of
the change (recorded or simulated, whichever is larger). A recording fits when the worst dimension is within the limit.

The kitchen's observations are noisy. There a second simulation starts from states with the same amount of noise added,
and its difference does not count as an error; dimensions that move less than their noise are not judged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from datamodules.physics.resimulate import blur, simulate
from datamodules.physics.states import RecordedSteps, draw_steps
from datamodules.sources import resolve_task
from datamodules.validation import DataError
from dds_lightning.envs.physics import mujoco
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of
from dds_lightning.tasks.env import open_env

LIMIT = 0.01
"""Relative error up to which a noiseless recording fits. Rounding to 32 bits causes at most 3e-5; 10 % more gravity
at least 0.017."""

NOISY_LIMIT = 0.1
"""The same where observations are noisy: the right physics stays below 0.01, 10 % less speed causes 0.27 or more."""

NOISE_MARGIN = 2.0
"""How many times the effect of noise is subtracted from an error: a single draw of it is not the largest."""

AT_REST = 1e-7
"""A dimension is not judged unless steps change it by more than this (root mean square)."""

REWARD_TOLERANCE = 0.01
"""Rewards agree when they differ by no more than this."""

REWARD_SHARE = 0.05
"""Share of rewards that may differ, among the steps that end an episode and among the others."""

CONTACTS = 2.0
"""Relative errors above this have other causes than contact margins, which cause at most 1.2."""

MARGINS = {0.5: "halved", 2.0: "doubled"}
"""Before MuJoCo 3.5 a contact begins at the larger of two bodies' margins, since then at their sum."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RewardReplay:
    """How recorded rewards compare with the environment's.

    Attributes:
        falls: Number of steps that end an episode.
        falls_differ: How many of them have a different reward.
        others: Number of other steps.
        others_differ: How many of those have a different reward.
    """

    falls: int
    falls_differ: int
    others: int
    others_differ: int

    @property
    def fit(self) -> bool:
        """Whether few enough rewards differ."""
        return self.falls_differ <= REWARD_SHARE * self.falls and self.others_differ <= REWARD_SHARE * self.others

    def __str__(self) -> str:
        """Format the comparison for people."""
        where = f"{self.others_differ} of {self.others} steps"
        if self.falls:
            where = (
                f"{self.falls_differ} of the {self.falls} steps that end an episode and in {self.others_differ} of the "
                f"{self.others} others"
            )
        return f"rewards differ by more than {REWARD_TOLERANCE:g} in {where}: {_verdict(self.fit)}"


@dataclass(frozen=True, eq=False)
class PhysicsReplay:
    """The same recorded steps in one physics.

    Attributes:
        task: The variant whose environment was stepped.
        margins: Factor on its contact margins; 1 leaves the environment unchanged.
        dimensions: One row per dimension: `dimension` (column of the recorded observations), `name`, `change` (root
            mean square of a step's), `error` (median), `error_95` (95 % quantile), `relative` (NaN where nothing
            moves), `judged` (whether it decides).
        limit: Largest relative error that fits.
        rewards: Comparison of the rewards; None if they are computed from the data, not by the environment.
    """

    task: Task
    margins: float
    dimensions: pd.DataFrame
    limit: float
    rewards: RewardReplay | None

    @property
    def error(self) -> float:
        """Relative error of the worst dimension."""
        return float(self.dimensions["relative"][self.dimensions["judged"]].max())

    @property
    def physics_fit(self) -> bool:
        """Whether steps lead to the recorded states."""
        return self.error <= self.limit

    @property
    def fit(self) -> bool:
        """Whether both states and rewards fit."""
        return self.physics_fit and (self.rewards is None or self.rewards.fit)

    @property
    def name(self) -> str:
        """The task's name in this physics, with what was changed in it."""
        changed = f" with contact margins {MARGINS[self.margins]}" if self.margins != 1 else ""
        return f"{self.task.name}{changed}"

    def lines(self) -> list[str]:
        """The verdict for people."""
        found = [f"{self.name} ({self.task.env_id}): relative error {self.error:.2g}: {_verdict(self.physics_fit)}"]
        if self.rewards is not None:
            found.append(f"{self.name}: {self.rewards}")
        return found

    def facts(self) -> dict[str, Any]:
        """The verdict for programs."""
        rewards = self.rewards and {**vars(self.rewards), "verdict": _verdict(self.rewards.fit)}
        return {
            "task": self.task.name,
            "environment": self.task.env_id,
            "contact margins": self.margins,
            "relative error": self.error,
            "limit": self.limit,
            "physics": _verdict(self.physics_fit),
            "rewards": rewards,
            "verdict": _verdict(self.fit),
            "dimensions": self.dimensions,
        }


@dataclass(frozen=True, eq=False)
class ReplayReport:
    """What a replay found.

    Attributes:
        spec: The data.
        task: The task in the variant that the data claim to come from.
        steps: Number of steps that were replayed.
        results: One for `task`, one for each other variant; if the states fit none of these, also those with other
            contact margins that they do fit.
        notes: Remarks for the user, one sentence each.
    """

    spec: str
    task: Task
    steps: int
    results: tuple[PhysicsReplay, ...]
    notes: tuple[str, ...]

    @property
    def fit(self) -> bool:
        """Whether the data fit the task as it is."""
        return self.results[0].fit

    @cached_property
    def dimensions(self) -> pd.DataFrame:
        """The dimensions in the task's physics: those that decide, worst first, then the others."""
        table = self.results[0].dimensions
        return table.sort_values(["judged", "relative"], ascending=False, kind="stable", ignore_index=True)

    def table(self) -> pd.DataFrame:
        """Return `dimensions` with readable headings, without those that do not move."""
        headings = {
            "change": "a step changes",
            "error": "error, median",
            "error_95": "error, 95 %",
            "relative": "relative",
        }
        moving = self.dimensions.dropna(subset="relative")
        return moving[["dimension", "name", *headings]].rename(columns=headings)

    def lines(self) -> list[str]:
        """Return a verdict for every physics, the notes, and the overall verdict."""
        return [line for result in self.results for line in result.lines()] + [*self.notes, self.sentence()]

    def sentence(self) -> str:
        """The verdict in one sentence."""
        first, others = self.results[0], [result for result in self.results[1:] if result.fit]
        if first.fit:
            also = "".join(f"; {result.name} as well" for result in others)
            return f"{self.spec} fits {self.task.name} (relative error {first.error:.2g} in {first.task.env_id}){also}"
        if first.physics_fit:
            reason = f"steps lead to the environment's states, but {str(first.rewards).partition(':')[0]}"
        else:
            worst = self.dimensions.iloc[0]
            reason = f"{worst['name']} errs by {worst['relative']:.0%} of what a step changes"
        where = " and ".join(result.name for result in others)
        remedy = f"it fits {where}" if others else "none of the task's environments fits"
        if others and all(result.margins != 1 for result in others):
            remedy += (
                ", so it was recorded with another version of MuJoCo (before 3.5 a contact begins at the larger of two "
                f"bodies' margins, since then at their sum; installed is {mujoco.__version__})"
            )
        return f"{self.spec} does not fit {self.task.name}: {reason}; {remedy}"

    def facts(self) -> dict[str, Any]:
        """Everything for programs."""
        return {
            "steps": self.steps,
            "verdict": _verdict(self.fit),
            "physics": [result.facts() for result in self.results],
            "notes": self.notes,
        }


def replay_check(spec: str, task: Task | str, steps: int = 200, seed: int = 0) -> ReplayReport:
    """Replay recorded steps in every physics of a task and say which of them they were recorded in.

    Only numbers are read from the file; environments are those of the task table. In locomotion a quarter of the steps
    end an episode, if there are that many, because versions of an environment pay different rewards there.

    Args:
        spec: As in `load_trajectories`.
        task: The task that the data should fit.
        steps: Number of steps; fewer if the recording is shorter.
        seed: Seed of the draw.

    Raises:
        UserError: The source or the task is unknown, or steps is below 1.
        DataError: The data are damaged, belong to another task, or have no step that allows a verdict.
    """
    task = resolve_task(spec, task)
    recorded = draw_steps(spec, task, steps, seed)
    others = [task.variant(name) for name in task.variants if name != task.physics]
    results = [_replay(one, recorded) for one in (task, *others)]
    if not any(result.physics_fit for result in results):
        near = [result.task for result in results if result.error < CONTACTS]
        results += [result for one in near for result in _replay_margins(one, recorded)]
    if not np.isfinite(results[0].error):
        raise DataError(f"data '{spec}': none of {steps} steps moves the body more than noise does: no verdict")
    count = len(recorded.rewards)
    return ReplayReport(spec, task, count, tuple(results), recorded.notes)


# ---------------------------------------------------------------------- one physics


def _replay(task: Task, recorded: RecordedSteps) -> PhysicsReplay:
    with open_env(task) as env:
        inner: Any = env.unwrapped
        return _compare(task, inner, recorded)


def _replay_margins(task: Task, recorded: RecordedSteps) -> Iterator[PhysicsReplay]:
    """Yield the physics with other contact margins that the recorded states fit."""
    with open_env(task) as env:
        inner: Any = env.unwrapped
        margins = inner.model.geom_margin
        original = margins.copy()
        touching = original[(inner.model.geom_contype | inner.model.geom_conaffinity) != 0]
        if touching.min() == 0 or np.ptp(touching) != 0:  # the sum is twice the larger only if all are equal
            return
        for factor in MARGINS:
            margins[:] = factor * original
            result = _compare(task, inner, recorded, factor)
            if result.physics_fit:
                yield result


def _compare(task: Task, inner: Any, recorded: RecordedSteps, margins: float = 1.0) -> PhysicsReplay:
    simulated, rewards = simulate(inner, recorded)
    return PhysicsReplay(
        task,
        margins,
        _dimensions(recorded, simulated, blur(inner, recorded, simulated)),
        NOISY_LIMIT if recorded.layout.noisy else LIMIT,
        _compare_rewards(recorded, rewards) if body_of(task).falls else None,
    )


def _dimensions(recorded: RecordedSteps, simulated: Floats, blur: tuple[Floats, Floats]) -> pd.DataFrame:
    known = np.isfinite(recorded.following).all(axis=1)
    before, after, simulated = recorded.observations[known, -1], recorded.following[known], simulated[known]
    names = recorded.layout.names
    table = pd.DataFrame({"dimension": np.arange(len(names)), "name": names})
    amplitude, effect = blur
    errors = np.abs(simulated - after)
    changes = [np.sqrt(np.mean((reached - before) ** 2, axis=0)) for reached in (after, simulated)]
    scale = np.maximum(*changes)
    moves = scale > np.maximum(NOISE_MARGIN * amplitude, AT_REST)
    worst = np.quantile(errors, 0.95, axis=0)
    excess = np.maximum(worst - NOISE_MARGIN * effect, 0.0)
    table["change"] = changes[0]
    table["error"] = np.median(errors, axis=0)
    table["error_95"] = worst
    table["relative"] = np.divide(excess, scale, out=np.full(len(names), np.nan), where=moves)
    table["judged"] = moves & (np.arange(len(names)) < (recorded.layout.judged or len(names)))
    return table


def _compare_rewards(recorded: RecordedSteps, rewards: Floats) -> RewardReplay:
    differ = np.abs(rewards - recorded.rewards) > REWARD_TOLERANCE
    ended = recorded.ended
    return RewardReplay(int(ended.sum()), int(differ[ended].sum()), int((~ended).sum()), int(differ[~ended].sum()))


def _verdict(fit: bool) -> str:
    return "fit" if fit else "misfit"
