"""One checkpoint from which a training continues exactly where it stopped.

Lightning's `ModelCheckpoint` does not serve here: it does not save when a signal asks to stop, and where it saves
before a validation of the same step, resuming leaves that validation out.
"""

import itertools
import multiprocessing
import os
import time
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Checkpoint

from dds_lightning.console import interrupts
from dds_lightning.errors import UserError


class RollingCheckpoint(Checkpoint):
    """Keep one file, `last.ckpt`, from which training continues exactly.

    It is written after an optimiser step whenever `every_n_steps` steps or `every_n_seconds` seconds have
    passed, at the end, and when SIGTERM or Ctrl-C asks to stop. What follows that step, its metrics and a validation
    that is due, is still done; then `Interrupted` is raised. An error writes nothing: the state that failed must not
    replace the last good one.

    Args:
        dirpath: Folder of the file; null puts it beside the logs of this launch.
        every_n_seconds: Seconds between two writes; 0 ignores time.
        every_n_steps: Steps between two writes; 0 ignores steps.
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
        """Decide where the file goes."""
        if stage == "fit":
            self.path = Path(trainer.strategy.broadcast(str(self.place(trainer))))
            try:  # a place that cannot be written shows before training
                self.path.parent.mkdir(parents=True, exist_ok=True)
            except (FileExistsError, NotADirectoryError):
                folder = self.path.parent
                taken = next(part for part in (folder, *folder.parents) if part.is_file())
                raise UserError(f"checkpoint.dirpath is {folder}, but {taken} is a file: give a folder") from None

    def place(self, trainer: pl.Trainer) -> Path:
        """Where the file of this launch goes."""
        folder = self.dirpath or Path(trainer.log_dir or trainer.default_root_dir) / "checkpoints"
        return Path(folder) / "last.ckpt"

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Count the seconds from here: nothing before can be lost."""
        # Lightning's SIGTERM handler would end the program between two steps without saving.
        if multiprocessing.parent_process() is not None:
            interrupts.catch_in_a_process()
        interrupts.take_back()
        if trainer.global_step == 0 and trainer.is_global_zero:
            self._keep_earlier()
        self._saved_time = time.monotonic()
        self._saved_step = trainer.global_step

    def _keep_earlier(self) -> None:
        """Rename what an earlier training left in this place: a command typed once more must not cost its result."""
        assert self.path is not None, "setup('fit') comes first"
        for found in (self.path, self.path.with_name("best.ckpt")):
            if found.is_file():
                numbers = itertools.count(1)  # `last-v1.ckpt`, as Lightning's own callback counts
                kept = next(path for i in numbers if not (path := found.with_stem(f"{found.stem}-v{i}")).exists())
                os.replace(found, kept)
                warnings.warn(
                    f"{found} is an earlier training's, and {kept.name} now; --ckpt_path={kept} goes on from it",
                    stacklevel=2,
                )

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Stop here if a signal asked to: everything that belongs to the previous step has been logged."""
        if self._unflushed:
            # A kill must not lose metrics of steps that are saved, because these steps are not repeated.
            for logger in trainer.loggers:
                logger.save()
            self._unflushed = False
        self._leave()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when it is due, or when a signal asked to stop."""
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
        """The last value of every metric: a resumed training may end before it measures some of them again."""
        return {"metrics": self.metrics}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.metrics = state_dict.get("metrics", {})

    def latest(self, trainer: pl.Trainer) -> dict[str, float]:
        """The last value of every metric of this training, launches before this one included."""
        return {**self.metrics, **{name: float(value) for name, value in trainer.callback_metrics.items()}}

    def _asked_to_stop(self, trainer: pl.Trainer) -> bool:
        asked = interrupts.pending() is not None
        if trainer.world_size > 1:
            asked = trainer.strategy.reduce_boolean_decision(asked, all=False)  # some may not have received the signal
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
