"""Every task's environment in the hands of others: Gymnasium's checks, vectors of copies, stable-baselines3."""

import json
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from dds_lightning.tasks import get_task, task_names

EVERY_TASK = (*task_names(), "antmaze-umaze@robotics", "hopper-medium@v5")

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*Box observation space .*:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*different from the unwrapped version.*:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*is out of date.*"),
]


@pytest.mark.parametrize("name", EVERY_TASK)
def test_gymnasium_checks_it_and_makes_a_vector_of_it(name):
    task = get_task(name)
    env = task.make_env()
    check_env(env, skip_render_check=True)  # drawing needs a screen
    vector = gym.make_vec(env.spec, num_envs=2)
    first, _ = vector.reset(seed=[3, 4])
    np.testing.assert_array_equal(first[0], env.reset(seed=3)[0])
    action = vector.action_space.sample()
    reached = env.step(action[0])[0]
    np.testing.assert_allclose(vector.step(action)[0][0], reached, rtol=1e-5, atol=1e-6)
    vector.close()
    again = EnvSpec.from_json(env.spec.to_json()).make()
    assert type(again) is type(env)
    assert json.dumps(asdict(again.task)) == json.dumps(asdict(task))
    np.testing.assert_array_equal(again.reset(seed=3)[0], first[0])
    np.testing.assert_allclose(again.step(action[0])[0], reached, rtol=1e-5, atol=1e-6)
    again.close()
    env.close()


@pytest.mark.parametrize("name", ["pointmaze-umaze-play", "antmaze-umaze@robotics", "kitchen-mixed", "hopper-medium"])
def test_stable_baselines_takes_it_for_what_it_is(name, capsys):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    env = get_task(name).make_env()
    sb3.check_env(env, warn=False)
    assert "GoalEnv" not in capsys.readouterr().out
    env.close()


def test_the_simulator_is_reached_through_an_environment_without_goals():
    env = get_task("pointmaze-umaze-play").make_env()
    env.reset(seed=0)
    assert not hasattr(env.unwrapped, "compute_reward")
    assert env.unwrapped.point_env.model.nq == 2
    np.testing.assert_array_equal(env.unwrapped.goal, get_task("pointmaze-umaze-play").goal_xy())
    env.unwrapped.reward_type = "dense"  # what users change there must reach it
    assert env.env.unwrapped.reward_type == "dense"
    assert "reward_type" not in vars(env)
    env.own = env.unwrapped.own = 3
    assert not hasattr(env.env.unwrapped, "own")
    with pytest.raises(AttributeError, match="no_such_thing"):
        env.no_such_thing  # noqa: B018
    env.close()
