"""Whose codes these are: the fingerprint of a skill model, which policies and relabelled data keep.

```
 CODES-WHOLE     CODES   encoder, codebook, statistics and H: they decide the code of a segment
                 WHOLE   every weight, the decoder's too: it decides what a code does
```

- Relabelled data, and policies that learnt from such data, belong to the codes. The decoder may be tuned afterwards.
- A policy that learnt by acting (`StageModule.OF_DECODER`) belongs to the whole: what that decoder did was its
  environment, and its critics value nothing else.

Version 0.1.0 kept WHOLE alone, which is still taken for the model that it was made of.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dds_lightning.saving.files import short

_JOINT = "-"
_NOT_OF_CODES = ("decoder.", "bottleneck.usage", "bottleneck.ema_", "bottleneck.initted")
"""Weights and running averages on which no code depends."""
_SETTINGS_OF_CODES = ("horizon", "encoder_heads")
"""Settings on which codes depend and which no weight shows."""


def digest(state: Mapping[str, Tensor], more: str = "") -> str:
    """SHA-256 of tensors with their names, and of a text."""
    found = hashlib.sha256()
    for name, tensor in sorted(state.items()):
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    found.update(more.encode())
    return found.hexdigest()


def of_skills(state: Mapping[str, Tensor], settings: Mapping[str, Any]) -> str:
    """The fingerprint of a skill model, the same wherever it is stored.

    Args:
        state: Its weights and buffers.
        settings: Its hyper-parameters.
    """
    codes = {name: value for name, value in state.items() if not name.startswith(_NOT_OF_CODES)}
    said = " ".join(f"{name}={settings.get(name)}" for name in _SETTINGS_OF_CODES)
    return f"{digest(codes, said)}{_JOINT}{digest(state)}"


def same(one: str, other: str, whole: bool = False) -> bool:
    """Whether two fingerprints are of models with the same codes; with `whole`, and with the same decoder."""
    (codes, everything), (other_codes, other_everything) = halves(one), halves(other)
    if codes == everything or other_codes == other_everything:
        return everything == other_everything
    return codes == other_codes and (not whole or everything == other_everything)


def told_apart(one: str, other: str) -> tuple[str, str]:
    """The beginnings of two fingerprints that differ, for people to compare."""
    (codes, whole), (other_codes, other_whole) = halves(one), halves(other)
    if codes == other_codes:
        return f"{short(codes)} with decoder {short(whole)}", f"{short(codes)} with decoder {short(other_whole)}"
    if codes == whole or other_codes == other_whole:
        return short(whole), short(other_whole)
    return short(codes), short(other_codes)


def cure_of_old(policy: str, skills: str, whole: bool) -> str:
    """What ends the message about a policy that does not fit these skills, where it may be its age alone.

    Args:
        policy: Fingerprint that the policy keeps.
        skills: Fingerprint of the skill model.
        whole: As of `same`.
    """
    if whole or _JOINT in policy or _JOINT not in skills:
        return ""
    return (
        "; if only their decoder was tuned since, publish this policy of version 0.1.0 once with the skills that it "
        "was trained with (`dds publish - DIR --skill THOSE.ckpt --policy POLICY.ckpt`), and give DIR as the policy"
    )


def completed(policy: Mapping[str, Any], state: Mapping[str, Tensor], skill: Any) -> Mapping[str, Any]:
    """Settings of a published policy, which learns the codes' fingerprint where it knew only the whole model's.

    Args:
        policy: Its settings.
        state: Weights of the skills that were published with it.
        skill: Their settings; anything but a mapping where there are none.
    """
    known = policy.get("skill_hash")
    if not isinstance(known, str) or _JOINT in known or not isinstance(skill, Mapping) or known != digest(state):
        return policy
    return {**policy, "skill_hash": of_skills(state, skill)}


def halves(fingerprint: str) -> tuple[str, str]:
    """CODES and WHOLE; one of version 0.1.0 stands for both."""
    codes, joint, whole = str(fingerprint).partition(_JOINT)
    return codes, whole if joint else codes
