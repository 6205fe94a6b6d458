"""The pictures of a skill atlas: what each skill does, how they are strung together, where they are used."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.interpret import charts, clip, maze, stitching, strobe, values
from dds_lightning.interpret.body import body_frames, has_limbs
from dds_lightning.interpret.rendering import plot_rendered, render_frames
from dds_lightning.interpret.replay import BodyStates, Replays, junctions, replay_codes, rest_states
from dds_lightning.results import RolloutResult
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent
    from dds_lightning.interpret.recovery import Recovery, RoundTrip
    from dds_lightning.interpret.statistics import CodedSegments

DPI = 130
HELD = {"pointmaze": 1.0, "antmaze": 6.0, "locomotion": 1.0, "kitchen": 2.4}
"""Seconds that a skill is held to see what it does; whole skills are played."""
BODIES = {"antmaze": 4, "locomotion": 8, "kitchen": 6}
"""Bodies between the first and the last of a stroboscopic picture."""
STROBES = 4
"""Skills in a stroboscopic picture: the commonest, and those that move most differently from it and each other."""

Tell = Callable[[str], None]
"""Told in words what is being done."""


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        name: of its place in the page, a word.
        caption: what a reader should know of it.
        alt: what it shows, for whoever cannot see it.
        data: PNG or GIF.
        size: width and height in pixels.
        mime: of `data`.
    """

    name: str
    caption: str
    alt: str
    data: bytes = field(repr=False)
    size: tuple[int, int]
    mime: str = "image/png"


def different_codes(table: pd.DataFrame, used: NDArray[Any], count: int = STROBES) -> list[int]:
    """The commonest code, then those that move most differently from all chosen so far.

    Args:
        table: of `statistics.skill_table`.
        used: codes to choose among.
        count: how many.
    """
    names = [n for n in ("dx", "dy", "dz", "distance", "speed", "turn", "action", "change") if n in table]
    features = table.set_index("code").loc[used, names].fillna(0.0).to_numpy()
    features = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-9)
    share = table.set_index("code").loc[used, "share"].to_numpy()
    chosen = [int(share.argmax())]
    while len(chosen) < min(count, len(used)):
        away = np.linalg.norm(features[:, None] - features[chosen][None], axis=-1).min(axis=1)
        away[chosen] = -1.0
        chosen.append(int(away.argmax()))
    return [int(used[i]) for i in sorted(chosen)]


