"""From offline to online: an online training that starts from the policy and the critics of `dds policy fit`."""

from __future__ import annotations

from typing import Any

import torch

from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule

SHAPE = ("observation_dim", "hidden_dims", "fourier_features", "fourier_seen", "layer_norm")


@torch.no_grad()
def start_offline(module: Any, path: str) -> None:
    """Give an online module the normaliser, the features, the policy and the critics of an offline one.

    The two offline critics are dealt out where there are more.

    Args:
        module: A `SACModule` over the same codes.
        path: `.ckpt` or published directory of the policy.

    Raises:
        UserError: It is no policy, chooses among other codes, or has networks of another shape.
    """
    policy = PolicyModule.load(path)
    there, here = policy.hparams, module.hparams
    if not module.discrete:
        raise UserError(
            f"model.offline is {path}, a policy over codes, but the choices are {here.space}: expected discrete"
        )
    if there.skill_hash and here.skill_hash and there.skill_hash != here.skill_hash:
        raise UserError(
            f"model.offline: {path} chooses among the codes of another skill model than data.skill: give that"
        )
    pairs = {"choices": (here.choices, there.num_skills), **{name: (here[name], there[name]) for name in SHAPE}}
    for name, (ours, theirs) in pairs.items():
        if ours != theirs:
            raise UserError(f"model.{name} is {ours}, but the policy in {path} has {theirs}: give the same")
    if there.awr != "regression":
        raise UserError(f"model.offline: the policy in {path} is in {there.awr}, expected awr: regression")
    module.normaliser.load_state_dict(policy.normaliser.state_dict())
    module.features.load_state_dict(policy.features.state_dict())
    module.actor.net.load_state_dict(policy.actor.state_dict())
    module.support_mask.copy_(policy.support_mask)
    for mine, other in ((module.critic, policy.critic), (module.target_critic, policy.target_critic)):
        given = other.state_dict()
        for name, value in mine.state_dict().items():
            member = torch.arange(len(value)) % 2 if value.ndim == 3 else slice(None)  # layer norms are shared
            value.copy_(given[name][member])
