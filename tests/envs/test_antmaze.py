"""D4RL's AntMaze: every fact of its source, measured in the simulator; and gymnasium-robotics' own beside it."""

from __future__ import annotations

import os
import pickle
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dds_lightning.envs.antmaze import D4RLAntMazeEnv
from dds_lightning.envs.build import build_env, register_environments
from dds_lightning.envs.pool import EnvPool
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

D4RL = {"umaze": ("antmaze-umaze", 700), "medium": ("antmaze-medium-play", 1000), "large": ("antmaze-large-play", 1000)}
STILL, FULL = np.zeros(8, np.float32), np.ones(8, np.float32)
JOINTS = ["hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3", "hip_4", "ankle_4"]


@pytest.fixture(scope="module")
def env() -> Any:
    """The medium maze as it is, without an adapter."""
    made = build_env(get_task("antmaze-medium-play").env_id)
    made.reset(seed=0)
    yield made.unwrapped
    made.close()


def gymnasium_ant() -> mujoco.MjModel:
    path = os.path.join(os.path.dirname(gym.__file__), "envs", "mujoco", "assets", "ant.xml")
    return mujoco.MjModel.from_xml_path(path)


# ---------------------------------------------------------------------- physics


def test_a_step_is_a_tenth_of_a_second_in_five_parts(env: Any) -> None:
    assert env.model.opt.timestep == 0.02
    assert env.frame_skip == 5
    assert env.dt == pytest.approx(0.1)
    assert env.metadata["render_fps"] == 10
    assert env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    env.reset(seed=0)
    env.step(STILL)
    assert env.data.time == pytest.approx(0.1)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_action_of_one_is_a_torque_of_thirty(env: Any, sign: float) -> None:
    for motor in range(8):
        env.reset(seed=0)
        action = STILL.copy()
        action[motor] = sign
        env.step(action)
        expected = np.zeros(8)
        expected[motor] = 30.0 * sign
        np.testing.assert_array_equal(env.data.actuator_force, expected)
        joint = mujoco.mj_id2name(env.model, mujoco.mjtObj.mjOBJ_JOINT, env.model.actuator_trnid[motor, 0])
        assert env.data.qfrc_actuator[6 + JOINTS.index(joint)] == 30.0 * sign
    assert (env.action_space.low == -1).all()
    assert (env.action_space.high == 1).all()


def test_larger_actions_are_cut(env: Any) -> None:
    states = []
    for action in (FULL, 7 * FULL):
        env.reset(seed=0)
        states.append(env.step(action)[0])
    np.testing.assert_array_equal(*states)


def test_the_body_is_gymnasiums_but_for_gear_and_contacts(env: Any) -> None:
    ours, ant = env.model, gymnasium_ant()
    assert ours.body_mass.sum() == pytest.approx(0.911, abs=5e-4)
    np.testing.assert_array_equal(ours.dof_armature, [0] * 6 + [1] * 8)
    np.testing.assert_array_equal(ours.dof_damping, [0] * 6 + [1] * 8)
    for name in ("body_mass", "body_inertia", "body_pos", "jnt_range", "jnt_axis", "actuator_trnid", "qpos0"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(ant, name), err_msg=name)
    bodies = ours.geom_type != mujoco.mjtGeom.mjGEOM_BOX  # all but the walls
    for name in ("geom_size", "geom_pos", "geom_friction", "geom_margin", "geom_contype", "geom_conaffinity"):
        np.testing.assert_array_equal(getattr(ours, name)[bodies], getattr(ant, name), err_msg=name)
    np.testing.assert_array_equal(ours.actuator_gear[:, 0], 1.0)
    np.testing.assert_array_equal(ours.actuator_ctrlrange, [[-30.0, 30.0]] * 8)
    np.testing.assert_array_equal(ours.geom_solref, [[0.02, 1.0]] * ours.ngeom)
    np.testing.assert_allclose(ours.geom_solimp[:, :3], [[0.8, 0.8, 0.01]] * ours.ngeom)
    np.testing.assert_allclose(env.init_qpos, [0, 0, 0.75, 1] + [0] * 11)


