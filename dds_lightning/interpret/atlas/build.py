"""The skill atlas: everything about the skills of one checkpoint, measured, drawn, and written as one HTML file.

```
 data ──► code_segments ──► skill_table, transitions, where     ┐
 states ─► replay_codes ──► trajectories, strobes, clips         ├─► Atlas ─► atlas_page.page ─► atlas.html
        └► code_recovery ─► confusion, accuracy, information     │
 rollout ─► stitching, single skills · policy ─► value map       ┘
```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from datamodules.trajectories import Trajectories
from dds_lightning.interpret.atlas.pictures import Announce, AtlasPictures, Picture
from dds_lightning.interpret.draw import charts
from dds_lightning.interpret.measure import statistics
from dds_lightning.interpret.measure.comparison import compare_recovery
from dds_lightning.interpret.measure.recovery import Recovery, RoundTrip, code_recovery, round_trip
from dds_lightning.interpret.measure.replay import play_skills, simulator
from dds_lightning.interpret.measure.states import draw_states
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import has_state

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent
    from dds_lightning.skill import SkillModule

STATES, STARTS = 32, 8
"""Number of states from which codes are recovered, and of those among which a body's starting state is chosen."""
DISCRETE, CONTINUOUS = "discrete skills", "continuous skills, clustered"
"""Names of the models in a comparison, by kind."""
RARE = 0.1
"""A code is in use if its share of the data is at least this fraction of 1 / K."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """Everything known about a checkpoint's skills.

    Attributes:
        task: The task in which they were replayed.
        horizon: H.
        table: One row per code: `statistics.skill_table` with `spread` and `apart` (`decoder_diversity`), `nearest` and
            `near` (code and its distance in the codebook), `again` and `recovered` (shares of the round trip's and
            of the recovery's replays; NaN for codes not in use), and, if they played alone, `alone` (per cent that
            succeed, else the normalised score) and `alone_episodes`.
        trip: How well codes are recognised from behaviour in states where the data use them.
        recovery: The same from any state, for the codes in use.
        transitions: (K, K), see `statistics.transition_matrix`.
        distances: (K, K), see `statistics.code_distances`.
        comparison: Table from `recovery.compare_recovery`, if other models were given.
        segments: Number of segments of the data that were encoded.
        pictures: Pictures of the page, by name.
        clips: The clip of each code.
    """

    task: Task
    horizon: int
    table: pd.DataFrame
    trip: RoundTrip
    recovery: Recovery
    transitions: NDArray[np.float64]
    distances: NDArray[np.float64]
    comparison: pd.DataFrame | None
    segments: int
    pictures: dict[str, Picture]
    clips: dict[int, Picture]

    def facts(self) -> dict[str, Any]:
        """The numbers, without pictures."""
        trip, recovery = (
            {**found.facts(), "confusion": found.confusion, "replayed": found.codes}
            for found in (self.trip, self.recovery)
        )
        return {
            "task": self.task.name,
            "horizon": self.horizon,
            "num_skills": len(self.table),
            "segments": self.segments,
            "skills": self.table,
            "round_trip": trip,
            "recovery": recovery,
            "transitions": self.transitions,
            "distances": self.distances,
            "comparison": self.comparison,
        }


def make_atlas(
    agent: DDSAgent,
    task: Task,
    trajectories: Trajectories,
    result: RolloutResult | None = None,
    main: str | None = None,
    singles: str | None = None,
    others: Sequence[tuple[str, SkillModule]] = (),
    states: int = STATES,
    segments: int = 20_000,
    seed: int = 0,
    announce: Announce = lambda message: None,
) -> Atlas:
    """Measure and draw everything.

    Args:
        agent: The skills; its policy too, if it has one.
        task: The task in which they are replayed.
        trajectories: The data of that task.
        result: Episodes of the policy and of single skills, with paths; without it they are left out.
        main: The contestant of `result` whose episodes are shown.
        singles: The contestant of `result` whose parts are single skills.
        others: Names and models to compare with, see `recovery.compare_recovery`.
        states: Number of states from which every code is replayed, and of segments for each code's round trip.
        segments: Approximate number of segments of the data to encode.
        seed: Seed of all draws.
        announce: Called with a message before each step.

    Raises:
        UserError: The model does not fit the data.
    """
    skill = agent.skill
    announce("encoding the data")
    coded = statistics.code_segments(skill, trajectories, segments, seed)
    table = statistics.skill_table(task, coded, agent.policy)
    used = np.flatnonzero(coded.share >= RARE / skill.num_skills)
    distances = statistics.code_distances(skill)
    table["nearest"] = statistics.nearest_codes(distances)
    table["near"] = distances[np.arange(len(distances)), table["nearest"]]
    if not has_state(task):
        announce("playing skills at random: the data do not hold the simulator's state")
    stage = trajectories if has_state(task) else play_skills(task, skill, seed=seed)
    drawn = draw_states(task, stage, states, seed)
    spread = statistics.decoder_diversity(skill, drawn.observations, noise_scale=agent.noise_scale, seed=seed)
    table[["spread", "apart"]] = spread[["spread", "apart"]]
    with simulator(task) as env:
        announce("recognising codes from behaviour")
        trip = round_trip(task, skill, stage, states, agent.noise_scale, seed, env)
        recovery, _ = code_recovery(task, skill, drawn, used, agent.noise_scale, seed, env)
        for name, codes, shares in (
            ("again", trip.codes, trip.by_code),
            ("recovered", used, np.diag(recovery.confusion)),
        ):
            table[name] = pd.Series(shares, index=codes).reindex(table["code"]).to_numpy()
        if singles is not None and result is not None:
            table = table.join(_alone(task, result, singles), on="code")
        drawings = AtlasPictures(task, agent, env, seed, announce)
        drawings.skills(table, used, drawn.take(np.arange(min(STARTS, len(drawn)))))
        if result is not None and main is not None:
            drawings.episodes(result, main)
        drawings.values()
    announce("drawing")
    transitions = statistics.transition_matrix(coded)
    drawings.diversity(table)
    drawings.matrices(trip, recovery, transitions, distances, coded)
    comparison = None
    if others:
        rows = [(DISCRETE, skill), *others]
        comparison = compare_recovery(
            task, stage, rows, skill.num_skills, states, seed, lambda name: announce(f"comparing: {name}")
        )
        drawings.keep(
            "comparison",
            charts.plot_comparison(comparison),
            "A dot is a model, a bar the mean of the models of one name. Continuous skills were grouped into "
            f"{skill.num_skills} clusters, whose centres were replayed.",
            "Bars of round trip, recovery and information of each model, with control, chance and limit marked.",
        )
    return Atlas(
        task=task,
        horizon=skill.horizon,
        table=table,
        trip=trip,
        recovery=recovery,
        transitions=transitions,
        distances=distances,
        comparison=comparison,
        segments=len(coded.codes),
        pictures=drawings.pictures,
        clips=drawings.clips,
    )


def _alone(task: Task, result: RolloutResult, singles: str) -> pd.DataFrame:
    """Return how well each skill does by itself, indexed by code."""
    played = result.episodes[result.episodes["actor"] == singles]
    groups = played.groupby("final_code")
    goal = task.measures_success and not task.subtasks
    mean = 100 * groups["success"].mean().astype(float) if goal else groups["score"].mean()
    return pd.DataFrame({"alone": mean, "alone_episodes": groups.size()})