class Studio:
    """Makes the pictures of an atlas."""

    def __init__(self, task: Task, agent: DDSAgent, env: Any, seed: int, tell: Tell) -> None:
        self.task, self.agent, self.env, self.seed, self.tell = task, agent, env, seed, tell
        self.pictures: dict[str, Picture] = {}
        self.clips: dict[int, Picture] = {}
        whole = max(round(HELD.get(task.family, 2.0) / task.step_seconds / agent.horizon), 1)
        self.steps = whole * agent.horizon

    def keep(self, name: str, figure: Figure, caption: str, alt: str) -> None:
        """Keep a figure as a picture of the page."""
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
        size = tuple(int(side * DPI) for side in figure.get_size_inches())
        self.pictures[name] = Picture(name, caption, alt, file.getvalue(), size)  # type: ignore[arg-type]

    def _clip(self, code: int, data: bytes, alt: str) -> None:
        from PIL import Image

        with Image.open(io.BytesIO(data)) as image:
            self.clips[code] = Picture(f"clip-{code}", "", alt, data, image.size, "image/gif")

    def skills(self, table: pd.DataFrame, used: NDArray[Any], drawn: BodyStates) -> None:
        """What each skill does: trajectories or movement, and a clip of each."""
        task, seconds = self.task, self.steps * self.task.step_seconds
        self.tell("replaying the skills")
        maze_like = task.maze_map is not None
        states = rest_states(task, junctions(task)) if maze_like else drawn
        made = replay_codes(
            task, self.agent.skill, states, used, self.steps, self.agent.noise_scale, self.seed, self.env
        )
        self.tell("drawing the skills")
        if maze_like:
            positions = made.qpos[..., :2]
            for code in used:
                own = positions[made.codes == code]
                words = f"Clip: skill {code} from {len(own)} places of the maze at once, {seconds:g} seconds."
                self._clip(int(code), clip.replay_clip(task, own, int(code)), words)
            shown = (positions[:, 0], positions, made.codes, made.alive)
            self.keep(
                "starts_by_skill",
                maze.plot_starts_by_skill(task, *shown),
                f"One panel a skill: held for {seconds:g} s ({self.steps} steps) from {len(states)} places, the body "
                "at rest. Orange stars are the starts.",
                f"{len(used)} small mazes, each with the paths of one skill from {len(states)} starts.",
            )
            self.keep(
                "skills_by_start",
                maze.plot_skills_by_start(task, *shown, reach=_reach(task, positions)),
                "One panel a start, seen from near: every skill from the same place. A number is where it ended.",
                f"{len(states)} close-ups of the maze, each with the paths of {len(used)} skills from one start.",
            )
        if has_limbs(task):
            self._movement(table, used, made, clips=not maze_like)

    def _movement(self, table: pd.DataFrame, used: NDArray[Any], made: Replays, clips: bool) -> None:
        """Bodies under several skills from the same state: that in which they last longest and come furthest."""
        model = self.env.unwrapped.model
        rows = len(made.codes) // len(used)
        ends = made.qpos[np.arange(len(made.codes)), made.lengths]
        far = np.linalg.norm(ends[:, :2] - made.qpos[:, 0, :2], axis=1).reshape(-1, rows).mean(axis=0)
        state = int(np.lexsort((far, made.lengths.reshape(-1, rows).sum(axis=0)))[-1])
        own = made.take(made.states == state)
        bodies = {int(code): body_frames(model, qpos) for code, qpos in zip(own.codes, own.qpos, strict=True)}
        every = max(self.steps // BODIES.get(self.task.family, 6), 1)
        chosen = different_codes(table, used)
        moments = (
            f"a body every {every * self.task.step_seconds:.2g} s, the last one solid, lines are the ways of joints"
        )
        self.keep(
            "strobe",
            strobe.plot_strobes(self.task, {code: bodies[code] for code in chosen}, every),
            f"The same state, {len(chosen)} skills: {moments}. Drawn from the positions of the model's own bodies.",
            f"Stick figures of the body at several moments under skills {', '.join(map(str, chosen))}.",
        )
        if clips:
            for code, body in bodies.items():
                words = f"Clip: the body under skill {code} for {self.steps * self.task.step_seconds:g} seconds."
                self._clip(code, strobe.body_clip(self.task, body, code), words)
        self.tell("rendering, if a graphics driver is there")
        some = np.arange(0, self.steps + 1, every)
        series = own.take(np.isin(own.codes, chosen))
        rendered = render_frames(self.task, np.concatenate(series.qpos[:, some]))
        if rendered is not None:
            parts = np.cumsum(np.isfinite(series.qpos[:, some, 0]).sum(axis=1))[:-1]
            frames = dict(zip(map(int, series.codes), np.split(rendered, parts), strict=True))
            self.keep(
                "rendered",
                plot_rendered(self.task, frames, every),
                "The same moments as MuJoCo renders them.",
                f"Rendered pictures of the body under skills {', '.join(map(str, chosen))}.",
            )

    def episodes(self, result: RolloutResult, main: str) -> None:
        """How the policy strings skills together."""
        self.tell("drawing episodes")
        figure = stitching.plot_stitching(self.task, result, main)
        self.keep(
            "stitching",
            figure,
            "Each row of the timeline is an episode, each piece a skill in use, with its number where there is room.",
            f"Timeline of the skills that {main} chose in several episodes"
            + (", and two of these episodes over the maze." if self.task.maze_map is not None else "."),
        )
        if self.task.maze_map is not None:
            self.keep(
                "trajectories",
                maze.plot_trajectories(self.task, result, main),
                "Episodes over the maze, coloured by the skill in use; the numbers belong to one of them.",
                "Paths of several episodes over the maze, coloured by skill.",
            )

    def values(self) -> None:
        """V and the policy over a maze."""
        if self.task.maze_map is None or self.agent.policy is None:
            return
        self.tell("mapping values")
        self.keep(
            "values",
            values.plot_policy_map(self.task, self.agent, self.steps, self.seed, self.env),
            f"V of a body at rest. The number in a cell is the likeliest skill, the arrow where holding it for "
            f"{self.steps} steps led from there. V should rise steadily along the way to the goal.",
            "Heat map of the critic's value over the maze, in each cell the number and direction of the chosen skill.",
        )

    def matrices(
        self,
        trip: RoundTrip,
        recovery: Recovery,
        transitions: NDArray[Any],
        distances: NDArray[Any],
        coded: CodedSegments,
    ) -> None:
        """Tables between codes, and where each is used."""
        count = len(recovery.codes)
        self.keep(
            "trip",
            charts.plot_round_trip(trip),
            f"Round trip: {trip.segments} segments of the data for each code, the code held from the state in which "
            "each begins, and what happened encoded again. The diagonal is what was found again.",
            f"Confusion matrix of {len(trip.codes)} codes: {trip.accuracy:.0%} found again, chance {trip.chance:.0%}.",
        )
        self.keep(
            "recovery",
            charts.plot_recovery(recovery),
            f"Recovery: {count} codes, each held for {recovery.steps} steps from the same {recovery.states} states, "
            "wherever the data have been. Equal rows: there the state decides, not the code.",
            f"Confusion matrix of {count} codes: {recovery.accuracy:.0%} recovered, chance {recovery.chance:.0%}.",
        )
        self.keep(
            "transitions",
            charts.plot_transitions(transitions),
            "Per cent of a code's segments that are followed by a segment of each code.",
            "Matrix of how often each code follows each other code in the data.",
        )
        self.keep(
            "distances",
            charts.plot_distances(distances),
            "Codes with near vectors tend to do alike things.",
            "Matrix of the distances between the codebook's vectors.",
        )
        words = "A square is told where at least five segments begin." if self.task.maze_map is not None else ""
        self.keep(
            "where",
            charts.plot_where(self.task, coded),
            f"From {len(coded.codes):,} segments of the data, one every {self.agent.horizon} steps. {words}",
            "One panel a code: where in the state space the data's segments with that code begin.",
        )


def _reach(task: Task, positions: NDArray[Any]) -> float:
    """Half a window's side in metres in which nine of ten replays (N, T + 1, 2) stay, half a cell to two and a half."""
    away = np.nanmax(np.linalg.norm(positions - positions[:, :1], axis=-1), axis=1)
    return float(np.clip(1.2 * np.quantile(away, 0.9), 0.5 * task.cell_size, maze.REACH * task.cell_size))
