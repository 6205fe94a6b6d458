"""Skills as actions: rewards and ends worked out by hand, Gymnasium's own checker, vectors, and other libraries."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from datamodules.relabel import relabel
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.online.skill_env import SkillEnv
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task

SMALL = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 8}


class Count(gym.Env):
    """Observation (t, 1 + the last action); reward t + 1; ends by `end` after `steps` steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, steps: int = 5, end: str = "terminated") -> None:
        self.steps, self.end, self.t = steps, end, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.array([0, self.np_random.random()], np.float32), {}

    def step(self, action):
        self.t += 1
        over = self.t == self.steps
        ends = (over and self.end == "terminated", over and self.end == "truncated")
        info = {"success": self.t == 2, "position": np.array([self.t, 0.0])}
        return np.array([self.t, 1 + action[0]], np.float32), float(self.t), *ends, info


def skill_of(observation_dim=2, action_dim=1, **settings):
    torch.manual_seed(0)
    return SkillModule(observation_dim, action_dim, **{"horizon": 3, "num_skills": 4, **SMALL, **settings}).eval()


@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_a_skill_is_one_step_and_may_end_early(end):
    env = SkillEnv(Count(5, end), skill_of(), gamma=0.5, discount="per_step")
    env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(1)
    assert (observation[0], reward, terminated, truncated) == (3, 1 + 2 / 2 + 3 / 4, False, False)
    assert (info["steps"], info["discount"], info["env_return"], info["success"]) == (3, 0.5**3, 6, True)
    assert info["positions"][:, 0].tolist() == [1, 2, 3]
    observation, reward, terminated, truncated, info = env.step(2)
    assert (observation[0], reward, info["steps"], info["discount"]) == (5, 4 + 5 / 2, 2, 0.5**2)
    assert (terminated, truncated) == (end == "terminated", end == "truncated")
    assert info["success"] is False
    assert info["positions"][:2, 0].tolist() == [4, 5]
    assert np.isnan(info["positions"][2]).all()  # always H rows, as `gymnasium.vector` needs


@pytest.mark.parametrize("discount", ["per_skill", "per_step"])
def test_playing_gives_the_transitions_of_relabelling(discount):
    """The same episode, played through the environment and relabelled from its recording."""
    settings = {"gamma": 0.9, "discount": discount, "reward_scale": 0.5, "reward_shift": -1.0}
    env = SkillEnv(Count(7), skill_of(), **settings)
    first, _ = env.reset(seed=0)
    observations, played, over = [first], [], False
    while not over:
        _, reward, terminated, _, info = env.step(0)
        played.append((reward, info["discount"], float(terminated)))
        over = terminated
    observations = np.array([[t, 0] for t in range(8)], np.float32)
    episode = {"observations": observations, "actions": np.stack(env._taken), "rewards": np.arange(1.0, 8)}
    ends = np.arange(7) == 6
    recorded = Trajectories.from_episodes("t", [{**episode, "terminations": ends, "truncations": ends & False}])
    made = relabel(recorded, skill_of(), stride=3, **settings)  # float32
    rows = zip(made.rewards.tolist(), made.discounts.tolist(), made.dones.tolist(), strict=True)
    assert list(rows) == [pytest.approx(row, rel=1e-5) for row in played]


@pytest.mark.parametrize("bottleneck", ["vq", "gaussian", None])
def test_gymnasiums_checker_accepts_it(bottleneck):
    skill = None if bottleneck is None else skill_of(bottleneck=bottleneck)
    env = SkillEnv(Count(50), skill)
    expected = {"vq": gym.spaces.Discrete, "gaussian": gym.spaces.Box, None: gym.spaces.Box}[bottleneck]
    assert type(env.action_space) is expected
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)


def test_an_environment_of_a_task_is_checked_and_made_anew_from_its_spec():
    skill = skill_of(observation_dim=4, action_dim=2)
    skill.action_box.fit(torch.full((2,), -1.0), torch.full((2,), 1.0))
    env = SkillEnv(get_task("pointmaze-large-diverse").make_env(), skill, reward_shift=-1.0)
    check_env(env, skip_render_check=True)
    again = env.spec.make()
    assert (again.skill, again.reward_shift) == (skill, -1.0)
    for one in (env, again):
        one.reset(seed=3)
    assert np.array_equal(env.step(1)[0], again.step(1)[0])


def test_the_same_seed_and_codes_give_the_same_episode():
    env = SkillEnv(Count(30), skill_of())
    seen = []
    for _ in range(2):
        first, _ = env.reset(seed=4)
        seen.append(np.stack([first, *(env.step(k % 4)[0] for k in range(5))]))
    assert np.array_equal(*seen)
    env.reset(seed=5)
    assert not np.array_equal(seen[0][-1], [env.step(k % 4)[0] for k in range(5)][-1])


def test_an_episode_is_taken_up_again_to_the_bit():
    env = SkillEnv(Count(30), skill_of())
    env.reset(seed=1)
    env.step(0)
    kept = env.state_dict()
    through = [env.step(k)[0] for k in (1, 2, 3)]
    following = env.reset()[0]
    other = SkillEnv(Count(30), skill_of())
    other.load_state_dict(kept)
    assert np.array_equal(through, [other.step(k)[0] for k in (1, 2, 3)])
    assert np.array_equal(following, other.reset()[0])
    with pytest.raises(UserError, match="did not come back to its state after 3 steps"):
        other.load_state_dict({**kept, "observation": kept["observation"] + 1})


