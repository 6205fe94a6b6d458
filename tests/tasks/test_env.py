"""Every task's environment in the hands of others: Gymnasium's checks, vectors of copies, stable-baselines3."""

import json
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from dds_lightning.envs.pool import EnvPool
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task, task_names

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


class Buoy(gym.Env):
    """Floats; `wrong` says what it gives in place of what Gymnasium expects."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, wrong=""):
        self.wrong = wrong

    def reset(self, *, seed=None, options=None):
        return np.zeros(2) if self.wrong == "old reset" else (np.zeros(2), {})

    def step(self, action):
        seen = {"wide": np.zeros(3), "text": np.array(["a", "b"]), "lost": np.array([0.0, np.nan])}
        reward = {"no reward": None, "nan": np.nan}.get(self.wrong, 1.0)
        answer = (seen.get(self.wrong, np.zeros(2)), reward, False, False, {})
        return answer[:4] if self.wrong == "old step" else answer


class SeedlessBuoy(Buoy):
    """From before environments were seeded by `reset`."""

    def reset(self):
        return np.zeros(2), {}


WRONG = {
    "wide": r"the environment of buoy \(Buoy-v0\) gives an observation of shape \(3,\), expected \(2,\)",
    "text": "gives an observation that is no array of numbers: could not convert string",
    "lost": "gives an observation with nan in column 1, expected finite numbers: end the episode",
    "nan": "pays a reward of nan, expected a finite number",
    "no reward": "pays a reward of None, expected a finite number",
    "old step": r"Buoy does not .* interface .*got 4\)\): expected step\(action\) to return five values:",
    "old reset": r"\(it returns a ndarray\): expected reset\(seed=..., options=...\) to return two values",
    "old seed": r"got an unexpected keyword argument 'seed'\): expected reset\(seed=",
}


@pytest.mark.parametrize(("wrong", "workers"), [*((wrong, 0) for wrong in WRONG), ("lost", 1)])
def test_what_an_own_environment_does_wrong_is_one_sentence(wrong, workers):
    sizes = {"observation_dim": 2, "action_dim": 1, "max_episode_steps": 9, "step_seconds": 0.1}
    task = Task("buoy", "default", f"{__name__}:Buoy-v0", env_options={"wrong": wrong}, **sizes)
    if wrong == "old seed":
        task = Task("buoy", "default", f"{__name__}:SeedlessBuoy-v0", **sizes)
    with EnvPool(task, 1, workers) as pool, pytest.raises(UserError, match=WRONG[wrong].replace("Buoy-v0", ".*")):
        _ = pool.start([[0]]), pool.step(np.zeros((1, 1), np.float32))


for kind in (Buoy, SeedlessBuoy):
    if f"{kind.__name__}-v0" not in gym.registry:
        gym.register(f"{kind.__name__}-v0", entry_point=f"{__name__}:{kind.__name__}")
