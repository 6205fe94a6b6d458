"""A training stage of one's own: the one file that it takes beside its row in the registry."""

from typing import Any

import torch
from torch import Tensor, nn

from dds_lightning.module import StageModule
from dds_lightning.nn.normaliser import Normaliser


class Forward(StageModule):
    """Predict the next observation from the one before.

    Args:
        observation_dim: O, linked from the data.
        lr: Adam's learning rate.
        lr_schedule: As of every stage.
        init_from: Weights to start from.
    """

    STAGE = "forward"
    PREDICTION = "next"

    def __init__(
        self, observation_dim: int, lr: float = 1e-2, lr_schedule: str = "constant", init_from: str | None = None
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["init_from"])
        self.normaliser = Normaliser(observation_dim)
        self.net = nn.Linear(observation_dim, observation_dim)
        self._begin(init_from)

    def on_fit_start(self) -> None:
        if not bool(self.normaliser.fitted):
            statistics: dict[str, Tensor] = self.trainer.datamodule.statistics()
            self.normaliser.fit(statistics["observation_mean"], statistics["observation_std"])

    def loss(self, batch: dict[str, Tensor]) -> Tensor:
        x = self.normaliser(batch["observations"])  # (B, H, O)
        noise = 0.01 * torch.randn_like(x[:, 1:])  # a resumed training must go on with the same
        return (self.net(x[:, :-1]) + noise - x[:, 1:]).square().mean()

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> Tensor:
        return self.loss(batch)

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        self.log("val/loss", self.loss(batch), batch_size=len(batch["actions"]))

    def predict_step(self, batch: dict[str, Tensor], batch_idx: int) -> Any:
        return self.net(self.normaliser(batch["observations"][:, 0]))
