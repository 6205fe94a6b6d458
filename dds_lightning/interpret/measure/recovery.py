"""Does a skill mean something? Whether a code can be recognised from its behaviour, and how much it determines.

```
 round trip    segment of the data ─► encoder ─► k          hold k from the segment's first state, encode that: k again?
                                                            control: hold another code there, is it taken for k?
 recovery      any state ─► hold code k for H steps ─► encoder ─► k'        accuracy: how often k' = k
                                  └──► displacement ──► mutual information with k
```

The round trip uses states in which the data use the code. There the state alone may give the code away (a runner's
codes are often phases of its gait). The control measures this: the effect of the code itself is accuracy minus control.
Recovery plays every code from the same states, so a state gives nothing away. It is the harder test: a decoder need not
follow a code in states where the data never use it. Chance is 1 / K in both, because codes are played equally often.

Where little is recovered, look at how often a segment's first state tells its code (`RoundTrip.state`). Where it nearly
always does, the data do the same thing in the same state, and codes name parts of one movement: there is no other
behaviour in that state that a decoder could have learnt.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from datamodules.trajectories import Trajectories
from dds_lightning.interpret.measure.body import root_path, to_body
from dds_lightning.interpret.measure.information import mutual_information
from dds_lightning.interpret.measure.replay import Replays, Skills, replay_codes, simulator
from dds_lightning.interpret.measure.states import BodyStates, states_at
from dds_lightning.tasks import Task

POOL = 4000
"""Number of segments of the data from which those of a round trip are drawn."""

NEIGHBOURS = 5
"""Most similar first states that vote for a segment's code."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recovery:
    """How well codes are recognised from behaviour.

    Attributes:
        codes: (C,) the codes that were replayed.
        confusion: (C, C) share of the replays of code i (row) that the encoder takes for code j; a row sums to less
            than 1 if some are taken for codes that were not replayed.
        accuracy: Share of all replays whose code is recovered.
        error: Standard error of `accuracy`, over states.
        chance: 1 / C.
        information: Mutual information in bits between code and displacement, over states and codes.
        information_in_state: The same for `effects`. This is far larger if the body's speed determines where it goes in
            H steps.
        effects: (C, S, D) metres, effect of each code on the displacement from each state: the displacement minus its
            mean over the codes from that state. For an ant, ahead of it and to its left as it faces in that state.
        most: Upper bound of both in bits, log2 C.
        states: Number of states that each code was replayed from.
        steps: H.
    """

    codes: NDArray[np.int64]
    confusion: Floats
    accuracy: float
    error: float
    chance: float
    information: float
    information_in_state: float
    most: float
    states: int
    steps: int
    effects: Floats

    def facts(self) -> dict[str, Any]:
        """The numbers, for a table or for JSON."""
        names = ("accuracy", "error", "chance", "information", "information_in_state", "most", "states", "steps")
        return {"codes": len(self.codes), **{name: getattr(self, name) for name in names}}