# ---------------------------------------------------------------------- the maze


@pytest.mark.parametrize("size", D4RL)
def test_walls_stand_where_the_map_has_them(size: str) -> None:
    task = get_task(D4RL[size][0])
    inner: Any = build_env(task.env_id).unwrapped
    model, boxes = inner.model, inner.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    assert task.maze_map is not None
    cells = [(i, j) for i, row in enumerate(task.maze_map) for j, value in enumerate(row) if value == "1"]
    np.testing.assert_allclose(model.geom_pos[boxes, :2], task.cell_to_xy(cells))
    np.testing.assert_allclose(model.geom_pos[boxes, 2], 1.0)
    np.testing.assert_allclose(model.geom_size[boxes], [[2.0, 2.0, 1.0]] * len(cells))  # half sides


def test_an_ant_touches_a_wall_in_wall_cells_only(env: Any) -> None:
    task = get_task("antmaze-medium-play")
    boxes = np.flatnonzero(env.model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    for i, row in enumerate(task.maze_map or ()):
        for j, value in enumerate(row):
            qpos = env.init_qpos.copy()
            qpos[:2] = 4.0 * (j - 1), 4.0 * (i - 1)  # the origin is the start cell (1, 1), y grows down the map
            env.set_state(qpos, np.zeros(14))
            touched = np.isin(env.data.contact.geom, boxes).any()
            assert touched == (value == "1"), (i, j)


def test_an_ant_cannot_walk_through_a_wall(env: Any) -> None:
    env.reset(seed=0, options={"noise": False})
    qvel = np.zeros(14)
    qvel[0] = -20.0  # towards the left wall, whose face is 2 m away
    env.set_state(env.init_qpos, qvel)
    lefts = [env.step(STILL)[4]["position"][0] for _ in range(10)]
    assert -2.0 < min(lefts) < -0.5


# ---------------------------------------------------------------------- starts and goals


def test_every_coordinate_and_velocity_is_noisy_at_a_reset(env: Any) -> None:
    observations = np.stack([env.reset(seed=seed)[0] for seed in range(1000)])
    moved = np.delete(observations[:, :15] - env.init_qpos, [3, 4, 5, 6], axis=1)
    assert np.abs(moved).max() <= 0.1
    assert (moved.min(axis=0) < -0.095).all()
    assert (moved.max(axis=0) > 0.095).all()
    turns = observations[:, 3:7] / observations[:, 3:4]  # the quaternion's length is taken out again
    np.testing.assert_allclose(np.linalg.norm(observations[:, 3:7], axis=1), 1.0)
    assert 0.1 < np.abs(turns[:, 1:]).max() <= 0.1 / 0.9
    velocities = observations[:, 15:]
    np.testing.assert_allclose(velocities.std(axis=0), 0.1, rtol=0.1)
    np.testing.assert_allclose(velocities.mean(axis=0), 0.0, atol=0.015)
    assert np.abs(velocities).max() > 0.3  # normal, not uniform


@pytest.mark.parametrize(("size", "centre"), [("umaze", (0, 8)), ("medium", (20, 20)), ("large", (32, 24))])
def test_goals_are_drawn_for_every_episode_to_one_side_of_the_goal_cells_centre(
    size: str, centre: tuple[float, float]
) -> None:
    task = get_task(D4RL[size][0])
    env = build_env(task.env_id)
    away = np.stack([env.reset(seed=seed)[1]["goal"] for seed in range(1000)]) - centre
    assert away.min() >= 0.0
    assert 1.4 < away.max() < 1.5
    np.testing.assert_allclose(away.mean(axis=0), task.goal_noise, atol=0.03)
    np.testing.assert_allclose(away.std(axis=0), np.sqrt((1.0 + 0.25) / 12), rtol=0.1)  # of U(0, 1) + U(0, 0.5)
    assert abs(np.corrcoef(away.T)[0, 1]) < 0.1
    np.testing.assert_allclose(task.goal_xy() - centre, 0.75)
    env.close()


def test_a_seed_decides_the_whole_episode(env: Any) -> None:
    def play(seed: int | None) -> np.ndarray:
        first, info = env.reset(seed=seed)
        rng = np.random.default_rng(0)
        steps = [env.step(rng.uniform(-1, 1, 8))[0] for _ in range(20)]
        return np.concatenate([info["goal"], first, *steps])

    first = play(3)
    assert not np.array_equal(first[:2], play(None)[:2])  # the next episode has another goal
    np.testing.assert_array_equal(first, play(3))


def test_options_pin_the_goal_the_cell_and_the_pose(env: Any) -> None:
    observation, info = env.reset(seed=1, options={"goal": (1.0, 2.0), "noise": False, "reset_cell": (6, 5)})
    np.testing.assert_array_equal(observation, [16.0, 20.0, 0.75, 1.0] + [0.0] * 25)
    np.testing.assert_array_equal(info["goal"], [1.0, 2.0])
    plain = env.reset(seed=1)[0]
    moved = env.reset(seed=1, options={"reset_cell": np.array([2, 1])})[0]
    np.testing.assert_allclose(moved - plain, [0.0, 4.0] + [0.0] * 27)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"goal_cell": (1, 1)}, "no option 'goal_cell'"),
        ({"reset_cell": (0, 0)}, r"reset_cell is \(0, 0\), a wall"),
        ({"reset_cell": (1, 99)}, r"outside the maze"),
    ],
)
def test_wrong_options_are_refused_in_a_sentence(env: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        env.reset(options=options)


# ---------------------------------------------------------------------- observations, rewards, ends


def test_observations_are_positions_then_velocities(env: Any) -> None:
    qpos, qvel = np.arange(15.0), -np.arange(14.0)
    qpos[:7] = 3.0, 2.0, 0.7, 1.0, 0.0, 0.0, 0.0
    env.set_state(qpos, qvel)
    np.testing.assert_array_equal(env._observation(), np.concatenate([qpos, qvel]))
    env.reset(seed=0)
    observation, *_, info = env.step(FULL)
    assert observation.shape == env.observation_space.shape == (29,)
    np.testing.assert_array_equal(observation, np.concatenate([env.data.qpos, env.data.qvel]))
    np.testing.assert_array_equal(info["position"], observation[:2])
    before = observation.copy()
    env.step(FULL)
    np.testing.assert_array_equal(observation, before)  # a copy, not the simulator's memory


@pytest.mark.parametrize(("distance", "reached"), [(0.4999, True), (0.5001, False)])
def test_the_episode_ends_with_a_reward_of_one_within_half_a_metre(distance: float, reached: bool) -> None:
    env = get_task("antmaze-medium-play").make_env()
    env.reset(seed=0, options={"noise": False})
    after = env.step(STILL)[4]["position"]
    for angle in np.linspace(0, 2 * np.pi, 7):
        goal = after + distance * np.array([np.cos(angle), np.sin(angle)])
        _, info = env.reset(seed=0, options={"noise": False, "goal": goal})
        assert info["success"] is reached
        _, reward, terminated, truncated, info = env.step(STILL)
        assert (reward, terminated, truncated, info["success"]) == (float(reached), reached, False, reached)
    env.close()


@pytest.mark.parametrize("size", D4RL)
def test_an_ant_on_its_back_goes_on_to_the_cap(size: str) -> None:
    name, cap = D4RL[size]
    env = get_task(name).make_env()
    env.reset(seed=0)
    inner: Any = env.unwrapped
    qpos = inner.init_qpos.copy()
    qpos[2:7] = 0.3, 0.0, 1.0, 0.0, 0.0  # half a turn about x
    inner.set_state(qpos, np.zeros(14))
    for step in range(cap):
        observation, reward, terminated, truncated, info = env.step(STILL)
        assert (reward, terminated, info["success"]) == (0.0, False, False)
        assert truncated == (step == cap - 1)
    assert abs(observation[4]) > 0.9  # x of the quaternion: still on its back
    env.close()


# ---------------------------------------------------------------------- a citizen of Gymnasium


@pytest.mark.filterwarnings("ignore:.*Box observation space .*:UserWarning", "ignore:.*unwrapped.*:UserWarning")
@pytest.mark.parametrize("size", ["UMaze", "Medium", "Large"])
def test_gymnasiums_checker_passes(size: str) -> None:
    register_environments()
    register_environments()  # harmless when repeated
    env = gym.make(f"dds/AntMazeD4RL_{size}-v0")
    check_env(env.unwrapped, skip_render_check=True)
    check_env(env, skip_render_check=True)
    env.close()


def test_a_pickled_environment_is_built_again(env: Any) -> None:
    again = pickle.loads(pickle.dumps(env))
    assert isinstance(again, D4RLAntMazeEnv)
    assert again.maze_map == env.maze_map
    for one in (env, again):
        one.reset(seed=4)
    np.testing.assert_array_equal(env.step(FULL)[0], again.step(FULL)[0])


def test_textures_are_drawn_for_those_who_look_only(env: Any) -> None:
    seen: Any = build_env("dds/AntMazeD4RL_Medium-v0", render_mode="rgb_array").unwrapped
    assert seen.model.ntexdata > 100_000 > 100 > env.model.ntexdata
    for one in (env, seen):
        one.reset(seed=4)
    np.testing.assert_array_equal(env.step(FULL)[0], seen.step(FULL)[0])  # the same physics
    seen.close()


def test_a_pool_plays_it(env: Any) -> None:
    with EnvPool(get_task("antmaze-medium-diverse"), 2, workers=0) as pool:
        first = pool.start([[4], [5]])
        after = pool.step(np.stack([FULL, STILL]))
    observation, info = env.reset(seed=4)
    np.testing.assert_array_equal(first["observation"][0], observation.astype(np.float32))
    np.testing.assert_array_equal(first["position"][0], info["position"])
    np.testing.assert_array_equal(after["observation"][0], env.step(FULL)[0].astype(np.float32))


# ---------------------------------------------------------------------- gymnasium-robotics' own


@pytest.mark.parametrize("size", D4RL)
def test_the_robotics_variant_has_gymnasium_robotics_facts(size: str) -> None:
    name, cap = D4RL[size]
    task = get_task(f"{name}@robotics")
    env = task.make_env()
    inner: Any = env.unwrapped
    body = inner.ant_env
    assert body.dt == pytest.approx(0.05) == task.step_seconds
    np.testing.assert_array_equal(body.model.actuator_gear[:, 0], 150.0)
    np.testing.assert_array_equal(body.model.actuator_ctrlrange, [[-1.0, 1.0]] * 8)
    assert env.spec is not None
    assert env.spec.max_episode_steps == task.max_episode_steps == cap
    up, down = task.cell_to_xy((1, 1)), task.cell_to_xy((3, 1))
    np.testing.assert_allclose(down - up, [0.0, -8.0])  # y up the map
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        assert tuple(task.xy_to_cell(info["position"])) == task.start_cell
        np.testing.assert_array_equal(observation[2:], np.array([0.75, 1.0] + [0.0] * 25, np.float32))
        np.testing.assert_array_equal(inner.goal, task.goal_xy())
    for distance, reached in ((0.44, True), (0.46, False)):
        env.reset(seed=0)
        qpos = body.init_qpos.copy()
        qpos[:2] = task.goal_xy() + np.array([distance, 0.0])
        body.set_state(qpos, np.zeros(14))
        _, reward, terminated, _, info = env.step(STILL)
        assert (reward, terminated, info["success"]) == (float(reached), reached, reached)
    env.close()


def test_both_physics_move_the_same_pose_differently() -> None:
    ours, theirs = (get_task(f"antmaze-umaze@{name}").make_env() for name in ("d4rl", "robotics"))
    ours.reset(seed=0, options={"noise": False})
    theirs.reset(seed=0)
    first, second = (env.step(FULL)[0][2:] for env in (ours, theirs))
    assert np.abs(first - second)[-8:].max() > 1.0  # speed of a joint in radians a second
    ours.close()
    theirs.close()
