"""What stands between encoder and decoder: the protocol of every skill space (section 4.1)."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor, nn

from dds_lightning.errors import UserError


class Term(NamedTuple):
    """A scalar that a bottleneck adds to the loss."""

    value: Tensor
    """Logged as it is."""
    weight: float = 1.0
    """Factor with which it enters the sum."""


class Skill(NamedTuple):
    """The skills of a batch of segments."""

    vectors: Tensor
    """(B, D) what the decoder sees; gradients reach the encoder through them."""
    codes: Tensor | None
    """(B,) int64 indices of discrete skills; None where skills are continuous."""
    terms: Mapping[str, Term]
    """What the bottleneck adds to the loss, by name."""


class Bottleneck(nn.Module):
    """A skill space: encodings in, skills out.

    A new one is a subclass with `build` and `forward`, and a row in `skill.BOTTLENECKS`. The other methods do nothing
    unless a subclass has vectors to start, revive and report on.
    """

    discrete: ClassVar[bool] = False
    """Whether skills have codes."""
    widths: ClassVar[int] = 1
    """Numbers that the encoder gives for each of the D dimensions of a skill."""

    @classmethod
    def build(cls, settings: Any) -> Self:
        """Build it from the settings of a `SkillModule`."""
        raise NotImplementedError

    def forward(self, encodings: Tensor) -> Skill:
        """Turn encodings (B, `widths` x D) into skills."""
        raise NotImplementedError

    def lookup(self, codes: Tensor) -> Tensor:
        """Skill vectors (..., D) of codes (...).

        Raises:
            UserError: Skills are continuous.
        """
        raise UserError(f"{type(self).__name__} has continuous skills and no codes to decode: give vectors")

    def start(self, encodings: Callable[[], Tensor]) -> None:
        """Prepare for training, unless a checkpoint brought what is needed.

        Args:
            encodings: Computes encodings (N, D) of the training data.
        """

    def revive(
        self, encodings: Callable[[], Tensor], threshold: float, generator: torch.Generator
    ) -> Mapping[nn.Parameter, Tensor]:
        """Move what training has left unused to where it is needed.

        Args:
            encodings: Computes encodings (N, D) of the current batch.
            threshold: Share of uniform usage below which a code counts as dead.
            generator: The random stream.

        Returns:
            The rows (R,) that moved, by parameter; the optimiser must reset their moments.
        """
        return {}

    def health(self) -> Mapping[str, Tensor]:
        """Return scalars to log while training, computed from running statistics."""
        return {}