def code_recovery(
    task: Task,
    skills: Skills,
    states: BodyStates,
    codes: NDArray[Any] | None = None,
    noise_scale: float | None = None,
    seed: int = 0,
    env: Any = None,
    report: Callable[[int], None] | None = None,
) -> tuple[Recovery, Replays]:
    """Replay codes for H steps, encode what happened, and compare.

    Args:
        task: The environment.
        skills: A discrete skill model, or `cluster_skills` of a continuous one.
        states: S states, for example from `states.draw_states`.
        codes: (C,) codes to replay, for example those in use; None takes all.
        noise_scale: Factor on the decoder's noise, see `replay.replay_codes`.
        seed: Seed of the decoder's noise.
        env: An environment from `replay.simulator`; without it one is created.
        report: Called with the number of steps done so far.

    Returns:
        The result, and the C x S replays that it was measured on.
    """
    chosen = np.arange(skills.num_skills) if codes is None else np.asarray(codes, dtype=np.int64)
    with contextlib.ExitStack() as stack:
        env = stack.enter_context(simulator(task)) if env is None else env
        made = replay_codes(task, skills, states, chosen, None, noise_scale, seed, env, report=report)
        moved = displacements(root_path(task, env.unwrapped.model, made.qpos), made.lengths)
    found = encode_replays(skills, made)
    hits = (found == made.codes).reshape(len(chosen), len(states))
    confusion = np.stack([(found[made.codes == k][:, None] == chosen).mean(axis=0) for k in chosen])
    by_state = hits.mean(axis=0)  # replays from one state are similar: the independent sample is the state
    error = float(by_state.std(ddof=1) / math.sqrt(len(states))) if len(states) > 1 else math.nan
    by_code = moved.reshape(len(chosen), len(states), -1)
    effects = to_body(task, by_code - by_code.mean(axis=0), states.qpos[:, 3:7])  # (C, S, D)
    return Recovery(
        codes=chosen,
        confusion=confusion,
        accuracy=float(hits.mean()),
        error=error,
        chance=1 / len(chosen),
        information=mutual_information(made.codes, moved, seed=seed),
        information_in_state=mutual_information(made.codes, effects.reshape(moved.shape), seed=seed),
        most=math.log2(len(chosen)),
        states=len(states),
        steps=skills.horizon,
        effects=effects,
    ), made


@dataclass(frozen=True, eq=False)
class RoundTrip:
    """How well codes are recognised from behaviour in states where the data use them.

    Attributes:
        codes: (C,) the codes that were replayed: those with enough segments in the data.
        confusion: (C, C) as in `Recovery`.
        by_code: (C,) share of each code's replays in which it is found again.
        accuracy: Mean of `by_code`.
        error: Its standard error, over segments.
        control: Share of the replays of another code, from the same states, that are taken for the code of the data:
            how much the state alone gives it away.
        state: Share of segments of the data whose code their first state tells, see `told_by_state`.
        chance: 1 / C.
        segments: Number of segments of the data for each code.
    """

    codes: NDArray[np.int64]
    confusion: Floats
    by_code: Floats
    accuracy: float
    error: float
    control: float
    state: float
    chance: float
    segments: int

    def facts(self) -> dict[str, Any]:
        """The numbers, for a table or for JSON."""
        names = ("accuracy", "error", "control", "state", "chance", "segments")
        return {"codes": len(self.codes), **{name: getattr(self, name) for name in names}}


def round_trip(
    task: Task,
    skills: Skills,
    trajectories: Trajectories,
    segments: int = 32,
    noise_scale: float | None = None,
    seed: int = 0,
    env: Any = None,
) -> RoundTrip:
    """Encode segments of the data, hold each one's code from its first state, and encode what happens then.

    Args:
        task: The environment.
        skills: The skills, see `code_recovery`.
        trajectories: The data.
        segments: Number of segments per code; codes with fewer are left out, except for the commonest code.
        noise_scale: Factor on the decoder's noise, see `replay.replay_codes`.
        seed: Seed of the draws and of the decoder's noise.
        env: An environment from `replay.simulator`; without it one is created.
    """
    rng = np.random.default_rng(seed)
    windows = trajectories.windows(skills.horizon)
    pool = np.sort(rng.permutation(len(windows))[:POOL])
    span = np.arange(skills.horizon)
    rows = windows.observation_starts[pool]
    seen = trajectories.observations[rows[:, None] + span]  # (M, H, O)
    codes = encode(skills, seen, trajectories.actions[windows.starts[pool, None] + span])
    counts = np.bincount(codes, minlength=skills.num_skills)
    segments = min(segments, int(counts.max()))
    chosen = np.flatnonzero(counts >= segments)
    drawn = np.concatenate([rng.choice(np.flatnonzero(codes == k), segments, replace=False) for k in chosen])
    states = states_at(task, trajectories, rows[drawn])
    held = codes[drawn]
    other = chosen[(np.searchsorted(chosen, held) + rng.integers(1, max(len(chosen), 2), len(held))) % len(chosen)]
    with contextlib.ExitStack() as stack:
        env = stack.enter_context(simulator(task)) if env is None else env
        found, instead = (
            encode_replays(skills, replay_codes(task, skills, states, each, None, noise_scale, seed, env, each=True))
            for each in (held, other)
        )
    confusion = np.stack([(found[held == k][:, None] == chosen).mean(axis=0) for k in chosen])
    hits = found == held
    by_code = np.diag(confusion).copy()
    error = float(hits.std(ddof=1) / math.sqrt(len(hits))) if len(hits) > 1 else math.nan
    control = float((instead == held)[other != held].mean()) if len(chosen) > 1 else math.nan
    state = told_by_state(seen[:, 0], codes, windows.episodes[pool])
    return RoundTrip(chosen, confusion, by_code, float(hits.mean()), error, control, state, 1 / len(chosen), segments)


