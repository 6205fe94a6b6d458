"""What every Trainer of this project has: where it logs, how it saves, how it stops.

The command line and `dds run` both build their Trainer through `trainer_settings`, so that they cannot
differ.
"""

import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from dds_lightning.callbacks import ExactResume, FiniteGuard
from dds_lightning.checkpointing import AtomicCheckpointIO
from dds_lightning.errors import UserError
from dds_lightning.training import interrupts
from dds_lightning.training.progress import StepProgress


class RollingCheckpoint(Checkpoint):
    """Keep one file, `last.ckpt`, from which training goes on exactly where it stood.

    It is written after an optimiser step whenever `every_n_steps` steps or `every_n_seconds` seconds have
    passed, at the end, and when SIGTERM or Ctrl-C asks to stop. What follows that step, its metrics and a validation
    that is due, is still done; then `Interrupted` is raised. An error writes nothing: the state that failed must not
    replace the last good one.

    Args:
        dirpath: folder of the file; null puts it beside the logs of this launch.
        every_n_seconds: seconds between two writes; 0 for none by time.
        every_n_steps: steps between two writes; 0 for none by steps.
    """

    def __init__(self, dirpath: str | None = None, every_n_seconds: float = 60.0, every_n_steps: int = 0) -> None:
        if every_n_seconds < 0 or every_n_steps < 0:
            found = f"{every_n_seconds} and {every_n_steps}"
            raise UserError(f"checkpoint.every_n_seconds and checkpoint.every_n_steps are {found}, expected 0 or more")
        self.dirpath = dirpath
        self.every_n_seconds = every_n_seconds
        self.every_n_steps = every_n_steps
        self.path: Path | None = None
        self.metrics: dict[str, float] = {}
        self._saved_step = -1
        self._saved_time = time.monotonic()
        self._unflushed = self._leaving = False

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Settle where the file goes."""
        if stage == "fit":
            folder = self.dirpath or str(Path(trainer.log_dir or trainer.default_root_dir) / "checkpoints")
            self.path = Path(trainer.strategy.broadcast(folder)) / "last.ckpt"

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Count the seconds from here: what lies before cannot be lost."""
        # Lightning's own SIGTERM handler ends the program between two steps, and nothing is saved.
        interrupts.take_back()
        self._saved_time = time.monotonic()
        self._saved_step = trainer.global_step

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Everything that belongs to the step before is logged now: stop here if somebody asked to."""
        if self._unflushed:
            # A kill must not cost metrics of steps that are saved: nobody would do these steps again.
            for logger in trainer.loggers:
                logger.save()
            self._unflushed = False
        self._leave()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when it is time, or when somebody asked to stop."""
        step = trainer.global_step
        by_time = self.every_n_seconds > 0 and time.monotonic() - self._saved_time >= self.every_n_seconds
        if trainer.world_size > 1:
            by_time = trainer.strategy.broadcast(by_time)  # every process takes part in a save, and clocks differ
        by_steps = self.every_n_steps > 0 and step % self.every_n_steps == 0
        if self._asked_to_stop(trainer) or ((by_time or by_steps) and step != self._saved_step):
            self._save(trainer)

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save again what was saved before this validation: on resuming, Lightning would leave it out."""
        if trainer.state.fn != "fit" or trainer.sanity_checking:
            return
        if self._asked_to_stop(trainer) or self._saved_step == trainer.global_step:
            self._save(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the finished model."""
        if self._saved_step != trainer.global_step or not (self.path and self.path.exists()):
            self._save(trainer)
        self._leave()

    def state_dict(self) -> dict[str, Any]:
        """The last value of every metric: a training that goes on may end before it measures some of them again."""
        return {"metrics": self.metrics}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.metrics = state_dict.get("metrics", {})

    def latest(self, trainer: pl.Trainer) -> dict[str, float]:
        """The last value of every metric of this training, launches before this one included."""
        return {**self.metrics, **{name: float(value) for name, value in trainer.callback_metrics.items()}}

    def _asked_to_stop(self, trainer: pl.Trainer) -> bool:
        asked = interrupts.pending() is not None
        if trainer.world_size > 1:
            asked = trainer.strategy.reduce_boolean_decision(asked, all=False)  # not all may have got the signal
        self._leaving = self._leaving or asked
        return asked

    def _leave(self) -> None:
        if self._leaving:
            raise interrupts.Interrupted(interrupts.pending() or interrupts.SIGNALS[0], str(self.path))

    def _save(self, trainer: pl.Trainer) -> None:
        assert self.path is not None, "setup('fit') comes first"
        self.metrics = self.latest(trainer)
        trainer.save_checkpoint(self.path)
        self._saved_step, self._saved_time, self._unflushed = trainer.global_step, time.monotonic(), True