def test_it_is_vectorised_by_gymnasium():
    # The last ends inside its first skill, which the others play to the end.
    ragged = gym.vector.SyncVectorEnv([lambda steps=steps: SkillEnv(Count(steps), skill_of()) for steps in (5, 5, 2)])
    ragged.reset(seed=0)
    assert ragged.step(np.array([0, 1, 2]))[-1]["steps"].tolist() == [3, 3, 2]
    vector = gym.vector.SyncVectorEnv([lambda: SkillEnv(Count(5), skill_of())] * 3)
    observations, _ = vector.reset(seed=[1, 2, 3])
    assert observations.shape == (3, 2)
    assert vector.action_space.nvec.tolist() == [4, 4, 4]
    _, rewards, *_, infos = vector.step(np.array([0, 1, 2]))
    assert rewards.tolist() == [pytest.approx(1 + 0.99 * 2 + 0.99**2 * 3)] * 3
    assert infos["steps"].tolist() == [3, 3, 3]
    _, _, terminated, truncated, infos = vector.step(np.array([0, 1, 2]))
    assert terminated.all()
    assert not truncated.any()
    assert infos["steps"].tolist() == [2, 2, 2]


def test_what_is_no_skill_is_refused():
    env = SkillEnv(Count(5), skill_of())
    with pytest.raises(UserError, match=r"no episode has begun: call reset\(\) before the first skill"):
        env.step(0)
    env.reset(seed=0)
    for code in (-1, 4, 1.7, np.array([1]), None, "a"):
        with pytest.raises(UserError, match=re.escape(f"the action is {code}, expected a code from 0 to 3")):
            env.step(code)
    env = SkillEnv(Count(5), skill_of(bottleneck="gaussian"))
    env.reset(seed=0)
    for vector in (np.zeros(7), np.full(8, np.nan), 0):
        with pytest.raises(UserError, match="expected a skill vector of 8 finite numbers"):
            env.step(vector)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"gamma": 2.0}, r"gamma is 2.0, expected a discount in \(0, 1\]"),
        ({"discount": "steps"}, "discount is steps, expected per_skill or per_step"),
        ({"noise_scale": -1.0}, "noise_scale is -1.0, expected None or 0 or more"),
        ({"bound": 0.0}, "bound is 0.0, expected positive"),
    ],
)
def test_settings_out_of_range_are_refused(settings, sentence):
    with pytest.raises(UserError, match=sentence):
        SkillEnv(Count(5), skill_of(), **settings)


@pytest.mark.parametrize(
    ("env", "skill", "sentence"),
    [
        (Count(), {"observation_dim": 4}, "the skill model has observation_dim 4, Count has 2: it was trained on"),
        (Count(), {"action_dim": 2}, r"the skill model acts with 2 numbers, Count takes Box\(-1.0, 1.0, \(1,\)"),
        (gym.make("CartPole-v1"), {"observation_dim": 4}, r"CartPole-v1 takes Discrete\(2\): give a skill model"),
        (gym.make("Pendulum-v1"), {"observation_dim": 3}, r"have low bounds \[-2.0\], the skill model's have \[-1.0\]"),
        (gym.make("Blackjack-v1"), {}, "the observations of Blackjack-v1 are Tuple.*, expected a flat Box"),
        (
            gym.make("MountainCarContinuous-v0", max_episode_steps=2),
            {},
            "a skill lasts 3 steps, an episode of MountainCarContinuous-v0 at most 2: take skills with a shorter",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(env, skill, sentence):
    with pytest.raises(UserError, match=sentence):
        SkillEnv(env, skill_of(**skill))


def test_a_maze_counts_its_own_success():
    task = get_task("pointmaze-umaze-diverse")
    env = SkillEnv(task.make_env(), skill_of(4, 2))
    env.reset(seed=0)
    *_, info = env.step(0)
    assert (info["steps"], info["positions"].shape, info["success"]) == (3, (3, 2), False)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_stable_baselines_learns_which_code_is_paid(algorithm):
    """The longer an episode lasts the better; only code 0 keeps it alive."""
    sb3 = pytest.importorskip("stable_baselines3")

    class Alive(SkillEnv):
        def step(self, action):
            observation, _, terminated, truncated, info = super().step(action)
            return observation, float(action == 0), terminated or action != 0, truncated, info

    settings = {
        "PPO": {"n_steps": 128, "n_epochs": 4, "learning_rate": 3e-3},
        "DQN": {"learning_starts": 100, "target_update_interval": 100, "learning_rate": 3e-3, "train_freq": 1},
    }
    model = getattr(sb3, algorithm)(
        "MlpPolicy", Alive(Count(30), skill_of()), seed=0, device="cpu", **settings[algorithm]
    )
    model.learn(1500)
    env, returned = Alive(Count(30), skill_of()), 0.0
    observation, _ = env.reset(seed=0)
    for _ in range(10):
        observation, reward, terminated, truncated, _ = env.step(model.predict(observation, deterministic=True)[0])
        returned += reward
        if terminated or truncated:
            break
    assert returned == 10
