"""Clips of episodes while a training runs."""

from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from PIL import Image

from dds_lightning.callbacks.rollouts import RolloutEvaluation
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.rollout.result import RolloutResult


class RolloutVideos(RolloutEvaluation):
    """A `RolloutEvaluation` in a maze that also draws one episode each time, without a graphics driver.

    The clip is `videos/step_N.gif` beside the logs; TensorBoard shows it under "Images", Weights & Biases as a video.
    """

    RECORDS = True
    TAG = "rollout/episode"

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """As in `RolloutEvaluation`; other tasks than mazes are refused."""
        super().setup(trainer, pl_module, stage)
        assert self.task is not None, "setup has found it"
        if self.task.maze_map is None:
            raise UserError(f"rollout videos: task is {self.task.name}, expected a maze: use RolloutEvaluation instead")

    def show(self, trainer: pl.Trainer, result: RolloutResult) -> None:
        """Draw the first contestant's first episode."""
        assert self.task is not None, "setup has found it"
        episode = next(iter(result.paths.values()))
        folder = Path(trainer.log_dir or trainer.default_root_dir) / "videos"
        path = write_clip(
            folder / f"step_{trainer.global_step}.gif", self.task, episode, f"step {trainer.global_step:,}"
        )
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger.log_video(self.TAG, [str(path)], step=trainer.global_step, format=["gif"])
            elif isinstance(logger, TensorBoardLogger):
                _to_tensorboard(logger, self.TAG, path, trainer.global_step)


def _to_tensorboard(logger: TensorBoardLogger, tag: str, path: Path, step: int) -> None:
    """Hand a GIF over as it is: `add_video` would need a video library to encode one again."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    with Image.open(path) as picture:
        width, height = picture.size
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=path.read_bytes())
    summary = Summary(value=[Summary.Value(tag=tag, image=image)])
    logger.experiment._get_file_writer().add_summary(summary, step)
