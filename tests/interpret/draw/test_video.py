"""Videos of episodes: whole files in the format there is an encoder for, at the pace of the simulation."""

import numpy as np
import pytest
from PIL import Image

from dds_lightning.interpret.draw import video
from dds_lightning.interpret.draw.video import FPS, FRAMES, Footage, episode_pictures, write_video
from dds_lightning.rollout.result import RolloutPath
from dds_lightning.tasks import get_task
from dds_lightning.tasks.env import open_env


def footage(name, steps):
    """Somebody who does nothing."""
    task = get_task(name)
    with open_env(task) as env:
        state = env.unwrapped.data.qpos.copy()
    positions = np.tile(task.start_xy() if task.maze_map else np.full(2, np.nan), (steps + 1, 1)).astype(np.float32)
    path = RolloutPath(positions, np.arange(steps, dtype=np.int16) % 3)
    return task, Footage(path, np.tile(state, (steps + 1, 1)), "nothing")


@pytest.mark.parametrize(
    ("name", "steps", "fps", "count"),
    [
        ("pointmaze-umaze-play", 100, FPS, 25),  # 0.01 s: every fourth step
        ("hopper-medium", 50, FPS, 11),  # 0.008 s: every fifth
        ("hopper-medium", 3100, 1 / (11 * 0.008), 282),  # at most FRAMES: faster than it was
    ],
)
def test_without_a_driver_an_episode_is_drawn_at_its_pace(name, steps, fps, count, monkeypatch):
    monkeypatch.setattr(video, "render_frames", lambda *_: None)
    task, one = footage(name, steps)
    pictures, pace, how = episode_pictures(task, [one])
    assert (how, len(pictures)) == ("drawn", count)
    assert pace == pytest.approx(fps)
    assert len(pictures) <= FRAMES + 1
    assert pictures[0].std() > 1


def test_with_a_driver_it_is_rendered(monkeypatch):
    asked = []
    monkeypatch.setattr(video, "render_frames", lambda task, qpos: asked.append(qpos) or np.zeros((len(qpos), 4, 4, 3)))
    task, one = footage("hopper-medium", 50)
    pictures, _, how = episode_pictures(task, [one, one])
    assert (how, len(pictures), asked[0].shape) == ("rendered", 22, (22, 6))


def test_files_are_what_their_names_say_or_gifs_beside_them(tmp_path, monkeypatch):
    pictures = [np.zeros((33, 47, 3), np.uint8) for _ in range(5)]
    for k, picture in enumerate(pictures):
        picture[:, 5 * k : 5 * k + 5] = 255
    assert write_video(tmp_path / "new" / "a.gif", pictures, 10.0) == tmp_path / "new" / "a.gif"
    with Image.open(tmp_path / "new" / "a.gif") as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (5, (47, 33), 100)
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    assert write_video(tmp_path / "b.mp4", pictures, 10.0) == tmp_path / "b.gif"


def test_mp4_where_there_is_an_encoder(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    import imageio.v3 as imageio

    pictures = [np.full((33, 47, 3), 20 * k, np.uint8) for k in range(5)]
    path = write_video(tmp_path / "a.mp4", pictures, 10.0)
    frames = imageio.imread(path, plugin="FFMPEG")
    assert frames.shape == (5, 32, 46, 3)
    np.testing.assert_allclose(frames.mean(axis=(1, 2, 3)), [0, 20, 40, 60, 80], atol=4)
