"""Tables that describe each code: its share of the data, what happens under it, what follows it.

Everything is computed over segments of the data that do not overlap (one every H steps), encoded as in relabelling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from datamodules.relabel import relabel
from datamodules.semi_mdp import Relabelled
from datamodules.trajectories import Trajectories
from dds_lightning.interpret.measure.body import to_body
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import Body, body_of, observation_names

if TYPE_CHECKING:
    from dds_lightning.policy import PolicyModule
    from dds_lightning.skill import SkillModule

STILL = 1e-3
"""In metres: half a segment that moves less than this has no direction, so no turn is counted."""
BOUND = 1e-3
"""An action this close to its bound, as a share of the box, counts as at the bound."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CodedSegments:
    """M segments of the data with their codes.

    Attributes:
        trajectories: The episodes that they come from.
        relabelled: The segments; `rewards` are undiscounted sums in the task's unit.
        lengths: (M,) steps of each; fewer than H before a termination.
        horizon: H.
    """

    trajectories: Trajectories
    relabelled: Relabelled
    lengths: NDArray[np.int64]
    horizon: int

    @property
    def codes(self) -> NDArray[np.int64]:
        """(M,)."""
        return self.relabelled.codes.numpy()

    @property
    def observations(self) -> NDArray[np.float32]:
        """(M, O) where each segment begins."""
        return self.relabelled.observations.numpy()

    @property
    def num_skills(self) -> int:
        """K."""
        return self.relabelled.num_skills

    @property
    def share(self) -> Floats:
        """(K,) share of the segments that each code holds."""
        return np.bincount(self.codes, minlength=self.num_skills) / len(self.codes)

    def steps(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return steps (M, H) and observation rows (M, H + 1) of the segments; short ones repeat their last."""
        starts = self.relabelled.starts.numpy()
        rows = starts + self.relabelled.episodes.numpy()
        span = np.minimum(np.arange(self.horizon), self.lengths[:, None] - 1)
        edges = np.minimum(np.arange(self.horizon + 1), self.lengths[:, None])
        return starts[:, None] + span, rows[:, None] + edges


def code_segments(
    skill: SkillModule, trajectories: Trajectories, segments: int = 20_000, seed: int = 0
) -> CodedSegments:
    """Encode a data set, one segment every H steps.

    Args:
        skill: A discrete skill model.
        trajectories: The data.
        segments: Approximate number of segments; if the data have more, episodes are drawn.
        seed: Seed of the draw.

    Raises:
        UserError: The model's widths do not fit, or its skills are continuous.
        DataError: No episode has H steps.
    """
    order = np.random.default_rng(seed).permutation(trajectories.num_episodes)
    enough = int(np.searchsorted(np.cumsum(trajectories.lengths[order]), segments * skill.horizon)) + 1
    if enough < trajectories.num_episodes:
        trajectories = trajectories.select(np.sort(order[:enough]))
    made = relabel(trajectories, skill, gamma=1.0, stride=skill.horizon)
    last = trajectories.step_offsets[1:][made.episodes.numpy()]
    lengths = np.minimum(skill.horizon, last - made.starts.numpy())
    return CodedSegments(trajectories, made, lengths, skill.horizon)


# ---------------------------------------------------------------------- what happens in a segment


def segment_effects(task: Task | None, segments: CodedSegments) -> pd.DataFrame:
    """Return what each segment does, one row per segment.

    Returns:
        In a maze `dx`, `dy` (m), `distance` (m, in a straight line), `speed` (m/s, along the path), `turn` (degrees
        between the directions of its two halves, left is positive; NaN if it stands still); for an ant also `ahead` and
        `left` (m), as it faces when the segment begins. For a runner `dx` (m, from its velocity), `dz`, `distance`,
        `speed`, `turn` (degrees of pitch). Elsewhere `distance`, the norm of
        the change of what moves (in the kitchen its arm's joints, rad), and `speed`. Then `reward` (of the segment,
        undiscounted), `action` (mean |a| as a share of half the box, from its middle), `change` (mean |a' - a|
        likewise) and `bound` (share of actions at a bound).
    """
    steps, rows = segments.steps()
    seen = segments.trajectories.observations[rows].astype(np.float64)  # (M, H + 1, O)
    seconds = segments.lengths.astype(np.float64) * (task.step_seconds if task is not None else 1.0)
    frame = pd.DataFrame(_movement(task, seen, segments.lengths, seconds))
    frame["reward"] = segments.relabelled.rewards.numpy().astype(np.float64)
    data = segments.trajectories
    half = np.maximum((data.action_high - data.action_low) / 2, 1e-9)
    actions = (data.actions[steps].astype(np.float64) - (data.action_high + data.action_low) / 2) / half  # (M, H, A)
    frame["action"] = np.abs(actions).mean(axis=(1, 2))
    frame["change"] = np.abs(np.diff(actions, axis=1)).mean(axis=(1, 2)) if segments.horizon > 1 else np.nan
    frame["bound"] = (np.abs(actions) >= 1 - BOUND).mean(axis=(1, 2))
    return frame


def _movement(task: Task | None, seen: Floats, lengths: NDArray[np.int64], seconds: Floats) -> dict[str, Floats]:
    body = Body() if task is None else body_of(task)
    if body.moves == "course":
        assert task is not None
        names = observation_names(task)
        speed = seen[:, :-1, names.index("x velocity (m/s)")]
        taken = np.arange(speed.shape[1]) < lengths[:, None]
        dx = (speed * taken).sum(axis=1) * task.step_seconds
        dz = seen[:, -1, 0] - seen[:, 0, 0]
        turn = np.degrees(seen[:, -1, 1] - seen[:, 0, 1])
        return {"dx": dx, "dz": dz, "distance": np.hypot(dx, dz), "speed": dx / seconds, "turn": turn}
    if body.moves == "plane":
        path = seen[:, :, :2]
        moved = path[:, -1] - path[:, 0]
        length = np.linalg.norm(np.diff(path, axis=1), axis=-1).sum(axis=1)
        away = {"dx": moved[:, 0], "dy": moved[:, 1], "distance": np.linalg.norm(moved, axis=1)}
        if body.heading is not None:
            assert task is not None
            attitude = seen[:, 0, body.heading : body.heading + 4]
            away["ahead"], away["left"] = to_body(task, moved, attitude).T
        return {**away, "speed": length / seconds, "turn": _turn(path)}
    columns = slice(*body.moving) if body.moving else slice(None)
    distance = np.linalg.norm(seen[:, -1, columns] - seen[:, 0, columns], axis=1)
    return {"distance": distance, "speed": distance / seconds}


def _turn(path: Floats) -> Floats:
    """Return the angles (M,) in degrees between the directions of the two halves of paths (M, H + 1, 2)."""
    middle = path.shape[1] // 2
    first, second = path[:, middle] - path[:, 0], path[:, -1] - path[:, middle]
    angle = np.arctan2(second[:, 1], second[:, 0]) - np.arctan2(first[:, 1], first[:, 0])
    moves = np.minimum(np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)) > STILL
    return np.where(moves, np.degrees((angle + np.pi) % (2 * np.pi) - np.pi), np.nan)


# ---------------------------------------------------------------------- tables


def skill_table(task: Task | None, segments: CodedSegments, policy: PolicyModule | None = None) -> pd.DataFrame:
    """Return one row per code: its share and the means of what its segments do.

    Args:
        task: The task of the data; None for unnamed data.
        segments: Segments from `code_segments`.
        policy: Adds `value`, mean V where the code's segments begin, and `chosen`, how likely the policy chooses the
            code in the states of all segments.

    Returns:
        `code`, `segments`, `share`, then the means of `segment_effects` (`turning` is the mean size of `turn`), `value`
        and `chosen`. A code without segments has NaN.
    """
    effects = segment_effects(task, segments)
    if "turn" in effects:
        effects["turning"] = effects["turn"].abs()
    codes = segments.codes
    if policy is not None:
        values, chances = _policy_answers(policy, segments.observations)
        effects["value"] = values
    table = effects.groupby(codes).mean().reindex(range(segments.num_skills))
    table.insert(0, "code", np.arange(segments.num_skills))
    table.insert(1, "segments", np.bincount(codes, minlength=segments.num_skills))
    table.insert(2, "share", segments.share)
    if policy is not None:
        table["chosen"] = chances.mean(axis=0)
    return table.reset_index(drop=True)


@torch.inference_mode()
def _policy_answers(policy: PolicyModule, observations: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Return V (M,) and the policy's probabilities (M, K)."""
    policy.eval()
    device = next(policy.parameters()).device
    values, chances = [], []
    for part in np.array_split(observations, max(len(observations) // 8192, 1)):
        x = torch.from_numpy(np.ascontiguousarray(part)).to(device)
        values.append(policy.v(x).double().cpu().numpy())
        chances.append(policy.logits(x).softmax(dim=-1).double().cpu().numpy())
    return np.concatenate(values), np.concatenate(chances)


def transition_matrix(segments: CodedSegments) -> Floats:
    """Return how often code j follows code i in the data, (K, K) with rows that sum to 1, or NaN if i has no successor.

    A segment is followed by the one that begins where it ends, in the same episode.
    """
    made, size = segments.relabelled, segments.num_skills
    starts, episodes, codes = made.starts.numpy(), made.episodes.numpy(), segments.codes
    follows = (starts[1:] == starts[:-1] + segments.horizon) & (episodes[1:] == episodes[:-1])
    counts = np.zeros((size, size))
    np.add.at(counts, (codes[:-1][follows], codes[1:][follows]), 1.0)
    total = counts.sum(axis=1, keepdims=True)
    return np.divide(counts, total, out=np.full_like(counts, np.nan), where=total > 0)


def code_distances(skill: SkillModule) -> Floats:
    """Return the Euclidean distances between the codebook's vectors, (K, K)."""
    codebook: Any = skill.bottleneck
    vectors = codebook.vectors.detach().double()
    return torch.cdist(vectors, vectors).cpu().numpy()


def nearest_codes(distances: NDArray[Any]) -> NDArray[np.int64]:
    """Return the nearest other code of each, (K,), from `code_distances`."""
    return (distances + np.diag(np.full(len(distances), np.inf))).argmin(axis=1)


@torch.inference_mode()
def decoder_diversity(
    skill: SkillModule,
    observations: NDArray[np.float32],
    draws: int = 16,
    noise_scale: float | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """Measure how much noise alone changes an action, and how much the code does, in the same states.

    Args:
        skill: A discrete skill model.
        observations: (S, O) states.
        draws: Draws of noise for each state and code.
        noise_scale: Factor on the noise; None takes the model's.
        seed: Seed of the noise.

    Returns:
        One row per code: `code`; `spread`, the standard deviation of an action over noise; `apart`, how far the code's
        mean action lies from the mean over all codes (root mean square); both of one action entry, in half action
        boxes.
    """
    device = next(skill.parameters()).device
    box: Any = skill.action_box
    codes, states = skill.num_skills, len(observations)
    seen = torch.from_numpy(np.ascontiguousarray(observations)).to(device).repeat(codes * draws, 1)
    held = torch.arange(codes, device=device).repeat_interleave(states).repeat(draws)
    stream = torch.Generator(device).manual_seed(seed)
    actions = box.to_unit(skill.decode(seen, held, noise_scale, stream)).double()
    actions = actions.reshape(draws, codes, states, -1)
    spread = actions.std(dim=0, correction=min(draws - 1, 1)).mean(dim=(1, 2))
    means = actions.mean(dim=0)  # (K, S, A)
    apart = (means - means.mean(dim=0)).square().mean(dim=(1, 2)).sqrt()
    return pd.DataFrame({"code": np.arange(codes), "spread": spread.cpu().numpy(), "apart": apart.cpu().numpy()})


def telling_dimensions(observations: NDArray[Any], codes: NDArray[Any], count: int = 2) -> list[int]:
    """Return the dimensions of the observations that distinguish codes best.

    Args:
        observations: (M, O).
        codes: (M,).
        count: Number of dimensions; O at most.

    Returns:
        Columns, the best first: those with the largest share of variance between codes (eta squared).
    """
    seen = np.asarray(observations, dtype=np.float64)
    total = seen.var(axis=0)
    within = sum(seen[codes == k].var(axis=0) * np.mean(codes == k) for k in np.unique(codes))
    explained = np.where(total > 1e-12, 1 - within / np.maximum(total, 1e-12), -np.inf)
    return [int(j) for j in np.argsort(-explained, kind="stable")[:count]]
