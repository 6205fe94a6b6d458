"""The agent: clocks, random streams, ways of choosing, and the directory it lives in."""

import copy
import json

import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from torch import nn

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.rollout.actors import AgentGroup, Contestant, single_skills
from dds_lightning.rollout.play import rollout
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task

K, H = 4, 3


class CodeSkill(nn.Module):
    """Its action is the code, so that actions show the clock."""

    def __init__(self):
        super().__init__()
        self.horizon, self.num_skills = H, K
        self.hparams = {"observation_dim": 2, "action_dim": 1, "num_skills": K, "noise_scale": 1.0}
        self.weight = nn.Parameter(torch.zeros(1))

    def decode(self, observations, codes, noise_scale=None, generator=None):
        assert not self.training
        return codes[:, None].float()


class StatePolicy(nn.Module):
    """Chooses the code that the first observation entry names, and counts what it was asked."""

    def __init__(self):
        super().__init__()
        self.hparams = {"observation_dim": 2, "num_skills": K}
        self.asked = []

    def codes(self, observations, selection, temperature, generator):
        self.asked.append((len(observations), selection, temperature))
        return observations[:, 0].long()


def tiny_modules(seed=0):
    torch.manual_seed(seed)
    skill = SkillModule(4, 2, horizon=5, num_skills=K, skill_dim=8, hidden_dim=16, encoder_layers=1, encoder_heads=2)
    skill.normaliser.fit(torch.arange(4.0), torch.ones(4))
    skill.bottleneck.start_from(torch.randn(64, 8))
    policy = PolicyModule(4, K, hidden_dims=(16,))
    policy.normaliser.fit(torch.arange(4.0), torch.ones(4))
    policy.support_mask[1] = False
    return skill, policy


@pytest.fixture(scope="module")
def agent():
    return DDSAgent(*tiny_modules())


def observe(*codes):
    return np.array([[code, 0.0] for code in codes], np.float32)


# ---------------------------------------------------------------- the clock


def test_a_skill_lasts_h_steps_counted_from_each_environments_own_reset():
    policy = StatePolicy()
    agent = DDSAgent(CodeSkill(), policy, "greedy")
    agent.reset(3)
    acted, decided, restarts = [], [], {4: [1], 5: [0, 2]}
    for step in range(9):
        restarted = np.zeros(3, bool)
        restarted[restarts.get(step, [])] = True
        codes = (step % K, (step + 1) % K, (step + 2) % K)
        acted.append(agent.act(observe(*codes), restarted)[:, 0].astype(int).tolist())
        decided.append(agent.decided.tolist())
        assert agent.codes.tolist() == acted[-1]
    # environment 0 decides at 0 3 | 5 8, environment 1 at 0 3 | 4 7, environment 2 at 0 3 | 5 8
    assert [step for step in range(9) if decided[step][0]] == [0, 3, 5, 8]
    assert [step for step in range(9) if decided[step][1]] == [0, 3, 4, 7]
    assert [row[0] for row in acted] == [0, 0, 0, 3, 3, 1, 1, 1, 0]
    assert [row[1] for row in acted] == [1, 1, 1, 0, 1, 1, 1, 0, 0]
    assert [row[2] for row in acted] == [2, 2, 2, 1, 1, 3, 3, 3, 2]
    assert [count for count, _, _ in policy.asked] == [3, 3, 1, 2, 1, 2]


def test_a_skill_may_be_held_for_fewer_steps_than_it_was_learnt_for():
    agent = DDSAgent(CodeSkill(), StatePolicy(), "greedy", hold=2)
    agent.reset(1)
    acted = [float(agent.act(observe(step % K))[0, 0]) for step in range(6)]
    assert acted == [0, 0, 2, 2, 0, 0]  # a new choice every second step, where H = 3 would give 0 0 0 3 3 3
    assert agent.variant("random").hold == 2
    for hold in (0, H + 1):
        with pytest.raises(UserError, match=f"hold is {hold}, expected 1 to 3, the steps that these skills last"):
            DDSAgent(CodeSkill(), StatePolicy(), "greedy", hold=hold)


def test_how_long_a_skill_is_held_is_saved_where_it_differs_from_h(tmp_path):
    for hold, kept in ((2, {"hold": 2}), (5, {})):
        place = DDSAgent(*tiny_modules(), hold=hold).save(tmp_path / str(hold))
        config = yaml.safe_load((place / "config.yaml").read_text())["agent"]
        assert {key: value for key, value in config.items() if key == "hold"} == kept
        assert DDSAgent.load(place).hold == hold


