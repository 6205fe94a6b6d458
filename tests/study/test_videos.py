"""Clips of episodes while a training runs."""

from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from dds_lightning import SkillModule
from dds_lightning.errors import UserError
from dds_lightning.study.videos import RolloutVideos
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


@pytest.mark.parametrize("bottleneck", ["vq", "gaussian"])
def test_a_robot_outside_mazes_is_shown_as_dds_record_shows_it(tmp_path, monkeypatch, bottleneck):
    monkeypatch.setattr("dds_lightning.interpret.draw.video.render_frames", lambda task, states: None)  # no driver
    module = SkillModule(11, 3, horizon=5, skill_dim=8, hidden_dim=16, num_skills=4, bottleneck=bottleneck)
    module.normaliser.fit(torch.zeros(11), torch.ones(11))
    module.action_box.fit(-torch.ones(3), torch.ones(3))
    trainer = SimpleNamespace(
        datamodule=None, lightning_module=module, log_dir=str(tmp_path), loggers=[], global_step=7
    )
    callback = RolloutVideos("hopper-medium", episodes=1)
    callback.setup(trainer, module, "validate")
    callback.show(trainer, None)
    with Image.open(tmp_path / "videos" / "step_7.gif") as picture:
        assert picture.n_frames >= 2


def test_a_task_with_nothing_to_draw_is_refused_before_training(tmp_path):
    task = tmp_path / "car.yaml"
    task.write_text("env_id: MountainCarContinuous-v0\nmax_episode_steps: 20\nscore_min: -60\nscore_max: 0\n")
    with pytest.raises(UserError, match="task is car, neither a maze nor simulated by MuJoCo"):
        RolloutVideos(str(task)).setup(SimpleNamespace(datamodule=None), None, "validate")