def told_by_state(states: NDArray[Any], codes: NDArray[Any], episodes: NDArray[Any]) -> float:
    """Return the share of segments whose code is the commonest among the most similar states of other episodes.

    Args:
        states: (M, O) first states of segments; distances count every entry in its standard deviation.
        codes: (M,).
        episodes: (M,) the episode of each.

    Returns:
        The share; NaN where a segment has fewer than `NEIGHBOURS` in other episodes.
    """
    scaled = (states - states.mean(axis=0)) / np.maximum(states.std(axis=0), 1e-6)
    apart = cdist(scaled, scaled)
    apart[episodes[:, None] == episodes] = np.inf
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :NEIGHBOURS]  # (M, N)
    if not np.isfinite(np.take_along_axis(apart, nearest, axis=1)).all():
        return math.nan
    votes = (codes[nearest][:, :, None] == np.arange(codes.max() + 1)).sum(axis=1)  # (M, K)
    return float((votes.argmax(axis=1) == codes).mean())


def encode_replays(skills: Skills, replays: Replays) -> NDArray[np.int64]:
    """Return codes (N,) of replays of H steps; a replay that ended early is encoded as a shorter segment."""
    lengths = np.maximum(replays.lengths, 1)
    steps = np.minimum(np.arange(skills.horizon), lengths[:, None] - 1)  # (N, H): repeats the last step, as relabelling
    rows = np.arange(len(steps))[:, None]
    return encode(skills, replays.observations[rows, steps], replays.actions[rows, steps], lengths)


@torch.inference_mode()
def encode(
    skills: Skills, observations: NDArray[Any], actions: NDArray[Any], lengths: NDArray[Any] | None = None
) -> NDArray[np.int64]:
    """Return codes (N,) of segments (N, H, O), (N, H, A), some of which may be shorter than H."""
    device = _device(skills)
    codes = []
    for part in np.array_split(np.arange(len(observations)), max(len(observations) // 2048, 1)):
        seen, taken = (torch.from_numpy(values[part]).to(device) for values in (observations, actions))
        short = lengths is not None and (lengths[part] < skills.horizon).any()
        cut = torch.from_numpy(lengths[part]).to(device) if lengths is not None and short else None
        codes.append(skills.encode(seen, taken, cut).cpu().numpy())
    return np.concatenate(codes)


def _device(skills: Skills) -> torch.device:
    return next(skills.parameters()).device if isinstance(skills, torch.nn.Module) else torch.device("cpu")


def displacements(paths: NDArray[Any], lengths: NDArray[Any]) -> Floats:
    """Return the displacements (N, D) of paths (N, T + 1, D) up to the end of each replay."""
    ends = paths[np.arange(len(paths)), np.asarray(lengths)]
    return np.asarray(ends - paths[:, 0], dtype=np.float64)
