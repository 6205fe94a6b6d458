"""What every Trainer of this project has: where it logs, how it saves, how it stops.

The command line and `dds run` both build their Trainer through `trainer_settings`, so that they cannot
differ.
"""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from jsonargparse import Namespace
from lightning.pytorch.callbacks import Callback, Checkpoint, ProgressBar
from lightning.pytorch.cli import LightningArgumentParser
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.guard import FiniteGuard
from dds_lightning.callbacks.resume import ExactResume
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.saving.checkpoint import SETTINGS_KEY, AtomicCheckpointIO
from dds_lightning.training.progress import StepProgress
from dds_lightning.training.rules import refuse_values

QUIET_LOGGERS = ("CSVLogger", "TensorBoardLogger", "WandbLogger", "MLFlowLogger")
"""Loggers that start nothing before the first value."""
CLUSTERS = ("MASTER_ADDR", "SLURM_NTASKS", "LSB_JOBID", "OMPI_COMM_WORLD_SIZE")
"""Variables by which Lightning finds the other nodes."""
THREADS = "threads"
"""Entry of a checkpoint's settings, and the setting of the command line."""


class TrainingSettings(Callback):
    """Keep in every checkpoint the settings its training was started with, so that resuming can refuse others.

    Args:
        settings: Dotted name -> plain value.
    """

    KEY = SETTINGS_KEY
    """Entry of the checkpoint."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the settings."""
        checkpoint[self.KEY] = self.settings


def loggers(root: str | Path) -> list[Logger]:
    """CSV always, TensorBoard when installed; each launch gets its own `logs/version_N` under `root`."""
    csv = CSVLogger(root, name="logs")
    if not any(find_spec(name) for name in ("tensorboard", "tensorboardX")):
        return [csv]
    return [csv, TensorBoardLogger(root, name="logs", version=csv.version)]


def log_places(trainer: pl.Trainer) -> str:
    """The folder of the logs, and the loggers that write elsewhere, for people."""
    others = [type(one).__name__ for one in trainer.loggers if not isinstance(one, CSVLogger)]
    return ", ".join([str(trainer.log_dir), *others]) if trainer.loggers else "no place, as asked"


def trial_trainer(settings: Namespace) -> pl.Trainer:
    """Make a Trainer of parsed settings, without the parts of this project that need more than it."""
    settings = settings.clone()
    loggers = settings.logger if isinstance(settings.logger, list) else [settings.logger]
    if any(str(getattr(one, "class_path", "")).rpartition(".")[2] not in QUIET_LOGGERS for one in loggers if one):
        settings.logger = None
    parser = LightningArgumentParser(exit_on_error=False)
    parser.add_lightning_class_args(pl.Trainer, "trainer")
    made = parser.instantiate_classes(Namespace(trainer=settings))
    return pl.Trainer(**trainer_settings(made.trainer.as_dict(), []))


def trainer_settings(config: dict[str, Any], extra: list[Callback]) -> dict[str, Any]:
    """Complete a Trainer's settings with this project's parts, unless the user chose others.

    Args:
        config: Keyword arguments of `Trainer`, as a user gave them.
        extra: Callbacks in addition to those in `config`; checkpoints among them are left out where checkpointing is
            off.

    Returns:
        The keyword arguments to build the Trainer with.

    Raises:
        UserError: A value that breaks one of the `rules`.
    """
    config = dict(config)
    refuse_values(config)
    if (config.get("num_nodes") or 1) > 1 and not any(name in os.environ for name in CLUSTERS):
        raise UserError(
            f"trainer.num_nodes is {config['num_nodes']}, but nothing says where the others are, and Lightning would "
            "wait for them: start it with srun or torchrun, or set MASTER_ADDR and NODE_RANK"
        )
    root = config.get("default_root_dir") or "."
    if config.get("barebones"):
        return _barebones(config, extra)
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
    callbacks = [c for c in callbacks if not (isinstance(c, AverageWeights) and c.decay is None)]
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
    # Last of all the checkpoint: what others note at the same moment, the best score for example, belongs into its
    # file. Just before it the average: it puts the training's own weights back when all have looked at the average.
    last = (AverageWeights, RollingCheckpoint)
    config["callbacks"] = sorted(callbacks, key=lambda c: 1 + last.index(type(c)) if type(c) in last else 0)

    plugins = config.get("plugins") or []
    plugins = list(plugins) if isinstance(plugins, list) else [plugins]
    if saves:
        plugins.append(AtomicCheckpointIO())
    config["plugins"] = plugins
    return config


def _barebones(config: dict[str, Any], extra: list[Callback]) -> dict[str, Any]:
    """Settings that measure the training alone: nothing is logged, saved or drawn."""
    mine = config.get("callbacks") or []
    mine = mine if isinstance(mine, list) else [mine]
    kept = [one for one in extra if not isinstance(one, Checkpoint | AverageWeights)]
    return {**config, "callbacks": [*mine, *kept, FiniteGuard()]}
