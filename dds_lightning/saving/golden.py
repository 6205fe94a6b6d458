"""Answers of an agent's networks to fixed questions, published with the weights to recognise them by."""

from typing import Any

import torch

ROWS = 8
"""Questions."""


@torch.inference_mode()
def golden_answers(skill: Any, policy: Any) -> dict[str, list[list[float]]]:
    """Ask the networks of a `DDSAgent`, which are left in evaluation mode.

    Args:
        skill: Its skills.
        policy: Its policy, or None.

    Returns:
        `actions` (8, A) for fixed states, skills and noise, and, with a policy, its `logits` (8, K; 0 where the data
        have no support) or its `choices` (8, D). Six digits: other processors round differently.
    """
    skill.eval()
    device, h = skill.normaliser.mean.device, skill.hparams
    wave = torch.arange(ROWS * h["observation_dim"], device=device).reshape(ROWS, -1).float().sin()
    observations = skill.normaliser.mean + skill.normaliser.std * wave  # (8, O), as the data are spread
    if skill.discrete:
        skills = torch.arange(ROWS, device=device) % skill.num_skills
    else:
        skills = wave[:, :1].expand(ROWS, h["skill_dim"])
    size = (skill.draws, ROWS, h["action_dim"])
    noise = torch.arange(skill.draws * ROWS * h["action_dim"], device=device).reshape(size).float().cos()
    answers = {"actions": skill.decode_from(observations, skills, noise)}
    if policy is not None and skill.discrete:
        answers["logits"] = policy.eval().logits(observations).nan_to_num(neginf=0.0)
    elif policy is not None:
        answers["choices"] = policy.eval().choose(observations, "greedy")
    return {name: [[round(x, 6) for x in row] for row in answer.tolist()] for name, answer in answers.items()}
