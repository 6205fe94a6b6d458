"""Discrete against continuous skills: the same measurements, with continuous skills grouped into K clusters.

The encodings of the data are grouped into K clusters by k-means; a segment's code is the nearest centre, and the
centres are what is replayed. From there on both kinds are measured by the same functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from datamodules.relabel import check_widths
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.interpret.measure.recovery import code_recovery, round_trip
from dds_lightning.interpret.measure.replay import simulator
from dds_lightning.interpret.measure.states import draw_states
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.skill import SkillModule


class ClusteredSkills:
    """Continuous skills as K codes: the nearest of K centres in the space of encodings.

    Args:
        skill: A skill model with a Gaussian bottleneck.
        centres: (K, D).
    """

    def __init__(self, skill: SkillModule, centres: Tensor) -> None:
        self.skill, self.centres = skill, centres
        self.horizon, self.num_skills = int(skill.horizon), len(centres)

    def encode(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Return the nearest centre (B,) to each segment's mean encoding."""
        found = self.skill.encode_segments(observations, actions, lengths)
        return torch.cdist(found.vectors.float(), self.centres).argmin(dim=-1)

    def decode(
        self,
        observations: Tensor,
        codes: Tensor,
        noise_scale: float | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Return actions (B, A) under the centres of codes (B,)."""
        return self.skill.decode(observations, self.centres[codes], noise_scale, generator)


@torch.no_grad()
def cluster_skills(
    skill: SkillModule, trajectories: Trajectories, clusters: int, segments: int = 4000, seed: int = 0
) -> ClusteredSkills:
    """Group a continuous model's skills into clusters, by k-means on the encodings of the data.

    Args:
        skill: A skill model with a Gaussian bottleneck.
        trajectories: The data.
        clusters: K.
        segments: Number of segments that are encoded, drawn from all.
        seed: Seed of the draw and of k-means.

    Raises:
        UserError: The model's skills are already discrete, its widths do not fit, or the data have too few segments.
    """
    from scipy.cluster.vq import kmeans2

    if skill.discrete:
        kind = skill.hparams.bottleneck
        raise UserError(f"bottleneck is {kind}, expected gaussian: the skills are already discrete, without clusters")
    check_widths(trajectories, skill)
    skill.eval()
    means = []
    for observations, actions in _segments(trajectories, skill.horizon, segments, seed, skill.device):
        found = skill.encode_segments(observations, actions)
        means.append(found.vectors.float().cpu().numpy())
    encodings = np.concatenate(means)
    if len(encodings) < clusters:
        raise UserError(f"clusters is {clusters}, but the data have only {len(encodings)} segments: ask for fewer")
    centres, _ = kmeans2(encodings, clusters, iter=30, minit="++", rng=seed)
    return ClusteredSkills(skill, torch.as_tensor(centres, dtype=torch.float32, device=skill.device))


def _segments(
    trajectories: Trajectories, horizon: int, count: int, seed: int, device: torch.device
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield drawn segments of the data in batches: observations (B, H, O) and actions (B, H, A)."""
    windows = trajectories.windows(horizon)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(windows))[:count])
    span = np.arange(horizon)
    for part in np.array_split(chosen, max(len(chosen) // 2048, 1)):
        observations = trajectories.observations[windows.observation_starts[part, None] + span]
        actions = trajectories.actions[windows.starts[part, None] + span]
        yield torch.from_numpy(observations).to(device), torch.from_numpy(actions).to(device)


@torch.no_grad()
def decoding_error(
    skill: SkillModule | ClusteredSkills, trajectories: Trajectories, segments: int = 1000, seed: int = 0
) -> float:
    """Return how far decoded actions are from those of the data, in the environment's units.

    Each segment is encoded, and an action is drawn in each of its states with the model's full noise, given the
    encoding: the code of discrete skills, the centre of a continuous skill's cluster, or, for a continuous model
    itself, the vector of that segment.

    Args:
        skill: A model of any of the three kinds.
        trajectories: The data; preferably data that the model was not trained on.
        segments: Number of segments that are decoded, drawn from all.
        seed: Seed of the draw and of the noise.

    Returns:
        The root mean square error of one entry of an action.
    """
    model = skill.skill if isinstance(skill, ClusteredSkills) else skill
    check_widths(trajectories, model)
    model.eval()
    stream = torch.Generator(model.device).manual_seed(seed)
    squares = []
    for observations, actions in _segments(trajectories, model.horizon, segments, seed, model.device):
        seen, horizon = observations.flatten(0, 1), model.horizon
        if isinstance(skill, ClusteredSkills) or model.discrete:
            held = skill.encode(observations, actions).repeat_interleave(horizon)
            decoded = skill.decode(seen, held, 1.0, stream)
        else:
            found = model.encode_segments(observations, actions)
            decoded = model.decode(seen, found.vectors.repeat_interleave(horizon, dim=0), 1.0, stream)
        squares.append((decoded - actions.flatten(0, 1)).square().mean(dim=-1))
    return float(torch.cat(squares).mean().sqrt())


def compare_recovery(
    task: Task,
    trajectories: Trajectories,
    models: Iterable[tuple[str, SkillModule]],
    clusters: int | None = None,
    states: int = 64,
    seed: int = 0,
    report: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Measure several models from the same states: discrete against continuous, seed by seed.

    Args:
        task: The environment.
        trajectories: The data from which states are drawn and continuous skills are clustered.
        models: Name and model; models of one name are seeds of one kind.
        clusters: K for continuous models; None takes that of the first discrete one.
        states: Number of states from which every code is replayed.
        seed: Seed of states, noise and k-means.
        report: Called with the name of each model before its turn.

    Returns:
        One row per model: `model`, `seed` (counted within its name), `kind` ("discrete" or "continuous"), the facts of
        `recovery.Recovery`, `own_accuracy`, `own_control` and `told_by_state` of `recovery.RoundTrip`, `decoded`, the
        `decoding_error` under codes, and `decoded_own`, that under each segment's vector (NaN for discrete skills,
        which have none).

    Raises:
        UserError: All models are continuous and `clusters` is None.
    """
    every = list(models)
    known = clusters or next((model.num_skills for _, model in every if model.discrete), None)
    if known is None:
        raise UserError("clusters is missing: with continuous models only, give the number of clusters")
    drawn = draw_states(task, trajectories, states, seed)
    rows: list[dict[str, Any]] = []
    with simulator(task) as env:
        for name, model in every:
            if report is not None:
                report(name)
            check_widths(trajectories, model)
            kind = "discrete" if model.discrete else "continuous"
            skills = model if model.discrete else cluster_skills(model, trajectories, known, seed=seed)
            found, _ = code_recovery(task, skills, drawn, seed=seed, env=env)
            trip = round_trip(task, skills, trajectories, states, seed=seed, env=env)
            number = sum(row["model"] == name for row in rows)
            shares = {"own_accuracy": trip.accuracy, "own_control": trip.control, "told_by_state": trip.state}
            errors = {
                "decoded": decoding_error(skills, trajectories, seed=seed),
                "decoded_own": math.nan if model.discrete else decoding_error(model, trajectories, seed=seed),
            }
            rows.append({"model": name, "seed": number, "kind": kind, **found.facts(), **shares, **errors})
    return pd.DataFrame(rows)
