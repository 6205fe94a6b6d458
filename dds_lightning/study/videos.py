"""Clips of episodes while a training runs."""

from pathlib import Path

import lightning.pytorch as pl
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from PIL import Image

from dds_lightning.agent import DDSAgent
from dds_lightning.callbacks.rollouts import RolloutEvaluation
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.video import episode_pictures, write_video
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.study.record import play_footage
from dds_lightning.tasks.env import open_env


class RolloutVideos(RolloutEvaluation):
    """A `RolloutEvaluation` that also shows an episode each time, as `dds record` does: rendered, or else drawn.

    The clip is `videos/step_N.gif` beside the logs; TensorBoard shows it under "Images", Weights & Biases as a video.
    """

    TAG = "rollout/episode"

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """As in `RolloutEvaluation`; a task with nothing to draw is refused."""
        super().setup(trainer, pl_module, stage)
        assert self.task is not None, "setup has found it"
        if self.task.maze_map is None:
            with open_env(self.task) as env:
                if getattr(env.unwrapped, "data", None) is None:
                    raise UserError(
                        f"rollout videos: task is {self.task.name}, neither a maze nor simulated by MuJoCo, so that "
                        "there is nothing to draw: use RolloutEvaluation instead"
                    )

    def show(self, trainer: pl.Trainer, result: RolloutResult) -> None:
        """Let the first contestant play an episode once more, and show it."""
        assert self.task is not None, "setup has found it"
        agent = self.contestants(trainer, trainer.lightning_module)[0].actor
        assert isinstance(agent, DDSAgent), "the first contestant is one"
        footage, _ = play_footage(agent, self.task, 1, self.seed)
        pictures, fps, _ = episode_pictures(self.task, footage)
        folder = Path(trainer.log_dir or trainer.default_root_dir) / "videos"
        path = write_video(folder / f"step_{trainer.global_step}.gif", pictures, fps)
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
