"""Skills whose decoder goes on learning online: it becomes better at what a code is good for.

The decoder repeats what was done under a code where that turned out better than the critics expected of the code:

```
 w = exp((y - Q(s, k)) / spread)     y = R + discount (1 - done) V'(s')        a skill of H steps
 w |predicted noise - noise|^2       of one of its steps (equation 5)
```

Codes keep their meaning: encoder and codebook stand still, and the critics see what a code leads to now. The policy
acts with this decoder alone: an agent that joins it to another is refused (`dds_lightning.saving.fingerprint`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

import dds_lightning.losses as losses
from dds_lightning.errors import UserError
from dds_lightning.skill import SkillModule

CLIP = 20.0
"""Upper bound of a weight."""


class Follower(nn.Module):
    """A copy of the skill model; only its decoder learns.

    Args:
        settings: Of the skill model.
        lr: Learning rate of the decoder.
    """

    def __init__(self, settings: Mapping[str, Any], lr: float) -> None:
        super().__init__()
        self.lr = lr
        self.skill = SkillModule(**settings)
        self.skill.requires_grad_(False)
        self.skill.decoder.requires_grad_(True)

    def train(self, mode: bool = True) -> Follower:
        """Stay in evaluation mode: the decoder acts while it learns, without dropout."""
        return super().train(False)

    def start(self, skill: SkillModule) -> None:
        """Begin as a skill model, unless a checkpoint brought the weights."""
        if not bool(self.skill.normaliser.fitted):
            self.skill.load_state_dict(skill.state_dict())

    def refuse_prior_alone(self, data: Any) -> None:
        """Refuse batches of an `OnlineDataModule` in which the decoder finds nothing that was played here."""
        if data.prior_rows == data.batch_size:
            raise UserError(
                f"model.follow is {self.lr}, but data.prior_share {data.hparams.prior_share} leaves no collected "
                "transition in a batch for the decoder to learn from: give a smaller share"
            )

    def groups(self, module: nn.Module) -> list[dict[str, Any]]:
        """What learns of a module that this one is part of, as groups of an optimiser: the decoder has its own rate."""
        decoder = list(self.skill.decoder.parameters())
        known = {id(one) for one in decoder}
        others = [one for one in module.parameters() if one.requires_grad and id(one) not in known]
        return [{"params": others}, {"params": decoder, "lr": self.lr, "name": "decoder"}]

    def loss(self, batch: Mapping[str, Tensor], advantages: Tensor) -> Tensor:
        """Weighted denoising loss.

        Args:
            batch: ``actions`` (B,) codes or (B, D) vectors; of the first n, which were played here and not by those who
                made prior data, one step: ``step_observations`` (n, O) and ``step_actions`` (n, A).
            advantages: (B,) how much better each went than the critics expected.
        """
        played = len(batch["step_actions"])
        advantages, skills = advantages[:played], batch["actions"][:played]
        spread = advantages.std(correction=0).clamp_min(1e-6)
        weights = losses.awr_weights(advantages / spread, 1.0, CLIP)  # (n,)
        error = self.skill.decoder.loss(
            self.skill.action_box.to_unit(batch["step_actions"]),
            self.skill.normaliser(batch["step_observations"]),
            self.skill.vectors(skills),
        )
        return (weights * error.mean(dim=-1)).sum() / weights.sum()
