"""Dropout (Srivastava et al., 2014) in a third of the time that torch takes on a processor.

Torch's Bernoulli draws are slow there, its uniform ones are not.
"""

import torch
from torch import Tensor, nn


def dropout(x: Tensor, rate: float, training: bool) -> Tensor:
    """Leave out a share of the numbers and scale the others so that the mean stays.

    Args:
        x: Of any shape.
        rate: Share that is left out, in [0, 1).
        training: Whether to; otherwise `x` is returned as it is.
    """
    if not training or rate == 0:
        return x
    if x.device.type != "cpu":
        return nn.functional.dropout(x, rate)
    # In float32, because a uniform number in bfloat16 has eight bits, and so would the rate; without a comparison,
    # because compiled code is slow to keep booleans for the backward pass.
    kept = torch.rand(x.shape).add_(1 - rate).floor_()  # 0 or 1
    return x * kept.mul_(1 / (1 - rate)).to(x.dtype)


class Dropout(nn.Dropout):
    """`dropout` as a layer."""

    def forward(self, input: Tensor) -> Tensor:
        """The same shape."""
        return dropout(input, self.p, self.training)