def test_rows_that_are_left_out_keep_their_clock():
    agent = DDSAgent(CodeSkill(), StatePolicy(), "greedy")
    agent.reset(3)
    agent.act(observe(1, 2, 3))
    for _ in range(2):
        assert agent.act(observe(0, 0), rows=np.array([0, 2]))[:, 0].tolist() == [1.0, 3.0]
    assert agent.act(observe(0, 0, 0))[:, 0].tolist() == [0.0, 2.0, 0.0]
    assert agent.decided.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("observations", "message"),
    [
        ({"observation": [0.0, 1.0], "desired_goal": [0.0]}, "a dictionary of observation, desired_goal, expected one"),
        ((np.zeros(2), {}), "are a tuple, expected an array of numbers: reset returns them and a dictionary"),
        ([[0.0, 1.0], [0.0]], "are a list, expected an array of numbers$"),
        ("left", "are a str, expected an array of numbers$"),
        ([0.0, np.nan], r"hold nan at \[1\], expected finite numbers"),
        ([[0.0, 0.0], [1e39, 0.0]], r"hold inf at \[1, 0\], expected finite numbers"),
        ([0.0, 1.0, 2.0], r"are \(1, 3\), expected \(environments, 2\)"),
        (np.zeros((1, 1, 2)), r"are \(1, 1, 2\), expected \(environments, 2\)"),
        (0.0, r"are \(1, 1\), expected \(environments, 2\)"),
    ],
)
def test_what_cannot_be_acted_on_is_told_in_a_sentence_and_changes_nothing(observations, message):
    agent = DDSAgent(CodeSkill(), StatePolicy(), "greedy")
    with pytest.raises(UserError, match=message):
        agent.act(observations)
    assert agent.num_envs == 0
    assert agent.act([3.0, 0.0]).tolist() == [3.0]


def test_reset_starts_all_clocks_anew():
    agent = DDSAgent(CodeSkill(), StatePolicy(), "greedy")
    agent.act(observe(1, 1))
    agent.reset(2)
    assert agent.act(observe(2, 3))[:, 0].tolist() == [2.0, 3.0]


def test_fixed_codes_follow_rows_and_random_codes_cover_all():
    agent = DDSAgent(CodeSkill(), None, "fixed", fixed_codes=np.arange(K))
    agent.reset(2 * K)
    assert agent.act(observe(*[0] * 8))[:, 0].tolist() == [0, 1, 2, 3, 0, 1, 2, 3]
    assert agent.act(observe(0), rows=np.array([6]))[:, 0].tolist() == [2]
    chance = agent.variant("random", fixed_codes=None)
    chance.reset(400, seed=0)
    counts = np.bincount(chance.act(observe(*[0] * 400))[:, 0].astype(int), minlength=K)
    assert counts.min() > 70


def test_selection_and_temperature_reach_the_policy():
    policy = StatePolicy()
    agent = DDSAgent(CodeSkill(), policy, "sample", temperature=0.5)
    agent.act(observe(1))
    agent.variant("argmax_q").act(observe(1))
    agent.variant(temperature=2.0).act(observe(1))
    assert policy.asked == [(1, "sample", 0.5), (1, "argmax_q", 0.5), (1, "sample", 2.0)]


# ---------------------------------------------------------------- random streams, modes, copies


def play(agent, seed, steps=12, envs=6):
    agent.reset(envs, seed)
    rng = np.random.default_rng(0)
    return np.stack([agent.act(rng.normal(size=(envs, 4)).astype(np.float32)) for _ in range(steps)])


def test_the_same_seed_gives_the_same_actions_and_another_does_not(agent):
    first = play(agent, 3)
    assert first.shape == (12, 6, 2)
    assert first.dtype == np.float32
    assert np.abs(first).max() <= 1.0
    np.testing.assert_array_equal(play(agent, 3), first)
    assert not np.array_equal(play(agent, 4), first)
    assert not np.array_equal(play(agent, None), play(agent, None))  # the stream goes on


def test_acting_leaves_the_global_stream_alone(agent):
    torch.manual_seed(0)
    np.random.seed(0)
    state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    play(agent.variant("random"), 0)
    play(agent, 0)
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)


def test_dropout_is_off_even_if_somebody_called_train():
    agent = DDSAgent(*tiny_modules())
    expected = play(agent, 1)
    agent.train()
    np.testing.assert_array_equal(play(agent, 1), expected)


