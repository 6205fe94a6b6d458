"""End a training when more of it would hardly help, by held-out loss."""

from __future__ import annotations

import math
from typing import Any, Literal

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.callbacks import Callback

from dds_lightning.errors import UserError


class Convergence(Callback):
    """Stop when held-out loss has levelled off; `trainer.max_steps` is the budget in any case.

    After each validation a line is fitted to log(loss) over log(step), from half of the steps so far to now: learning
    curves are nearly straight there, and the line says by how much the loss would fall with a quarter more steps. When
    that is less than `tolerance`, the training is done. Let the weights be averaged (`average.decay`) and the learning
    rate constant: a curve that is flat because the learning rate has decayed proves nothing.

    Args:
        when: ``converged`` stops as described, ``steps`` at `max_steps` alone.
        monitor: The metric, logged at validations.
        min_steps: Steps before which a training never stops.
        tolerance: Relative fall of the loss for a quarter more steps that is still worth them.

    Attributes:
        history: (step, loss) of every validation.

    Raises:
        UserError: A setting outside its range, or a metric that is not logged.
    """

    MORE = 1.25
    """The prediction is for this many times the steps so far."""
    FEWEST = 5
    """Validations that a line needs."""

    def __init__(
        self,
        when: Literal["converged", "steps"] = "steps",
        monitor: str = "val/loss",
        min_steps: int = 1000,
        tolerance: float = 0.03,
    ) -> None:
        if min_steps < 0:
            raise UserError(f"stop.min_steps is {min_steps}, expected 0 or more")
        if not 0.0 < tolerance < 1.0:
            raise UserError(f"stop.tolerance is {tolerance}, expected a share in (0, 1)")
        self.when, self.monitor, self.min_steps, self.tolerance = when, monitor, min_steps, tolerance
        self.history: list[tuple[int, float]] = []

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the loss, and stop if it has levelled off."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        if self.monitor not in trainer.callback_metrics:
            if self.when == "steps":
                return
            logged = ", ".join(sorted(trainer.callback_metrics))
            raise UserError(f"stop.monitor is {self.monitor}, which is not logged; expected one of {logged}")
        self.history.append((trainer.global_step, float(trainer.callback_metrics[self.monitor])))
        if self.when == "converged" and self.converged:
            trainer.should_stop = True

    @property
    def converged(self) -> bool:
        """Whether the loss has levelled off."""
        fall = expected_fall(self.history, self.MORE, self.FEWEST)
        return self.history[-1][0] >= self.min_steps and not math.isnan(fall) and fall < self.tolerance

    def remark(self) -> str | None:
        """Say by how much held-out loss would still fall; None where it has levelled off, or nothing is known."""
        fall = expected_fall(self.history, self.MORE, self.FEWEST) if self.history else math.nan
        if math.isnan(fall) or fall < self.tolerance:
            return None
        return (
            f"{self.monitor} would fall by another {100 * fall:.0f} % with a quarter more steps; if the agent "
            "disappoints, raise --trainer.max_steps"
        )

    def state_dict(self) -> dict[str, Any]:
        """The curve so far."""
        return {"history": [list(point) for point in self.history]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.history = [(int(step), float(loss)) for step, loss in state_dict["history"]]


def expected_fall(history: list[tuple[int, float]], more: float = 1.25, fewest: int = 5) -> float:
    """By which share the loss would fall with `more` times the steps, by a line through the later half of the curve.

    Args:
        history: (step, loss), ascending; losses are positive.
        more: Factor on the steps so far.
        fewest: Points that the line needs.

    Returns:
        1 - predicted loss / loss on the line now; NaN with too few points. Negative where the loss rises.
    """
    points = np.array([(step, loss) for step, loss in history if step >= history[-1][0] / 2 and loss > 0])
    if len(points) < fewest:
        return math.nan
    steps, losses = np.log(points).T
    slope = np.polyfit(steps, losses, 1)[0]
    return 1.0 - more ** float(slope)
