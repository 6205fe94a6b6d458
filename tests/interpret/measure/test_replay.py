"""Replays do in the simulator what an environment of their own would have done."""

import numpy as np
import pytest

from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.interpret.measure.replay import replay_codes, simulator
from dds_lightning.interpret.measure.states import body_states, draw_states, junctions, rest_states
from dds_lightning.tasks import get_task
from tests.interpret.tiny import Compass, Played, recorded, tiny_skill
from tests.recordings import record

MAZE = get_task("pointmaze-umaze-diverse")
HOPPER = get_task("hopper-medium")
ANT = get_task("antmaze-umaze")


@pytest.mark.parametrize(
    "name", ["pointmaze-umaze-diverse", "hopper-medium", "antmaze-umaze", "antmaze-umaze@robotics"]
)
def test_recorded_actions_from_a_recorded_state_lead_where_they_led(name):
    task = get_task(name)
    episode = max(record(task, 30, episode_steps=12, seed=3), key=lambda one: len(one["rewards"]))
    states = body_states(task, episode["observations"][4:5])
    made = replay_codes(task, Played(episode["actions"][4:10]), states)
    np.testing.assert_allclose(made.observations[0], episode["observations"][4:11], atol=2e-3)
    np.testing.assert_allclose(made.qpos[0, :, -2:], episode["qpos"][4:11, -2:], atol=2e-4)
    np.testing.assert_allclose(made.rewards[0], episode["rewards"][4:10], atol=0.05)
    assert made.alive.all()


def test_replays_side_by_side_do_not_touch_each_other():
    skill = tiny_skill(ANT)
    states = rest_states(ANT, ANT.free_cells()[:2])
    with simulator(ANT) as env:
        together = replay_codes(ANT, skill, states, steps=4, noise_scale=0.0, env=env)
        alone = replay_codes(ANT, skill, states.take([1]), [2], steps=4, noise_scale=0.0, env=env)
    n = int(np.flatnonzero((together.codes == 2) & (together.states == 1))[0])
    np.testing.assert_allclose(alone.qpos[0], together.qpos[n], atol=1e-5)  # a batch of one rounds differently


def test_every_code_is_held_from_every_state_code_by_code():
    states = rest_states(MAZE, [(1, 2), (3, 2)])
    made = replay_codes(MAZE, Compass(), states, [0, 2])
    assert made.codes.tolist() == [0, 0, 2, 2]
    assert made.states.tolist() == [0, 1, 0, 1]
    assert made.qpos.shape == (4, 7, 2)
    moved = made.qpos[:, -1] - made.qpos[:, 0]
    assert (moved[:2, 0] > 0.03).all()
    assert (moved[2:, 0] < -0.03).all()
    one_each = replay_codes(MAZE, Compass(), states, [2, 0], each=True)
    np.testing.assert_array_equal(one_each.qpos, made.qpos[[2, 1]])
    part = made.take(made.codes == 2)
    np.testing.assert_array_equal(part.qpos, made.qpos[2:])


def test_a_runner_that_falls_ends_its_replay_and_the_rest_is_unknown():
    states = body_states(HOPPER, np.array([[1.25, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], [0.75, 0.15, *[0] * 9]]))
    made = replay_codes(HOPPER, Played(np.zeros((40, 3), np.float32)), states)
    assert made.lengths[0] > made.lengths[1] >= 1
    ended = made.lengths[1]
    assert np.isfinite(made.qpos[1, : ended + 1]).all()
    assert np.isnan(made.qpos[1, ended + 1 :]).all()
    assert np.isnan(made.actions[1, ended:]).all()


def test_states_hold_what_the_observations_leave_out():
    observations = np.arange(22, dtype=np.float32).reshape(2, 11)
    states = body_states(HOPPER, observations)
    np.testing.assert_array_equal(states.qpos, np.pad(observations[:, :5], ((0, 0), (1, 0))))
    np.testing.assert_array_equal(states.qvel, observations[:, 5:])
    kitchen = get_task("kitchen-mixed")
    before, now = np.zeros((2, 60)), np.zeros((2, 60))
    now[:, 3], before[1] = 0.08, np.nan
    states = body_states(kitchen, now, before)
    assert states.qpos.shape == (2, 30)
    np.testing.assert_allclose(states.qvel[0], np.eye(29)[3])
    assert not states.qvel[1].any()  # nothing is known before an episode's first state


def test_states_are_drawn_from_all_episodes_and_never_at_their_ends():
    episodes = []
    for start in (0.0, 100.0):
        seen = np.zeros((6, 4), np.float32)
        seen[:, 0] = start + np.arange(6)
        flags = {"terminations": np.zeros(5, bool), "truncations": np.arange(5) == 4}
        episodes.append({"observations": seen, "actions": np.zeros((5, 2)), "rewards": np.zeros(5), **flags})
    data = Trajectories.from_episodes("two", episodes)
    drawn = draw_states(MAZE, data, 99)
    assert sorted(drawn.qpos[:, 0]) == [0, 1, 2, 3, 4, 100, 101, 102, 103, 104]
    few = draw_states(MAZE, data, 3, seed=1)
    np.testing.assert_array_equal(few.qpos, draw_states(MAZE, data, 3, seed=1).qpos)
    assert len(few) == 3


def test_a_body_rests_upright_in_the_middle_of_its_cells():
    states = rest_states(ANT, [(1, 1), (3, 1)])
    np.testing.assert_allclose(states.qpos[:, :4], [[0, 0, 0.75, 1], [0, 8, 0.75, 1]])
    assert not states.qvel.any()
    with pytest.raises(UserError, match="no maze"):
        rest_states(HOPPER, [(1, 1)])


def test_junctions_begin_with_the_start_and_leave_the_goal_out():
    task = get_task("pointmaze-large-diverse")
    cells = junctions(task, 5)
    assert cells[0] == task.start_cell
    assert len(set(cells)) == 5
    assert task.goal_cell not in junctions(task, 1000)


def test_codes_that_there_are_not_are_refused():
    states = rest_states(MAZE, [(1, 1)])
    with pytest.raises(UserError, match="expected codes of 0 to 3"):
        replay_codes(MAZE, Compass(), states, [4])
    with pytest.raises(UserError, match="from 0 states"):
        replay_codes(MAZE, Compass(), states.take(np.zeros(0, int)))


def test_the_same_seed_draws_the_same_noise():
    skill, data = tiny_skill(MAZE), recorded(MAZE, 20)
    states = draw_states(MAZE, data, 2)
    with simulator(MAZE) as env:
        first, again, other = (replay_codes(MAZE, skill, states, seed=seed, env=env) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.actions, again.actions)
    assert (first.actions != other.actions).any()
