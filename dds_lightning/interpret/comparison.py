"""Discrete against continuous skills: the same measurements, with continuous skills put into K clusters.

The encodings of the data are put into K clusters by k-means; the nearest centre is a segment's code, and a cluster's
centre is what is replayed. From there on both kinds are measured by the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from datamodules.relabel import check_widths
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.interpret.recovery import code_recovery, round_trip
from dds_lightning.interpret.replay import Skills, draw_states, simulator
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.skill import SkillModule


class ClusteredSkills:
    """Continuous skills as K codes: the nearest of K centres, in the space of encodings.

    Args:
        skill: with a Gaussian bottleneck.
        centres: (K, D).
    """

    def __init__(self, skill: SkillModule, centres: Tensor) -> None:
        self.skill, self.centres = skill, centres
        self.horizon, self.num_skills = int(skill.horizon), len(centres)

    def encode(self, observations: Tensor, actions: Tensor, lengths: Tensor | None = None) -> Tensor:
        """The nearest centre (B,) of each segment's mean encoding."""
        found: Any = self.skill.encode_segments(observations, actions, lengths)
        return torch.cdist(found.mean.float(), self.centres).argmin(dim=-1)

    def decode(
        self,
        observations: Tensor,
        codes: Tensor,
        noise_scale: float | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Actions (B, A) under the centres of codes (B,)."""
        return self.skill.decode_vectors(observations, self.centres[codes], noise_scale, generator)


@torch.no_grad()
def cluster_skills(
    skill: SkillModule, trajectories: Trajectories, clusters: int, segments: int = 4000, seed: int = 0
) -> ClusteredSkills:
    """Put a continuous model's skills into clusters, by k-means on the encodings of the data.

    Args:
        skill: with a Gaussian bottleneck.
        trajectories: the data.
        clusters: K.
        segments: that are encoded, drawn from all.
        seed: of the draw and of k-means.

    Raises:
        UserError: the model's skills are discrete already, its widths are others, or the data have too few segments.
    """
    from scipy.cluster.vq import kmeans2

    if skill.discrete:
        raise UserError("bottleneck is vq: its skills are discrete already, only gaussian ones are put into clusters")
    check_widths(trajectories, skill)
    windows = trajectories.windows(skill.horizon)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(windows))[:segments])
    if len(chosen) < clusters:
        raise UserError(f"clusters is {clusters}, but the data have only {len(chosen)} segments: ask for fewer")
    span = np.arange(skill.horizon)
    observations = trajectories.observations[windows.observation_starts[chosen, None] + span]  # (M, H, O)
    actions = trajectories.actions[windows.starts[chosen, None] + span]  # (M, H, A)
    skill.eval()
    means = []
    for part in np.array_split(np.arange(len(chosen)), max(len(chosen) // 2048, 1)):
        pair = (torch.from_numpy(values[part]).to(skill.device) for values in (observations, actions))
        found: Any = skill.encode_segments(*pair)
        means.append(found.mean.float().cpu().numpy())
    centres, _ = kmeans2(np.concatenate(means), clusters, iter=30, minit="++", rng=seed)
    return ClusteredSkills(skill, torch.as_tensor(centres, dtype=torch.float32, device=skill.device))


def compare_recovery(
    task: Task,
    trajectories: Trajectories,
    models: Iterable[tuple[str, SkillModule]],
    clusters: int | None = None,
    states: int = 64,
    seed: int = 0,
    report: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """The same measurement for several models, from the same states: discrete against continuous, seed by seed.

    Args:
        task: the environment.
        trajectories: the data that states are drawn from and continuous skills are put into clusters on.
        models: name and model; models of one name are seeds of one kind.
        clusters: K for continuous models; None takes that of the first discrete one.
        states: from which every code is replayed.
        seed: of states, noise and k-means.
        report: told the name of each model before its turn.

    Returns:
        A row a model: `model`, `seed` (counted within its name), `kind` ("discrete" or "continuous"), the facts of
        `recovery.Recovery`, and `own_accuracy` and `own_control`, those of `recovery.round_trip`.

    Raises:
        UserError: continuous models alone, and no `clusters`.
    """
    every = list(models)
    known = clusters or next((model.num_skills for _, model in every if model.discrete), None)
    if known is None:
        raise UserError("clusters is missing: among continuous models alone nothing says into how many to put them")
    drawn = draw_states(task, trajectories, states, seed)
    rows: list[dict[str, Any]] = []
    with simulator(task) as env:
        for name, model in every:
            if report is not None:
                report(name)
            check_widths(trajectories, model)
            kind = "discrete" if model.discrete else "continuous"
            skills: Skills = model if model.discrete else cluster_skills(model, trajectories, known, seed=seed)
            found, _ = code_recovery(task, skills, drawn, seed=seed, env=env)
            own = round_trip(task, skills, trajectories, states, seed=seed, env=env)
            number = sum(row["model"] == name for row in rows)
            trip = {"own_accuracy": own.accuracy, "own_control": own.control}
            rows.append({"model": name, "seed": number, "kind": kind, **found.facts(), **trip})
    return pd.DataFrame(rows)