def test_variants_share_networks_and_leave_their_origin_alone(agent):
    greedy = agent.variant("greedy")
    assert greedy.skill is agent.skill
    assert greedy.policy is agent.policy
    before = play(agent, 5)
    agent.reset(6, 5)
    rng = np.random.default_rng(0)
    play(greedy, 9)
    after = np.stack([agent.act(rng.normal(size=(6, 4)).astype(np.float32)) for _ in range(12)])
    np.testing.assert_array_equal(after, before)


def test_the_noise_scale_is_the_agents_or_else_its_skill_models_and_a_null_stays_null_in_the_file(tmp_path):
    agent = DDSAgent(*tiny_modules())
    agent.skill.hparams["noise_scale"] = 0.25
    assert agent.noise_scale == agent.variant("greedy").noise_scale == 0.25
    assert agent.variant(noise_scale=0.0).noise_scale == 0.0
    for given in (None, 0.5):
        directory = agent.variant(noise_scale=given).save(tmp_path / str(given))
        assert yaml.safe_load((directory / "config.yaml").read_text())["agent"]["noise_scale"] == given
        assert DDSAgent.load(directory).noise_scale == (0.25 if given is None else given)


def test_noise_scale_zero_is_deterministic_for_a_greedy_agent(agent):
    calm = agent.variant("greedy", noise_scale=0.0)
    np.testing.assert_array_equal(play(calm, 1), play(calm, 2))


def test_codes_without_support_are_never_chosen(agent):
    for way in ("sample", "greedy", "argmax_q"):
        own = agent.variant(way)
        own.reset(500, seed=0)
        own.act(np.random.default_rng(0).normal(size=(500, 4)))
        assert 1 not in own.codes


# ---------------------------------------------------------------- any gymnasium environment


def test_it_acts_in_a_plain_gymnasium_environment():
    class Plain(gym.Env):
        observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
        action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(4, np.float32), {}

        def step(self, action):
            assert self.action_space.contains(action)
            return np.append(action, action).astype(np.float32), 0.0, False, False, {}

    agent = DDSAgent(*tiny_modules())
    env = Plain()
    observation, _ = env.reset(seed=0)
    agent.reset()
    for _ in range(7):
        observation, *_ = env.step(agent.act(observation))
    envs = gym.vector.SyncVectorEnv([Plain, Plain])
    observations, _ = envs.reset(seed=0)
    agent.reset(2)
    assert envs.step(agent.act(observations))[0].shape == (2, 4)


