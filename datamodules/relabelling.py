"""The settings of relabelling, in one record that travels; a new setting is one more field."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from dds_lightning.errors import UserError
from dds_lightning.tasks import Task

Discount = Literal["per_skill", "per_step"]


@dataclass(frozen=True)
class Relabelling:
    """How segments become transitions, beside the data and the skills.

    Every field is a flag of `dds relabel` and of `--data` of `dds policy`, and part of the key of the cache.

    Attributes:
        gamma: Discount a step inside a skill, in (0, 1].
        discount: Factor on the bootstrap: gamma (per_skill, the paper's formula) or gamma^steps (per_step).
        stride: Steps between the starts of two segments.
        reward_scale: The learning reward is reward_scale * (reward + reward_shift); null takes the task's scale.
        reward_shift: See reward_scale; null takes the task's shift.
    """

    gamma: float = 0.99
    discount: Discount = "per_skill"
    stride: int = 1
    reward_scale: float | None = None
    reward_shift: float | None = None

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if not 0.0 < self.gamma <= 1.0:
            raise UserError(f"gamma is {self.gamma}, expected a discount in (0, 1]")
        if self.discount not in ("per_skill", "per_step"):
            raise UserError(f"discount is '{self.discount}', expected per_skill or per_step")

    def for_task(self, task: Task | None) -> Relabelling:
        """The same with a task's scale and shift in place of None; 1 and 0 without a task."""
        scale, shift = (task.reward_scale, task.reward_shift) if task else (1.0, 0.0)
        return replace(
            self,
            reward_scale=scale if self.reward_scale is None else self.reward_scale,
            reward_shift=shift if self.reward_shift is None else self.reward_shift,
        )

    def settings(self) -> dict[str, Any]:
        """Every field by name."""
        return asdict(self)
