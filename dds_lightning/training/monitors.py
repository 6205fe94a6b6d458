"""What a training watches: a metric that is never logged, or a validation that never comes, is refused beforehand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NoReturn

from jsonargparse import Namespace

from dds_lightning.console.refusals import did_you_mean
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task
from dds_lightning.training.stages import Stage

OURS = ("dds_lightning.", "lightning.")
"""Whose callbacks log nothing but what is said here; others may log anything."""
ALWAYS = ("epoch", "step")
"""What Lightning offers to every `ModelCheckpoint`."""


def refuse_unlogged(stage: Stage, settings: Namespace) -> None:
    """Refuse a metric to watch that is never logged.

    Args:
        stage: Whose training it is; one that does not declare its metrics may log anything.
        settings: Of its `fit`.

    Raises:
        UserError: Names the setting, the metric and those that are logged.
    """
    callbacks = _callbacks(settings)
    if not stage.metrics or not all(one.class_path.startswith(OURS) for one in callbacks):
        return
    logged = sorted(_logged(stage, settings, callbacks))
    for setting, metric in _watched(settings, callbacks):
        # Where nothing is validated a training that would stop by `stop.monitor` ends at its steps.
        if metric in logged or metric in (stage.metrics if setting == "stop.monitor" else ALWAYS):
            continue
        if metric.startswith("rollout/") and not any(name.startswith("rollout/") for name in logged):
            remedy = "which only a RolloutEvaluation logs: add --trainer.callbacks+=dds_lightning.callbacks."
            raise UserError(f"{setting} is {metric}, {remedy}RolloutEvaluation")
        refuse_metric(stage, setting, metric, logged)


def refuse_metric(stage: Stage, setting: str, metric: str, logged: Iterable[str]) -> NoReturn:
    """Refuse one metric.

    Raises:
        UserError: Names the setting, the metric and those that are logged.
    """
    logged = sorted(logged)
    hint = did_you_mean(metric.replace("_", "/", 1), logged) or did_you_mean(metric, logged)
    raise UserError(
        f"{setting} is {metric}, which the {stage.name} training never logs, expected one of {', '.join(logged)}{hint}"
    )


def refuse_late_validation(settings: Namespace, steps: int) -> None:
    """Refuse an interval between validations that no epoch is long enough for.

    Args:
        settings: Of a `fit`.
        steps: Of the data; an epoch has at most one segment or transition for each.

    Raises:
        UserError: Says what is possible.
    """
    trainer, batches = settings.trainer, -(-steps // settings.data.batch_size)
    limit, every = trainer.limit_train_batches, trainer.val_check_interval
    if limit is not None:
        batches = min(batches, limit) if type(limit) is int else int(batches * limit)
    if type(every) is int and every > batches and trainer.check_val_every_n_epoch is not None:
        raise UserError(
            f"trainer.val_check_interval is {every}, but an epoch has at most {batches} batches: give a smaller one, "
            "or trainer.check_val_every_n_epoch=null to count batches across epochs"
        )


def _callbacks(settings: Namespace) -> list[Namespace]:
    chosen = settings.trainer.callbacks or []
    return chosen if isinstance(chosen, list) else [chosen]


def _watched(settings: Namespace, callbacks: list[Namespace]) -> Iterator[tuple[str, str]]:
    """(setting, metric) of everything that watches one."""
    if settings.best.monitor is not None:
        yield "best.monitor", settings.best.monitor
    if settings.stop.when != "steps":
        yield "stop.monitor", settings.stop.monitor
    for callback in callbacks:
        given = callback.get("init_args") or {}
        if given.get("monitor") and given.get("strict", True):
            yield f"trainer.callbacks: monitor of {callback.class_path.rpartition('.')[2]}", given["monitor"]


def _logged(stage: Stage, settings: Namespace, callbacks: list[Namespace]) -> set[str]:
    from dds_lightning.callbacks.rollouts import RolloutEvaluation

    names = set(stage.metrics)
    if settings.trainer.limit_val_batches == 0 or settings.data.get("validation_fraction") == 0:
        names = {name for name in names if not name.startswith("val/")}
    for callback in callbacks:
        kind = callback.class_path.rpartition(".")[2]
        if kind in ("RolloutEvaluation", "RolloutVideos"):
            given: dict[str, Any] = callback.get("init_args") or {}
            name = given.get("task") or settings.data.get("task")
            success = get_task(name).measures_success if name else True
            ways = given.get("selections") or ("sample",)
            names |= RolloutEvaluation.metrics(stage.name, [ways] if isinstance(ways, str) else ways, success)
    return names
