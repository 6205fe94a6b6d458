"""Units: observations to zero mean and unit variance, actions to the cube [-1, 1], kept inside the model.

The statistics are buffers, so a checkpoint acts without the data set it was trained on.
"""

import torch
from torch import Tensor, nn

from dds_lightning.errors import UserError

MIN_STD = 1e-3
"""Floor of the standard deviation: a dimension that never moves in the data must not blow up in use."""


class Normaliser(nn.Module):
    """Affine map of observations to zero mean and unit standard deviation.

    Args:
        dim: Width O of an observation.
    """

    mean: Tensor
    std: Tensor
    fitted: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))
        self.register_buffer("fitted", torch.tensor(False))

    def fit(self, mean: Tensor, std: Tensor) -> None:
        """Take over the statistics (each (O,)) of the training data, in place.

        Raises:
            UserError: The statistics have another width than the model.
        """
        if mean.shape != self.mean.shape:
            raise UserError(
                f"observation statistics have {mean.shape[-1]} dimensions, the model expects "
                f"{self.mean.shape[-1]}: train on data of this task or change observation_dim"
            )
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(MIN_STD))
        self.fitted.fill_(True)

    def forward(self, observations: Tensor) -> Tensor:
        """Normalise observations (..., O)."""
        return (observations - self.mean) / self.std


class ActionBox(nn.Module):
    """Affine map between an action box and the cube [-1, 1] in which the decoder works.

    Args:
        dim: Width A of an action.
    """

    low: Tensor
    high: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("low", -torch.ones(dim))
        self.register_buffer("high", torch.ones(dim))

    def fit(self, low: Tensor, high: Tensor) -> None:
        """Take over the bounds (each (A,)) of the environment's action space, in place."""
        if low.shape != self.low.shape:
            raise UserError(
                f"the action box has {low.shape[-1]} dimensions, the model expects {self.low.shape[-1]}: "
                "train on data of this task or change action_dim"
            )
        self.low.copy_(low)
        self.high.copy_(high)

    def to_unit(self, actions: Tensor) -> Tensor:
        """Map actions (..., A) from the box to [-1, 1]."""
        return 2.0 * (actions - self.low) / (self.high - self.low) - 1.0

    def from_unit(self, actions: Tensor) -> Tensor:
        """Map actions (..., A) from [-1, 1] back to the box, clipped to it."""
        return self.low + 0.5 * (actions.clamp(-1.0, 1.0) + 1.0) * (self.high - self.low)
