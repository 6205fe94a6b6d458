"""The parts of an agent: skills or raw actions in their place, and the policy of either stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dds_lightning.errors import UserError
from dds_lightning.online.sac import SACModule
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.checkpoint import load_ckpt, stage_of
from dds_lightning.saving.published import load_published
from dds_lightning.skill import SkillModule


class RawActions(nn.Module):
    """Skills of one step whose decoder is the identity: what the policy chooses is done.

    Args:
        policy: A policy over raw actions; its widths and normaliser are taken.
    """

    discrete = False
    horizon, num_skills, draws = 1, 0, 0

    def __init__(self, policy: SACModule) -> None:
        super().__init__()
        width = policy.hparams.choices
        self.hparams = {
            "observation_dim": policy.hparams.observation_dim,
            "action_dim": width,
            "skill_dim": width,
            "noise_scale": 0.0,
        }
        self.normaliser = policy.normaliser

    def decode(
        self,
        observations: Tensor,
        skills: Tensor,
        noise_scale: float | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """The chosen actions (B, A)."""
        return skills

    def decode_from(self, observations: Tensor, skills: Tensor, noise: Tensor) -> Tensor:
        """As `decode`."""
        return skills


def published_parts(published: Any) -> tuple[SkillModule | RawActions, PolicyModule | SACModule | None]:
    """Skills and policy of a published agent: the policy of either stage, and raw actions where there are no skills.

    Args:
        published: A `saving.published.Published`.

    Raises:
        UserError: A module is missing, or its weights do not fit its settings.
    """
    kinds: list[Any] = [kind for kind in (PolicyModule, SACModule) if kind.STAGE in published.config]
    policy = published.module(kinds[0], kinds[0].STAGE) if kinds else None
    if isinstance(policy, SACModule) and policy.hparams.space == "raw":
        return RawActions(policy), policy
    return published.module(SkillModule, "skill"), policy


def checkpoint_parts(
    skill: str | None, policy: str | None
) -> tuple[SkillModule | RawActions, PolicyModule | SACModule | None]:
    """As `published_parts`, from checkpoints: `.ckpt` files or published directories.

    Args:
        skill: Of the skills; None for raw actions.
        policy: Of the policy, of either stage; None for skills alone.

    Raises:
        UserError: A file is missing, unreadable or of another kind, or a policy over skills comes without them.
    """
    chooser: Any = None
    if policy is not None:
        online = "online" in load_published(policy).config if Path(policy).is_dir() else _stage(policy) == "online"
        chooser = (SACModule if online else PolicyModule).load(policy)
    if isinstance(chooser, SACModule) and chooser.follower is not None:
        return chooser.follower.skill, chooser  # as its decoder is now
    if skill is not None:
        return SkillModule.load(skill), chooser
    if not isinstance(chooser, SACModule) or chooser.hparams.space != "raw":
        raise UserError(f"--policy is {policy} without --skill: give both")
    return RawActions(chooser), chooser


def _stage(path: str) -> str | None:
    return stage_of(load_ckpt(path))
