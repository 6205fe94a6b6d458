"""Stage two: relabel the data with skills, one semi-MDP transition a segment (section 4.2).

```
 s_t  a_t r_t   a_t+1 r_t+1  ...  a_t+H-1 r_t+H-1   s_t+H
 └ state                                            └ next state        k = argmin_j ||E(tau) - z_j||
       └────── reward: sum of gamma^(i-1) r_i ─────┘                    discount: gamma, or gamma^h
```

A segment that reaches a *termination* after h < H steps is kept: its reward is discounted to the end, ``done`` cuts
the bootstrap, and the encoder averages over those h steps only. A segment that a *time-out* cuts short is dropped: the
skill was not completed, and nothing ended.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from datamodules.partial_codes import PartialCodes
from datamodules.relabelling import Discount as Discount
from datamodules.relabelling import Relabelling
from datamodules.semi_mdp import STORED
from datamodules.semi_mdp import Relabelled as Relabelled
from datamodules.trajectories import Trajectories
from dds_lightning.console.progress import on_terminal, track
from dds_lightning.envs.semi_mdp import fold
from dds_lightning.errors import UserError
from dds_lightning.skill import SkillModule


def relabel_key(
    trajectories: Trajectories, skill: SkillModule, relabelling: Relabelling | None = None, **settings: Any
) -> dict[str, str | int | float]:
    """Everything that a relabelled set depends on.

    Args:
        trajectories: The data.
        skill: The skill model.
        relabelling: The settings; None takes the defaults, without a task's reward convention.
        **settings: Fields of `Relabelling` that differ from `relabelling`.

    Returns:
        Hashes of data and skills (`saving.fingerprint`), H, and every field of `Relabelling`.
    """
    settings = _resolved(relabelling, settings).settings()
    return {"data": trajectories.fingerprint(), "skill": skill.fingerprint(), "horizon": skill.horizon, **settings}


def _resolved(relabelling: Relabelling | None, settings: dict[str, Any]) -> Relabelling:
    return replace(relabelling or Relabelling(), **settings).for_task(None)


@torch.inference_mode()
def relabel(
    trajectories: Trajectories,
    skill: SkillModule,
    relabelling: Relabelling | None = None,
    *,
    batch_size: int = 512,
    precision: Literal["32-true", "bf16-mixed"] = "32-true",
    progress: bool = False,
    partial: PartialCodes | None = None,
    **settings: Any,
) -> Relabelled:
    """Turn every segment into a semi-MDP transition (section 4.2).

    Args:
        trajectories: The data.
        skill: A discrete skill model with the same observation and action widths.
        relabelling: The settings; None takes the defaults, without a task's reward convention.
        batch_size: Segments encoded at once.
        precision: Of the encoder; in bfloat16 one code in two hundred is another, of two that are equally near.
        progress: Show a bar when standard error is a terminal.
        partial: Stores the codes so far, and has those of an earlier call that was stopped.
        **settings: Fields of `Relabelling` that differ from `relabelling`.

    Raises:
        UserError: When widths differ between data and model, no segment has H steps, or a setting is out of range.
    """
    settled = _resolved(relabelling, settings)
    check_widths(trajectories, skill)
    horizon = skill.horizon
    windows = trajectories.windows(horizon, settled.stride, tail="terminated")
    starts, observation_starts, lengths = windows.starts, windows.observation_starts, windows.lengths
    steps = np.minimum(np.arange(horizon), lengths[:, None] - 1)  # (M, H): a short segment repeats its last step
    device = skill.device

    def encode(rows: slice) -> Tensor:
        observations = trajectories.observations[observation_starts[rows, None] + steps[rows]]  # (B, H, O)
        actions = trajectories.actions[starts[rows, None] + steps[rows]]  # (B, H, A)
        short = lengths[rows] < horizon
        with torch.autocast(device.type, torch.bfloat16, enabled=precision != "32-true"):
            return skill.encode(
                torch.as_tensor(observations, device=device),
                torch.as_tensor(actions, device=device),
                torch.as_tensor(lengths[rows], device=device) if short.any() else None,
            ).cpu()

    codes = [] if partial is None else partial.read()
    batches = range(sum(map(len, codes)), len(starts), batch_size)
    was_training = skill.training
    skill.eval()
    layout, shown = ("{task.description}", "bar", "percent", "remaining"), progress and on_terminal()
    try:
        for first in track(batches, layout, len(batches), "relabelling", shown=shown):
            codes.append(encode(slice(first, first + batch_size)))
            if partial is not None:
                partial.write_if_due(codes)
    except BaseException:
        if partial is not None:
            partial.write(codes)
        raise
    finally:
        skill.train(was_training)

    return _transitions(trajectories, skill, settled, torch.cat(codes))


def _transitions(trajectories: Trajectories, skill: SkillModule, settled: Relabelling, codes: Tensor) -> Relabelled:
    """The transitions of every segment, given their codes (M,)."""
    windows = trajectories.windows(skill.horizon, settled.stride, tail="terminated")
    starts, observation_starts, lengths = windows.starts, windows.observation_starts, windows.lengths
    learning = settled.learning_rewards(trajectories, skill.horizon)  # (N,)
    rewards, factor = fold(learning, starts, lengths, settled.gamma, settled.discount)
    ends = starts + lengths - 1  # (M,) last step of each segment
    return Relabelled(
        observations=torch.as_tensor(trajectories.observations[observation_starts]),
        codes=codes,
        rewards=torch.as_tensor(rewards, dtype=torch.float32),
        next_observations=torch.as_tensor(trajectories.observations[observation_starts + lengths]),
        discounts=torch.as_tensor(factor, dtype=torch.float32),
        dones=torch.as_tensor(trajectories.terminations[ends].astype(np.float32)),
        starts=torch.as_tensor(starts),
        episodes=torch.as_tensor(windows.episodes),
        num_skills=skill.num_skills,
    )


def refuse_other_transitions(
    found: Relabelled, trajectories: Trajectories, skill: SkillModule, relabelling: Relabelling, path: str | Path
) -> None:
    """Refuse transitions that these data, skills and settings cannot give, whatever their codes.

    Args:
        found: The transitions.
        trajectories: The data.
        skill: The skill model; it encodes nothing here.
        relabelling: The settings.
        path: The file that the transitions come from, for the message.

    Raises:
        UserError: Something other than the codes differs; the message names it.
    """
    expected = _transitions(trajectories, skill, relabelling.for_task(None), found.codes)
    if found.num_skills != expected.num_skills:
        raise UserError(f"{path} has {found.num_skills} codes, the skills {expected.num_skills}: delete it and relabel")
    for name in STORED:
        mine, theirs = getattr(found, name), getattr(expected, name)
        if mine.shape != theirs.shape or not torch.allclose(mine, theirs, rtol=1e-4, atol=1e-6):
            raise UserError(f"{path}: {name} are not what these data and settings give: delete it and relabel")


def check_widths(trajectories: Trajectories, skill: SkillModule) -> None:
    """Refuse a skill model whose observation or action width is not the data's."""
    for name, found in (("observation_dim", trajectories.observation_dim), ("action_dim", trajectories.action_dim)):
        expected = skill.hparams[name]
        if found != expected:
            raise UserError(
                f"the skill checkpoint has {name} {expected}, data set {trajectories.name!r} has {found}: "
                "use a checkpoint that was trained on this task's data"
            )
