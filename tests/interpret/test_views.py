"""A new robot is two rows: its columns and its picture; then it is replayed, drawn and has an atlas."""

from dataclasses import replace

import numpy as np
import pytest

from dds_lightning.interpret.atlas.build import make_atlas
from dds_lightning.interpret.draw import rendering
from dds_lightning.interpret.draw.strobe import plot_strobes
from dds_lightning.interpret.measure.body import body_frames
from dds_lightning.interpret.measure.replay import play_skills, simulator
from dds_lightning.interpret.measure.states import Played, body_states, draw_states
from dds_lightning.interpret.views import VIEWS, View, view_of
from dds_lightning.tasks import get_task
from dds_lightning.tasks.bodies import BODIES, Body, _columns
from dds_lightning.tasks.task import Task
from tests.interpret.tiny import tiny_agent

POLE = Task(
    name="pole",
    family="default",
    env_id="InvertedPendulum-v5",
    observation_dim=4,
    action_dim=1,
    action_low=-3.0,
    action_high=3.0,
    max_episode_steps=40,
    step_seconds=0.04,
    measures_success=False,
    score_max=40.0,
)
NAMES = ("x (m)", "angle (rad)", "x velocity (m/s)", "spin (rad/s)")


@pytest.fixture
def two_rows(monkeypatch):
    row = Body(observations=NAMES, actions=("push",), layouts={0: _columns(NAMES, 2)}, moves="joints", moving=(0, 2))
    monkeypatch.setitem(BODIES, "pole", row)
    monkeypatch.setitem(VIEWS, "pole", View(held=0.4, bodies=2, mover="the cart"))


def test_two_rows_give_a_new_robot_states_pictures_and_an_atlas(two_rows, monkeypatch):
    monkeypatch.setattr(rendering, "BACKENDS", ())
    agent = tiny_agent(POLE, num_skills=2, horizon=3)
    data = play_skills(POLE, agent.skill, steps=60)
    states = body_states(POLE, data.observations)
    np.testing.assert_allclose(states.qpos, data.qpos, atol=1e-5)
    np.testing.assert_allclose(states.qvel, data.qvel, atol=1e-5)
    made = make_atlas(type(agent)(agent.skill, None, "random"), POLE, data, states=2)
    assert {"strobe", "recovery", "where"} <= set(made.pictures)
    assert view_of(POLE).mover == "the cart"


def test_a_robot_without_rows_is_replayed_from_states_that_its_skills_reach(monkeypatch):
    monkeypatch.setattr(rendering, "BACKENDS", ())
    agent = tiny_agent(POLE, num_skills=2, horizon=3)
    played = play_skills(POLE, agent.skill, steps=60)
    assert isinstance(played, Played)
    assert len(played.qpos) == len(played.observations) == played.num_steps + played.num_episodes
    drawn = draw_states(POLE, played, 4)
    np.testing.assert_allclose(drawn.observations[:, :2], drawn.qpos, atol=1e-5)
    again = play_skills(POLE, agent.skill, steps=60)
    np.testing.assert_array_equal(again.qpos, played.qpos)
    made = make_atlas(type(agent)(agent.skill, None, "random"), POLE, played, states=2)
    assert made.table["again"].notna().any()


def test_a_robot_without_a_view_is_drawn_from_where_it_moves_and_an_arm_is_where_its_tip_is():
    task = replace(POLE, name="arm", env_id="Reacher-v5", observation_dim=10, action_dim=2)
    with simulator(task) as env:
        qpos = np.array([[0.0, 0.0, 0.1, 0.1], [np.pi / 2, 0.0, 0.1, 0.1]])
        body = body_frames(env.unwrapped.model, qpos)
    np.testing.assert_allclose(body.root[:, :2], [[0.21, 0.0], [0.0, 0.21]], atol=1e-6)  # two links of 0.1 m, and more
    figure = plot_strobes(task, {0: body}, 1)
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("x (m)", "y (m)")


@pytest.mark.parametrize(
    ("name", "camera", "axes", "limbs"),
    [
        ("kitchen-mixed", (2.4, 70.0, -30.0), (0, 2), True),
        ("antmaze-umaze", (4.5, 90.0, -88.0), (0, 1), True),
        ("hopper-medium", (2.5, 90.0, -6.0), (0, 2), True),
        ("pointmaze-umaze-play", (2.5, 90.0, -6.0), (0, 1), False),
    ],
)
def test_every_robot_of_the_table_is_seen_as_before(name, camera, axes, limbs):
    view = view_of(get_task(name))
    assert (view.camera, view.axes, view.limbs) == (camera, axes, limbs)
