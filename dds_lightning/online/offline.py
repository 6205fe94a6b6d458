"""From offline to online: an online training that starts from the policy and the critics of `dds policy fit`.

A policy found by regression is a network, which is taken as it is. One in closed form, pi = beta exp(alpha A), is three
networks that no gradient step could change together: the network of beta is taken, and taught to be pi in the states of
the prior data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.fingerprint import cure_of_old, same, told_apart

SHAPE = ("observation_dim", "hidden_dims", "fourier_features", "fourier_seen", "layer_norm")
LESSONS, LESSON_SIZE, LESSON_RATE = 2_000, 512, 1e-3
"""Steps, states in a step, and learning rate with which a policy in closed form becomes a network."""


def one_start(offline: Any, init_from: Any) -> str | None:
    """The offline policy to start from, if there is one.

    Raises:
        UserError: Another checkpoint to start from was given too.
    """
    if offline is not None and init_from is not None:
        raise UserError(
            f"model.offline is {offline} and model.init_from is {init_from}, expected one of them: weights can start "
            "from an offline policy or from an online training"
        )
    return None if offline is None else str(offline)


def refuse_other_policy(policy: PolicyModule, path: str, skill_hash: str | None, choices: int) -> None:
    """Refuse an offline policy over other codes.

    Args:
        policy: Of `path`.
        path: Where it is, for the message.
        skill_hash: Fingerprint of the skill model whose codes are to be chosen; None if it is unknown.
        choices: K of that model.

    Raises:
        UserError: It chooses among the codes of another model.
    """
    there = policy.hparams
    if there.skill_hash and skill_hash and not same(there.skill_hash, skill_hash, policy.OF_DECODER):
        was, found = told_apart(there.skill_hash, skill_hash)
        raise UserError(
            f"model.offline: {path} was trained on skill model {was}, data.skill is {found}: give the skill model that "
            f"it was trained on{cure_of_old(there.skill_hash, skill_hash, policy.OF_DECODER)}"
        )
    if there.num_skills != choices:
        raise UserError(
            f"data.skill has {choices} codes, but the policy in {path} chooses among {there.num_skills}: give the "
            "skill model that it was trained on"
        )


def refuse_other_networks(policy: PolicyModule, path: str, model: Mapping[str, Any], with_data: bool) -> None:
    """Refuse an offline policy whose networks have another shape, or that needs the states of prior data.

    Args:
        policy: Of `path`.
        path: Where it is, for the message.
        model: Settings of the online module.
        with_data: Whether there are prior data.

    Raises:
        UserError: A setting differs, or it is in closed form where there are no prior data.
    """
    there = policy.hparams
    for name in SHAPE:
        if model[name] != there[name]:
            raise UserError(f"model.{name} is {model[name]}, but the policy in {path} has {there[name]}: give the same")
    if there.awr == "closed_form" and not with_data:
        raise UserError(
            f"model.offline: the policy in {path} is in closed form and becomes a network in the states of prior data: "
            "give them with data.data, or a policy trained with --model.awr=regression"
        )


@torch.no_grad()
def start_offline(module: Any, path: str, states: Tensor | None = None) -> None:
    """Give an online module the normaliser, the features, the policy and the critics of an offline one.

    The two offline critics are dealt out where there are more.

    Args:
        module: A `SACModule` over the same codes.
        path: `.ckpt` or published directory of the policy.
        states: (N, O) observations of the prior data, which a policy in closed form needs.

    Raises:
        UserError: It is no policy, chooses among other codes, has networks of another shape, or is in closed form where
            there are no prior data.
    """
    policy = PolicyModule.load(path)
    here = module.hparams
    if not module.discrete:
        raise UserError(
            f"model.offline is {path}, a policy over codes, but the choices are {here.space}: expected discrete"
        )
    refuse_other_policy(policy, path, here.skill_hash, here.choices)
    refuse_other_networks(policy, path, here, states is not None)
    module.normaliser.load_state_dict(policy.normaliser.state_dict())
    module.features.load_state_dict(policy.features.state_dict())
    module.actor.net.load_state_dict(policy.actor.state_dict())
    module.support_mask.copy_(policy.support_mask)
    module.settle_entropy()
    for mine, other in ((module.critic, policy.critic), (module.target_critic, policy.target_critic)):
        given = other.state_dict()
        for name, value in mine.state_dict().items():
            member = torch.arange(len(value)) % 2 if value.ndim == 3 else slice(None)  # layer norms are shared
            value.copy_(given[name][member])
    if policy.hparams.awr == "closed_form":
        assert states is not None
        _teach(module, policy, states)


@torch.enable_grad()
def _teach(module: Any, policy: PolicyModule, states: Tensor) -> None:
    """Minimise KL(policy || actor) over the states (N, O), in an order of its own."""
    policy.to(module.device)
    optimiser = torch.optim.Adam(module.actor.parameters(), LESSON_RATE)
    generator = torch.Generator().manual_seed(0)
    for lesson in range(LESSONS):
        for group in optimiser.param_groups:
            group["lr"] = LESSON_RATE * (1.0 - lesson / LESSONS)
        seen = states[torch.randint(len(states), (LESSON_SIZE,), generator=generator)].to(module.device)
        with torch.no_grad():
            taught = policy.logits(seen).softmax(dim=-1)  # (B, K)
        learnt = module.logits(seen).log_softmax(dim=-1).masked_fill(~policy.support_mask, 0.0)
        loss = -(taught * learnt).sum(dim=-1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    optimiser.zero_grad()
