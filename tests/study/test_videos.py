"""Clips of episodes while a training runs."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from PIL import Image

from tests.fits import QUIET, SKILL, call, of_data

CALLBACK = ["--trainer.callbacks+=dds_lightning.study.videos.RolloutVideos", "--trainer.callbacks.every_n_steps=2"]
CALLBACK += [
    "--trainer.callbacks.episodes=1",
    "--trainer.callbacks.episodes_per_skill=0",
    "--trainer.callbacks.workers=0",
]


def test_each_evaluation_leaves_a_clip_beside_the_logs(tmp_path_factory):
    data = of_data(tmp_path_factory.mktemp("data"))
    assert call("skill", "fit", *data, *QUIET, *SKILL, *CALLBACK, "--trainer.max_steps=4") == 0
    logs = Path("runs/skill/logs/version_0")
    clips = sorted((logs / "videos").iterdir())
    assert [clip.name for clip in clips] == ["step_2.gif", "step_4.gif"]
    with Image.open(clips[0]) as picture:
        assert picture.n_frames > 10
    if find_spec("tensorboard") is not None:
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        events = EventAccumulator(str(logs)).Reload()
        (first, _) = events.Images("rollout/episode")
        assert first.encoded_image_string == clips[0].read_bytes()


def test_a_task_without_a_maze_is_refused_before_training(capfd):
    from dds_lightning.errors import UserError
    from dds_lightning.study.videos import RolloutVideos

    class Trainer:
        datamodule = None

    with pytest.raises(UserError, match="task is hopper-medium, expected a maze"):
        RolloutVideos("hopper-medium").setup(Trainer(), None, "validate")
