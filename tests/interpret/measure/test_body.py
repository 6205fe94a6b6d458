"""Stick figures have the proportions and the places of the model's own bodies."""

import io

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.interpret.draw.strobe import body_clip, plot_strobes
from dds_lightning.interpret.measure.body import body_frames, root_path, to_body
from dds_lightning.interpret.measure.replay import simulator
from dds_lightning.interpret.views import view_of
from dds_lightning.tasks import get_task

HOPPER = get_task("hopper-medium")
ANT = get_task("antmaze-umaze")


@pytest.fixture(scope="module")
def hopper():
    """A hopper that stands, moved 0.1 m forwards in each of 21 frames."""
    qpos = np.zeros((21, 6))
    qpos[:, 0], qpos[:, 1] = 0.1 * np.arange(21), 1.25
    with simulator(HOPPER) as env:
        return body_frames(env.unwrapped.model, qpos)


def test_a_standing_hopper_has_its_joints_where_the_model_has_them(hopper):
    np.testing.assert_allclose(hopper.joints[0], [[0, 0, 1.05], [0, 0, 0.6], [0, 0, 0.1]], atol=1e-6)
    lengths = np.linalg.norm(hopper.limbs[:, :, 1] - hopper.limbs[:, :, 0], axis=-1)
    np.testing.assert_allclose(lengths, np.tile([0.4, 0.45, 0.5, 0.39], (21, 1)), atol=1e-6)
    np.testing.assert_allclose(hopper.widths, [0.1, 0.1, 0.08, 0.12])
    np.testing.assert_allclose(hopper.root[20] - hopper.root[0], [2.0, 0, 0], atol=1e-6)


def test_an_ant_has_a_ball_and_twelve_limbs_and_eight_joints():
    with simulator(ANT) as env:
        frames = body_frames(env.unwrapped.model, np.stack([env.unwrapped.init_qpos, np.full(15, np.nan)]))
    assert frames.limbs.shape == (1, 13, 2, 3)  # what comes after the end is left out
    assert frames.joints.shape == (1, 8, 3)
    assert (frames.limbs[0, 0, 0] == frames.limbs[0, 0, 1]).all()
    assert frames.widths[0] == 0.5


def test_the_way_of_a_body_is_that_of_its_root():
    qpos = np.zeros((2, 3, 6))
    qpos[1, :, 0], qpos[1, :, 1] = (0, 1, np.nan), (1, 2, np.nan)
    path = root_path(HOPPER, None, qpos)
    np.testing.assert_array_equal(path[1, :2], [[0, 1], [1, 2]])
    assert np.isnan(path[1, 2]).all()


def test_an_ant_moves_ahead_and_to_its_left_wherever_it_faces():
    half = np.sqrt(0.5)
    faces_y = np.array([half, 0.0, 0.0, half])  # turned a quarter to the left
    away = np.array([[0.0, 2.0], [-1.0, 0.0]])
    np.testing.assert_allclose(to_body(ANT, away, faces_y), [[2.0, 0.0], [0.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(to_body(ANT, away, np.array([1.0, 0, 0, 0])), away)
    np.testing.assert_array_equal(to_body(HOPPER, away, faces_y), away)
    assert view_of(ANT).path == ("ahead of the ant", "to its left")
    assert view_of(HOPPER).path == ("along x", "along z")


def bodies(ax):
    """Faces of the bodies of a panel, in the order in which they were drawn."""
    return [c.get_facecolor()[0] for c in ax.collections if isinstance(c, PolyCollection)]


def test_a_strobe_has_a_panel_a_skill_and_its_last_body_is_solid(hopper):
    figure = plot_strobes(HOPPER, {0: hopper, 5: hopper}, every=6)
    assert [ax.texts[0].get_text() for ax in figure.axes] == ["0", "5"]
    assert figure.axes[0].texts[1].get_text() == "moves 2.00 m in 0.16 s (12.5 m/s)"
    for ax, code in zip(figure.axes, (0, 5), strict=True):
        faces = bodies(ax)
        assert len(faces) == 4  # steps 2, 8, 14 and 20
        assert tuple(faces[-1]) == to_rgba(skill_colour(code))
        assert [face[3] for face in faces] == sorted(face[3] for face in faces)
        assert ax.get_xlabel() == "x (m)"
        assert ax.get_aspect() == 1.0
    assert figure.axes[0].get_xlim() == figure.axes[1].get_xlim()  # one scale
    assert "every 0.048 s" in figure.get_suptitle()


def test_the_outline_of_a_limb_is_as_wide_as_the_limb(hopper):
    (first, *_) = [
        c for c in plot_strobes(HOPPER, {0: hopper}, 30).axes[0].collections if isinstance(c, PolyCollection)
    ]
    torso = first.get_paths()[0].vertices
    np.testing.assert_allclose(np.ptp(torso, axis=0), [0.1, 0.5], atol=1e-6)  # a limb of 0.4 with round ends of 0.05


def test_a_strobe_of_nothing_is_refused(hopper):
    with pytest.raises(UserError, match="expected at least 1 of each"):
        plot_strobes(HOPPER, {}, 5)
    with pytest.raises(UserError, match="every is 0"):
        plot_strobes(HOPPER, {0: hopper}, 0)


def test_a_clip_moves_and_stays_small(hopper):
    data = body_clip(HOPPER, hopper, 3, frames=7)
    images = imageio.imread(io.BytesIO(data))
    assert len(images) == 7
    assert (images[0] != images[3]).any()
    assert len(data) < 40_000


def test_the_kitchens_arm_is_a_chain_with_what_it_moves_beside_it():
    task = get_task("kitchen-mixed")
    qpos = np.zeros((2, 30))
    qpos[1, 22] = -0.7  # the microwave's door
    with simulator(task) as env:
        model = env.unwrapped.model
        frames = body_frames(model, qpos)
        hand = root_path(task, model, qpos[None])
    assert frames.limbs.shape == (2, 8, 2, 3)
    np.testing.assert_allclose(frames.limbs[0, :5, 1], frames.limbs[0, 1:6, 0])
    np.testing.assert_allclose(frames.root, hand[0])
    moved = np.linalg.norm(frames.objects[1] - frames.objects[0], axis=-1)
    assert [name for name, far in zip(frames.names, moved, strict=True) if far > 0.01] == ["microwave"]
    places = dict(zip(frames.names, frames.objects[0], strict=True))
    assert places["kettle"][2] < places["light switch"][2] < places["slide cabinet"][2]
    figure = plot_strobes(task, {1: frames}, every=1)
    assert figure.axes[0].get_ylabel() == "z (m)"
    *named, code, heading = (text.get_text() for text in figure.axes[0].texts)
    assert (code, "hand moves" in heading) == ("1", True)
    things = ["burners", "hinge cabinet", "kettle", "knobs", "light", "light switch", "microwave", "slide cabinet"]
    assert sorted(named) == things  # every square has a name, each name stands once