class KeptSettings(Callback):
    """Keep in every checkpoint how its training was asked for, so that a contradiction is noticed on resuming.

    Args:
        settings: dotted name -> plain value.
    """

    KEY = "settings"
    """Entry of the checkpoint."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add them."""
        checkpoint[self.KEY] = self.settings


class BestCheckpoint(ModelCheckpoint):
    """Also keep the checkpoint with the best value of a logged metric, as `best.ckpt` beside `last.ckpt`.

    Args:
        monitor: name of the metric, e.g. `rollout/score`; null keeps none.
        mode: `max` or `min`.
        every_n_steps: look after every so many optimiser steps; null looks after validations.
    """

    def __init__(
        self, monitor: str | None = None, mode: Literal["max", "min"] = "max", every_n_steps: int | None = None
    ) -> None:
        super().__init__(
            filename="best",
            monitor=monitor,
            mode=mode,
            save_top_k=1,
            enable_version_counter=False,
            every_n_train_steps=every_n_steps,
            save_on_train_epoch_end=False,  # after the validation: `RollingCheckpoint` keeps what this one knows then
        )
        self.every_n_steps = every_n_steps

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Look right after the step: at an epoch's end Lightning waits for a validation, and keeps later weights."""
        if not self.every_n_steps or trainer.global_step % self.every_n_steps:
            return
        candidates = self._monitor_candidates(trainer)
        if self.monitor in candidates and not self._should_skip_saving_checkpoint(trainer):
            self._save_topk_checkpoint(trainer, candidates)


def loggers(root: str | Path) -> list[Logger]:
    """CSV always, TensorBoard when installed; each launch gets its own `logs/version_N` under `root`."""
    csv = CSVLogger(root, name="logs")
    if not any(find_spec(name) for name in ("tensorboard", "tensorboardX")):
        return [csv]
    return [csv, TensorBoardLogger(root, name="logs", version=csv.version)]


def trainer_settings(config: dict[str, Any], extra: list[Callback]) -> dict[str, Any]:
    """Complete a Trainer's settings with this project's parts, as long as the user did not choose others.

    Args:
        config: keyword arguments of `Trainer`, as a user gave them.
        extra: callbacks beside those in `config`; checkpoints among them are left out where checkpointing is
            off.

    Returns:
        The keyword arguments to build the Trainer with.
    """
    config = dict(config)
    root = config.get("default_root_dir") or "."
    if config.get("logger") is None or config["logger"] is True:
        config["logger"] = loggers(root)
    elif config["logger"] is not False:
        chosen = config["logger"] if isinstance(config["logger"], list) else [config["logger"]]
        has_csv = any(isinstance(logger, CSVLogger) for logger in chosen)
        config["logger"] = chosen if has_csv else [CSVLogger(root, name="logs"), *chosen]

    saves = config.get("enable_checkpointing") is not False and not config.get("fast_dev_run")
    callbacks = config.get("callbacks") or []
    callbacks = [
        *(callbacks if isinstance(callbacks, list) else [callbacks]),
        *(callback for callback in extra if saves or not isinstance(callback, Checkpoint)),
    ]
    callbacks = [c for c in callbacks if not (isinstance(c, BestCheckpoint) and c.monitor is None)]
    rolling = next((c for c in callbacks if isinstance(c, RollingCheckpoint)), None)
    for callback in callbacks:
        if isinstance(callback, BestCheckpoint) and rolling is not None:
            callback.dirpath = rolling.dirpath
    for default in (ExactResume, FiniteGuard):
        if not any(isinstance(callback, default) for callback in callbacks):
            callbacks.append(default())
    if config.get("enable_progress_bar") is not False and not any(
        isinstance(callback, ProgressBar) for callback in callbacks
    ):
        callbacks.append(StepProgress())
    # Last of all: what others note at the same moment, the best score for example, belongs into its file.
    config["callbacks"] = sorted(callbacks, key=lambda callback: isinstance(callback, RollingCheckpoint))

    plugins = config.get("plugins") or []
    plugins = list(plugins) if isinstance(plugins, list) else [plugins]
    if saves:
        plugins.append(AtomicCheckpointIO())
    config["plugins"] = plugins
    return config
