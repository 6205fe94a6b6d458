"""The pictures of a skill atlas: what each skill does, how the policy combines them, where they are used."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dds_lightning.interpret.draw import charts, clip, maze, stitching, strobe, values
from dds_lightning.interpret.draw.png import png_bytes
from dds_lightning.interpret.draw.rendering import plot_rendered, render_frames
from dds_lightning.interpret.measure.body import body_frames
from dds_lightning.interpret.measure.replay import Replays, replay_codes
from dds_lightning.interpret.measure.states import BodyStates, junctions, rest_states
from dds_lightning.interpret.views import view_of
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent
    from dds_lightning.interpret.measure.recovery import Recovery, RoundTrip
    from dds_lightning.interpret.measure.statistics import CodedSegments

DPI = 130
STROBES = 4
"""Number of skills in a stroboscopic picture."""

Announce = Callable[[str], None]
"""Receives a message about what is being done."""


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        name: Key of its place in the page.
        caption: What a reader should know about it.
        alt: Alternative text for people who cannot see it.
        data: The bytes of a PNG or GIF file.
        size: Width and height in pixels.
        mime: MIME type of `data`.
    """

    name: str
    caption: str
    alt: str
    data: bytes = field(repr=False)
    size: tuple[int, int]
    mime: str = "image/png"


def most_different(paths: NDArray[Any], share: NDArray[Any], count: int = STROBES) -> tuple[int, NDArray[np.int64]]:
    """Find the state from which some codes move most differently, and these codes.

    The distance between two codes is the root mean square over time of the difference between the body's positions,
    each in units of its spread over all replays; after the end of either replay they count as equal. From each state
    the commonest code is chosen first, then repeatedly the one farthest from those chosen; the state is that in which
    the two nearest of them are farthest apart.

    Args:
        paths: (C, S, T + 1, P) positions under C codes from S states; NaN after a replay's end.
        share: (C,) each code's share of the data.
        count: Number of codes; C at most.

    Returns:
        The number of the state, and the rows of the codes, ascending.
    """
    moved = paths - paths[:, :, :1]
    scale = np.nanstd(moved, axis=(0, 1, 2))
    moved = moved / np.where(scale > 0, scale, 1.0)
    best: tuple[float, int, list[int]] = (-1.0, 0, [])
    for state in range(paths.shape[1]):
        at_state = moved[:, state]  # (C, T + 1, P)
        away = np.sqrt(np.square(np.nan_to_num(at_state[:, None] - at_state[None])).mean(axis=(2, 3)))  # (C, C)
        chosen, least = [int(np.argmax(share))], np.inf
        while len(chosen) < min(count, len(at_state)):
            nearest = away[:, chosen].min(axis=1)
            nearest[chosen] = -1.0
            chosen.append(int(nearest.argmax()))
            least = min(least, float(nearest.max()))
        best = max(best, (least, state, chosen), key=lambda found: found[0])
    return best[1], np.sort(best[2])


