"""Pictures by MuJoCo: what the other process is asked, where its camera stands, and what happens without a driver."""

import io
import json
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw import rendering
from dds_lightning.tasks import get_task

HOPPER, KITCHEN = get_task("hopper-medium"), get_task("kitchen-mixed")


def test_a_backend_that_does_not_exist_gives_no_pictures(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    assert rendering.render_frames(HOPPER, np.zeros((1, 6))) is None


def test_the_other_process_is_asked_for_the_rows_that_were_played_and_its_answer_is_read(monkeypatch):
    asked = []

    def run(*arguments, input, env, **_):
        asked.append((dict(np.load(io.BytesIO(input))), env["MUJOCO_GL"]))
        answer = io.BytesIO()
        np.save(answer, np.full((2, 4, 6, 3), 7, np.uint8))
        return SimpleNamespace(returncode=len(asked) == 1, stdout=answer.getvalue())

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering.subprocess, "run", run)
    qpos = np.arange(18.0).reshape(3, 6)
    qpos[2] = np.nan
    frames = rendering.render_frames(HOPPER, qpos, width=6, height=4)
    assert frames.shape == (2, 4, 6, 3)
    assert (frames == 7).all()
    assert [backend for _, backend in asked] == list(rendering.BACKENDS[:2])  # the first one failed
    request = asked[0][0]
    np.testing.assert_array_equal(request["qpos"], qpos[:2])
    assert request["size"].tolist() == [6, 4]
    assert json.loads(str(request["task"])) == "hopper-medium"


@pytest.mark.parametrize(
    ("task", "width", "distance", "looks_at"),
    [(HOPPER, 6, 2.5, (0.3, 0.0, 0.8)), (KITCHEN, 30, 2.4, (-0.2, 0.5, 2.0))],
)
def test_the_camera_follows_a_runner_and_watches_the_whole_kitchen(monkeypatch, task, width, distance, looks_at):
    seen = []

    class Renderer:
        def __init__(self, model, height, width):
            self.size = height, width

        def update_scene(self, data, camera):
            seen.append((camera.distance, tuple(camera.lookat.round(6))))

        def render(self):
            return np.zeros((*self.size, 3), np.uint8)

    monkeypatch.setattr(mujoco, "GLContext", lambda *size: SimpleNamespace(free=lambda: None))
    monkeypatch.setattr(mujoco, "Renderer", Renderer)
    qpos = np.zeros((2, width))
    qpos[:, 0] = 0.3
    frames = rendering._render(json.dumps(task.name), qpos, 8, 6)
    assert frames.shape == (2, 6, 8, 3)
    assert seen == [(distance, looks_at)] * 2


def test_nothing_to_draw_is_said():
    with pytest.raises(UserError, match="frames is empty"):
        rendering.plot_rendered(HOPPER, {}, 1)


def test_a_picture_shows_every_skill_in_a_row_of_its_own():
    frames = {3: np.zeros((4, 6, 8, 3), np.uint8), 5: np.zeros((2, 6, 8, 3), np.uint8)}
    figure = rendering.plot_rendered(HOPPER, frames, 2)
    drawn = [ax for ax in figure.axes if ax.images]
    assert len(drawn) == 4 + 2


def test_a_driver_renders_the_body(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    frames = rendering.render_frames(HOPPER, np.array([[0.0, 1.25, 0.0, 0.0, 0.0, 0.0]]), 64, 48)
    if frames is None:
        pytest.skip("no graphics driver here")
    assert frames.shape == (1, 48, 64, 3)
    assert frames.std() > 5  # not one colour
