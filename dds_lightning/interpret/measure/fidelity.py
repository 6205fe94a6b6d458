"""How faithfully skills repeat the data: recorded segments are played again from their own first state.

```
 recorded   s_0 ─► s_1 ─► ... ─► s_H         k = argmin ||E(tau) - z_k||
 replayed   s_0 ─► s'_1 ─► ... ─► s'_H       by the decoder under k, a clone, or the recorded actions themselves
```

The error is the distance of s'_H from s_H. Its unit is the distance between the ends of two recorded segments that are
moved to the same start: 0 repeats the data, 1 is as far off as any other segment of them would be.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
import torch

from datamodules.trajectories import Trajectories
from dds_lightning.interpret.measure.replay import Act, Skills, device_of, play, replay_codes, simulator
from dds_lightning.interpret.measure.states import states_at
from dds_lightning.tasks import Task

SKILLS, RECORDED = "skills", "recorded actions"


def fidelity(
    task: Task,
    trajectories: Trajectories,
    skill: Skills,
    others: Mapping[str, Act] | None = None,
    count: int = 300,
    noise_scale: float | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """Replay recorded segments, each with its own code, and measure how far from the recording they end.

    Args:
        task: The environment, which must be simulated by MuJoCo.
        trajectories: The data; what their observations leave out of a state is filled in, see `states.body_states`.
        skill: The skill model.
        others: Name -> act, others who play from the same states, for example a clone.
        count: Segments, drawn from all over the data; fewer in shorter data.
        noise_scale: Factor on the decoder's noise; None takes the model's.
        seed: Seed of the draw and of the decoder's noise.

    Returns:
        One row for each of `SKILLS`, the others and `RECORDED`, whose error is what the data leave out of the states:
        `player`, `error` (median over the segments, see above), `fell` (share of replays that ended early),
        `segments`.

    Raises:
        UserError: The task is not simulated by MuJoCo.
        DataError: No episode has H steps.
    """
    horizon = skill.horizon
    windows = trajectories.windows(horizon, 1)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(windows), min(count, len(windows)), replace=False))
    rows = windows.observation_starts[chosen]
    recorded = trajectories.observations[rows[:, None] + np.arange(horizon + 1)]  # (N, H + 1, O)
    actions = trajectories.actions[windows.starts[chosen][:, None] + np.arange(horizon)]  # (N, H, A)
    states = states_at(task, trajectories, rows)
    device = device_of(skill)
    with torch.inference_mode():
        codes = skill.encode(torch.from_numpy(recorded[:, :-1]).to(device), torch.from_numpy(actions).to(device))
    steps = iter(range(horizon))
    players = {**(others or {}), RECORDED: lambda seen, rows: actions[rows, next(steps)]}
    with simulator(task) as env:
        own = replay_codes(
            task, skill, states, codes.cpu().numpy(), noise_scale=noise_scale, seed=seed, env=env, each=True
        )
        replays = {SKILLS: (own.observations, own.alive)}
        for name, act in players.items():
            played = play(env, task, act, states, horizon)
            replays[name] = (played["observations"], played["alive"])

    moved = recorded[:, -1].astype(np.float64) - recorded[:, 0]  # (N, O)
    scale = np.maximum(moved.std(axis=0), 1e-6)
    apart = np.linalg.norm((moved - moved[rng.permutation(len(moved))]) / scale, axis=1)
    unit = max(float(np.median(apart)), 1e-6)

    def row(name: str) -> dict[str, str | float]:
        seen, alive = replays[name]
        taken = alive.sum(axis=1)
        off = np.linalg.norm((seen[np.arange(len(seen)), taken] - recorded[:, -1]) / scale, axis=1)
        return {"player": name, "error": float(np.median(off)) / unit, "fell": float((taken < horizon).mean())}

    return pd.DataFrame([row(name) for name in replays]).assign(segments=len(chosen))