@pytest.mark.parametrize(
    ("observations", "settings", "message"),
    [
        (np.zeros((2, 5)), {}, r"observations are \(2, 5\), expected \(environments, 4\)"),
        (np.zeros((3, 4)), {}, "3 observations for 2 environments"),
        (np.zeros((2, 1, 4)), {}, r"observations are \(2, 1, 4\)"),
        (np.zeros((2, 4)), {"restarted": np.ones(3, bool)}, r"restarted is \(3,\)"),
    ],
)
def test_wrong_shapes_are_refused(agent, observations, settings, message):
    agent.reset(2)
    with pytest.raises(UserError, match=message):
        agent.act(observations, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"selection": "best"}, "selection is 'best', expected one of sample"),
        ({"temperature": 0.0}, "temperature is 0"),
        ({"noise_scale": -1.0}, "noise_scale is -1"),
        ({"selection": "fixed"}, "fixed_codes is None"),
        ({"selection": "fixed", "fixed_codes": [0, K]}, "expected a list of codes of 0 to 3"),
        ({"fixed_codes": [0]}, "selection is 'sample' and fixed_codes"),
        ({"policy": None}, "needs a policy"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    skill, policy = tiny_modules()
    with pytest.raises(UserError, match=message):
        DDSAgent(skill, **{"policy": policy, **settings})


def test_parts_that_do_not_fit_are_refused():
    skill, _ = tiny_modules()
    with pytest.raises(UserError, match="num_skills is 4 in the skill model and 5 in the policy"):
        DDSAgent(skill, PolicyModule(4, 5, hidden_dims=(8,)))
    gaussian = SkillModule(4, 2, bottleneck="gaussian", hidden_dim=16, encoder_layers=1, encoder_heads=2)
    with pytest.raises(UserError, match="selection is 'fixed', which needs codes, but the skills are continuous"):
        DDSAgent(gaussian, None, "fixed", fixed_codes=[0])


# ---------------------------------------------------------------- many agents, one decoder


def test_a_group_acts_as_its_members_would():
    skill, policy = tiny_modules()
    members = [
        DDSAgent(skill, policy, "greedy", noise_scale=0.0),
        DDSAgent(skill, policy, "argmax_q", noise_scale=0.0),
        DDSAgent(skill, None, "fixed", fixed_codes=[0, 2], noise_scale=0.0),
    ]
    alone = [DDSAgent(m.skill, m.policy, m.selection, 1.0, 0.0, m.fixed_codes) for m in members]
    group = AgentGroup(members)
    group.reset([2, 1, 4], [0, 0, 0])
    for own, size in zip(alone, (2, 1, 4), strict=True):
        own.reset(size, 0)
    rng = np.random.default_rng(0)
    rows = np.array([0, 1, 3, 4, 5, 6])  # the second member has finished
    for step in range(8):
        seen = rng.normal(size=(6, 4)).astype(np.float32)
        acted = group.act(seen, np.zeros(6, bool), rows)
        expected = [alone[0].act(seen[:2]), alone[2].act(seen[2:])]
        np.testing.assert_allclose(acted.actions, np.concatenate(expected), atol=1e-6)
        assert acted.codes[2:].tolist() == [0, 2, 0, 2]
        assert acted.chosen.tolist() == [step % 5 == 0] * 6


def test_agents_play_a_rollout_together(agent):
    task = get_task("pointmaze-umaze-diverse")
    players = [Contestant("sampled", agent, 2), Contestant("random", agent.variant("random"), 3)]
    players.append(single_skills(agent, 1))
    result = rollout(task, players, workers=0, slots=8, record=True)
    table = result.episodes.set_index("actor")
    assert table.loc["single skill", "label"].tolist() == ["skill 0", "skill 1", "skill 2", "skill 3"]
    assert table.loc["single skill", "final_code"].tolist() == [0, 1, 2, 3]
    assert (table["codes"].map(len) == -(-table["length"] // 5)).all()  # a choice every H = 5 steps
    for row in result.episodes.itertuples():
        codes = result.paths[row.actor, row.episode].codes
        assert codes[::5].tolist() == row.codes
    assert table.loc["random", "codes"].map(set).map(len).max() == K


# ---------------------------------------------------------------- the directory


@pytest.fixture
def saved(tmp_path):
    agent = DDSAgent(*tiny_modules(), selection="sample", temperature=0.7)
    agent.save(tmp_path / "agent", metrics={"success": 97.5}, task="pointmaze-large-diverse")
    return agent, tmp_path / "agent"


def test_a_saved_agent_acts_the_same_after_loading(saved):
    agent, directory = saved
    loaded = DDSAgent.load(directory)
    assert (loaded.selection, loaded.temperature) == ("sample", 0.7)
    np.testing.assert_array_equal(play(loaded, 3), play(agent, 3))
    assert not loaded.training
    assert json.loads((directory / "metrics.json").read_text()) == {"success": 97.5}


def test_settings_can_be_overridden_while_loading(saved):
    _, directory = saved
    loaded = DDSAgent.load(directory, selection="greedy", noise_scale=0.0)
    assert (loaded.selection, loaded.noise_scale, loaded.temperature) == ("greedy", 0.0, 0.7)
    with pytest.raises(UserError, match="selektion"):
        DDSAgent.load(directory, selektion="greedy")


def test_an_agent_without_policy_and_one_with_fixed_codes_survive(tmp_path):
    skill, _ = tiny_modules()
    DDSAgent(skill, None, "fixed", fixed_codes=[2, 1]).save(tmp_path / "fixed")
    loaded = DDSAgent.load(tmp_path / "fixed")
    assert loaded.policy is None
    assert loaded.fixed_codes.tolist() == [2, 1]
    assert DDSAgent.load(tmp_path / "fixed", selection="random").fixed_codes is None


def test_one_module_alone_comes_out_of_a_published_directory(saved):
    agent, directory = saved
    skill, policy = SkillModule.load(directory), PolicyModule.load(directory)
    for mine, other in ((agent.skill, skill), (agent.policy, policy)):
        for name, value in mine.state_dict().items():
            assert torch.equal(other.state_dict()[name], value), name


def test_an_agent_can_be_copied(agent):
    np.testing.assert_array_equal(play(copy.deepcopy(agent), 2), play(agent, 2))
