"""End a training when more of it would hardly help, by held-out loss."""

from __future__ import annotations

import math
from typing import Any, Literal

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.callbacks import Callback

from dds_lightning.errors import UserError
from dds_lightning.module import planned_steps

OVERFIT = 0.2
"""Rise of held-out loss above its lowest level that is no accident: validations draw the same noise every time, and
where data suffice their losses wander by a few per cent."""


class Convergence(Callback):
    """Stop when held-out loss has levelled off; `trainer.max_steps` is the budget in any case.

    After each validation a line is fitted to log(loss) over log(step), from half of the steps so far to now: learning
    curves are nearly straight there, and the line says by how much the loss would fall with a quarter more steps. When
    that is less than `tolerance`, the training is done. Let the weights be averaged (`average.decay`) and the learning
    rate constant until then: a curve that is flat because the learning rate has decayed proves nothing.

    Args:
        when: ``converged`` stops as described, ``steps`` at `max_steps` alone.
        monitor: The metric, logged at validations.
        min_steps: Steps before which a training never stops.
        tolerance: Relative fall of the loss for a quarter more steps that is still worth them.
        decay: Steps at the end over which a constant learning rate falls to zero, in a straight line, though at most a
            fifth of all; 0 for none. A training that is continued later goes on at the full rate.

    Attributes:
        history: (step, loss) of every validation at the full learning rate.
        trained: The same loss of training batches at these steps, where it is logged.
        ends: Step at which a training ends that has levelled off; None until then.

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
        decay: int = 0,
    ) -> None:
        if min_steps < 0:
            raise UserError(f"stop.min_steps is {min_steps}, expected 0 or more")
        if not 0.0 < tolerance < 1.0:
            raise UserError(f"stop.tolerance is {tolerance}, expected a share in (0, 1)")
        if decay < 0:
            raise UserError(f"stop.decay is {decay}, expected 0 or more steps")
        self.when, self.monitor, self.min_steps, self.tolerance = when, monitor, min_steps, tolerance
        self.decay = decay
        self.history: list[tuple[int, float]] = []
        self.trained: list[tuple[int, float]] = []
        self.ends: int | None = None
        self._budget = -1  # steps at which the training ends in any case, -1 for no end
        self._decay = decay  # 0 where the learning rate has a schedule of its own
        self._rates: list[float] | None = None  # full learning rates, while they are lowered

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Look when the training ends and whether its rate is constant, and go on where a former one had ended."""
        self._budget = planned_steps(trainer)
        self._decay = self.decay if pl_module.hparams.get("lr_schedule", "constant") == "constant" else 0
        if self.ends is not None and trainer.global_step >= self.ends:
            self.ends = None

    def on_train_batch_start(self, trainer: pl.Trainer, *_: Any) -> None:
        """Lower the learning rate of the step that comes, or give back the full one in a training that goes on."""
        share = self._share(trainer.global_step)
        if share == 1.0 and self._rates is None:
            return
        groups = trainer.optimizers[0].param_groups
        if self._rates is None:
            self._rates = [float(group["lr"]) for group in groups]
        for group, rate in zip(groups, self._rates, strict=True):
            group["lr"] = rate * share
        if share == 1.0:
            self._rates = None

    def _share(self, step: int) -> float:
        """Share of the full learning rate at a step."""
        end = self._budget if self.ends is None else self.ends
        down = min(self._decay, end // 5)
        return min(1.0, max(0.0, (end - step) / down)) if down > 0 else 1.0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Stop when the learning rate has come down."""
        if self.ends is not None and trainer.global_step >= self.ends:
            trainer.should_stop = True

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the loss, and begin to stop if it has levelled off."""
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return
        if self.monitor not in trainer.callback_metrics:
            if self.when == "steps":
                return
            logged = ", ".join(sorted(trainer.callback_metrics))
            raise UserError(f"stop.monitor is {self.monitor}, which is not logged; expected one of {logged}")
        step = trainer.global_step
        if self._share(step) < 1.0:
            return
        self.history.append((step, float(trainer.callback_metrics[self.monitor])))
        if (same := self.monitor.replace("val/", "train/", 1)) != self.monitor and same in trainer.callback_metrics:
            self.trained.append((step, float(trainer.callback_metrics[same])))
        if self.when == "converged" and self.converged:
            self.ends = step + min(self._decay, step // 4)
            trainer.should_stop = self.ends <= step

    @property
    def converged(self) -> bool:
        """Whether the loss has levelled off."""
        fall = expected_fall(self.history, self.MORE, self.FEWEST)
        return self.history[-1][0] >= self.min_steps and not math.isnan(fall) and fall < self.tolerance

    def remark(self) -> str | None:
        """Say by how much held-out loss would still fall, or has risen; None where it has levelled off."""
        rise, lowest = overfit(self.history, self.trained)
        if rise > OVERFIT:
            return (
                f"{self.monitor} has risen by {100 * rise:.0f} % since step {lowest:,} while training loss fell: the "
                "data are learnt by heart; collect more of them, or lower --trainer.max_steps"
            )
        fall = expected_fall(self.history, self.MORE, self.FEWEST) if self.history else math.nan
        if math.isnan(fall) or fall < self.tolerance:
            return None
        return (
            f"{self.monitor} would fall by another {100 * fall:.0f} % with a quarter more steps; if the agent "
            "disappoints, raise --trainer.max_steps"
        )

    def state_dict(self) -> dict[str, Any]:
        """The curve so far, and the end that is near."""
        history, trained = ([list(point) for point in points] for points in (self.history, self.trained))
        return {"history": history, "trained": trained, "ends": self.ends, "rates": self._rates}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.history = [(int(step), float(loss)) for step, loss in state_dict["history"]]
        self.trained = [(int(step), float(loss)) for step, loss in state_dict.get("trained", [])]
        ends, rates = state_dict.get("ends"), state_dict.get("rates")
        self.ends = None if ends is None else int(ends)
        self._rates = None if rates is None else [float(rate) for rate in rates]


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


def overfit(history: list[tuple[int, float]], trained: list[tuple[int, float]], over: int = 3) -> tuple[float, int]:
    """By which share held-out loss has risen above its lowest level while training loss fell, and since which step.

    Args:
        history: (step, held-out loss) of every validation, ascending.
        trained: (step, training loss) of the same.
        over: Validations that a level of held-out loss is the mean of, for single ones are chance. Those of training
            loss are single batches': its level is the median of a third of the points since the lowest.

    Returns:
        The share and the step; (0, 0) where training loss did not fall, or nothing is known.
    """
    if len(history) < 2 * over or [step for step, _ in history] != [step for step, _ in trained]:
        return 0.0, 0
    held_out = np.convolve([loss for _, loss in history], np.ones(over) / over, "valid")
    lowest = int(np.argmin(held_out)) + over // 2
    some = max(over, (len(trained) - lowest) // 3)
    then, now = (float(np.median([loss for _, loss in trained[first:][:some]])) for first in (lowest - 1, -some))
    if held_out.min() <= 0 or now >= then:
        return 0.0, 0
    return float(held_out[-1] / held_out.min() - 1.0), history[lowest][0]