class AtlasPictures:
    """Draws the pictures of an atlas."""

    def __init__(self, task: Task, agent: DDSAgent, env: Any, seed: int, announce: Announce) -> None:
        self.task, self.agent, self.env, self.seed, self.announce = task, agent, env, seed, announce
        self.pictures: dict[str, Picture] = {}
        self.clips: dict[int, Picture] = {}
        whole = max(round(view_of(task).held / task.step_seconds / agent.horizon), 1)
        self.steps = whole * agent.horizon

    def keep(self, name: str, figure: Figure, caption: str, alt: str) -> None:
        """Store a figure as a picture of the page."""
        width, height = (int(side * DPI) for side in figure.get_size_inches())
        self.pictures[name] = Picture(name, caption, alt, png_bytes(figure, DPI), (width, height))

    def _clip(self, code: int, data: bytes, alt: str) -> None:
        from PIL import Image

        with Image.open(io.BytesIO(data)) as image:
            self.clips[code] = Picture(f"clip-{code}", "", alt, data, image.size, "image/gif")

    def skills(self, table: pd.DataFrame, used: NDArray[Any], drawn: BodyStates) -> None:
        """Draw what each skill does: trajectories or movement, and a clip of each."""
        task, seconds = self.task, self.steps * self.task.step_seconds
        self.announce("replaying the skills")
        maze_like = task.maze_map is not None
        states = rest_states(task, junctions(task)) if maze_like else drawn
        made = replay_codes(
            task, self.agent.skill, states, used, self.steps, self.agent.noise_scale, self.seed, self.env
        )
        self.announce("drawing the skills")
        if maze_like:
            positions = made.qpos[..., :2]
            for code in used:
                of_code = positions[made.codes == code]
                alt = f"Clip: skill {code} from {len(of_code)} places in the maze at once, {seconds:g} seconds."
                self._clip(int(code), clip.replay_clip(task, of_code, int(code)), alt)
            shown = (positions[:, 0], positions, made.codes, made.alive)
            self.keep(
                "starts_by_skill",
                maze.plot_starts_by_skill(task, *shown),
                f"One panel per skill, held for {seconds:g} s ({self.steps} steps) from {len(states)} places, with the "
                "body at rest. Orange stars mark the starts.",
                f"{len(used)} small mazes, each with the paths of one skill from {len(states)} starts.",
            )
            self.keep(
                "skills_by_start",
                maze.plot_skills_by_start(task, *shown, reach=_reach(task, positions)),
                "One panel per start, in close-up: every skill from the same place. A number marks where the skill "
                "ended or left the panel.",
                f"{len(states)} close-ups of the maze, each with the paths of {len(used)} skills from one start.",
            )
        if view_of(task).limbs:
            self._movement(table, used, made, clips=not maze_like)

    def _movement(self, table: pd.DataFrame, used: NDArray[Any], made: Replays, clips: bool) -> None:
        """Draw bodies under several skills from the same state, the one in which they differ most."""
        model = self.env.unwrapped.model
        share = table.set_index("code").loc[used, "share"].to_numpy()
        paths = made.qpos.reshape(len(used), -1, *made.qpos.shape[1:])  # (C, S, T + 1, nq)
        state, rows = most_different(paths, share)
        chosen = [int(code) for code in used[rows]]
        held = made.take(made.states == state)
        bodies = {int(code): body_frames(model, qpos) for code, qpos in zip(held.codes, held.qpos, strict=True)}
        every = max(self.steps // view_of(self.task).bodies, 1)
        moments = (
            f"a body every {every * self.task.step_seconds:.2g} s, the last one solid; lines are the paths of joints"
        )
        self.keep(
            "strobe",
            strobe.plot_strobes(self.task, {code: bodies[code] for code in chosen}, every),
            f"{len(chosen)} skills from the state, of {paths.shape[1]}, in which they differ most: {moments}.",
            f"Stick figures of the body at several moments under skills {', '.join(map(str, chosen))}.",
        )
        if clips:
            for code, body in bodies.items():
                alt = f"Clip: the body under skill {code} for {self.steps * self.task.step_seconds:g} seconds."
                self._clip(code, strobe.body_clip(self.task, body, code), alt)
        self.announce("rendering, if there is a graphics driver")
        some = np.arange(0, self.steps + 1, every)
        series = held.take(np.isin(held.codes, chosen))
        rendered = render_frames(self.task, np.concatenate(series.qpos[:, some]))
        if rendered is not None:
            parts = np.cumsum(np.isfinite(series.qpos[:, some, 0]).sum(axis=1))[:-1]
            frames = dict(zip(map(int, series.codes), np.split(rendered, parts), strict=True))
            self.keep(
                "rendered",
                plot_rendered(self.task, frames, every),
                "The same moments, rendered by MuJoCo.",
                f"Rendered pictures of the body under skills {', '.join(map(str, chosen))}.",
            )

    def episodes(self, result: RolloutResult, main: str) -> None:
        """Draw how the policy combines skills."""
        self.announce("drawing episodes")
        figure = stitching.plot_stitching(self.task, result, main)
        self.keep(
            "stitching",
            figure,
            "Each row of the timeline is an episode, each segment a skill in use, with its number if there is room.",
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
        """Draw V and the policy over a maze."""
        if self.task.maze_map is None or self.agent.policy is None:
            return
        self.announce("mapping values")
        self.keep(
            "values",
            values.plot_policy_map(self.task, self.agent, self.steps, self.seed, self.env),
            f"V of a body at rest. The number in a cell is the likeliest skill, the arrow shows where holding it for "
            f"{self.steps} steps led from there. V should rise steadily on the way to the goal.",
            "Heat map of the critic's value over the maze, in each cell the number and direction of the chosen skill.",
        )

    def diversity(self, table: pd.DataFrame) -> None:
        """Draw how much noise changes an action, and how much a code does."""
        self.keep(
            "diversity",
            charts.plot_diversity(table),
            "The decoder's actions in the same states, 16 draws of noise each. If the mark is above the bar, the code "
            "determines more of the action than chance does.",
            f"Bars of the spread over noise of {len(table)} codes, with marks for how far apart their actions are.",
        )

    def matrices(
        self,
        trip: RoundTrip,
        recovery: Recovery,
        transitions: NDArray[Any],
        distances: NDArray[Any],
        coded: CodedSegments,
    ) -> None:
        """Draw the matrices between codes, and where each code is used."""
        count = len(recovery.codes)
        told = ""
        if not math.isnan(trip.state):
            told = f"In the data, {trip.state:.0%} of the segments have the code of those that begin most like them: "
            told += "the nearer to all, the less a code is a choice."
        self.keep(
            "trip",
            charts.plot_round_trip(trip),
            f"Round trip: for {trip.segments} segments of the data per code, the code is held from the state in which "
            "each begins, and the resulting behaviour is encoded. The diagonal is the share that gets the same code.",
            f"Confusion matrix of {len(trip.codes)} codes: {trip.accuracy:.0%} found again, chance {trip.chance:.0%}.",
        )
        self.keep(
            "recovery",
            charts.plot_recovery(recovery),
            f"Recovery: {count} codes, each held for {recovery.steps} steps from the same {recovery.states} states, "
            "drawn from all of the data. Equal rows mean that the state decides, not the code. " + told,
            f"Confusion matrix of {count} codes: {recovery.accuracy:.0%} recovered, chance {recovery.chance:.0%}.",
        )
        self.keep(
            "effects",
            charts.plot_effects(self.task, recovery),
            f"The same replays: displacement in {recovery.steps} steps minus the mean of all skills from that state, "
            "because a moving body keeps moving under any skill. A dot is a replay, a number the mean of its skill.",
            f"Displacements under {count} codes as clouds of dots with the code's number in the middle of each.",
        )
        self.keep(
            "transitions",
            charts.plot_transitions(transitions),
            "Percentage of a code's segments that are followed by a segment of each code.",
            "Matrix of how often each code follows each other code in the data.",
        )
        self.keep(
            "distances",
            charts.plot_distances(distances),
            "Codes whose vectors are close tend to behave similarly.",
            "Matrix of the distances between the codebook's vectors.",
        )
        squares = "A square is shown if at least five segments begin in it." if self.task.maze_map is not None else ""
        self.keep(
            "where",
            charts.plot_where(self.task, coded),
            f"From {len(coded.codes):,} segments of the data, one every {self.agent.horizon} steps. {squares}",
            "One panel per code: where in the state space the data's segments with that code begin.",
        )


def _reach(task: Task, positions: NDArray[Any]) -> float:
    """Return half the side, in metres, of a window in which 90 % of replays (N, T + 1, 2) stay; 0.5 to 2.5 cells."""
    away = np.nanmax(np.linalg.norm(positions - positions[:, :1], axis=-1), axis=1)
    return float(np.clip(1.2 * np.quantile(away, 0.9), 0.5 * task.cell_size, maze.REACH * task.cell_size))
