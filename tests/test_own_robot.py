"""A robot that the table of tasks does not know: its arrays train an agent, its own `Task` lets it be played."""

import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from datamodules import Trajectories, describe, load_trajectories
from datamodules.validation import DataError
from dds_lightning import DDSAgent, get_task
from dds_lightning.interpret.draw.maze import plot_trajectories
from dds_lightning.rollout.actors import Contestant, RandomActor
from dds_lightning.rollout.play import rollout
from dds_lightning.tasks import Task
from tests.fits import POLICY, QUIET, call, skill_of, told

LENGTH, BOX = 40, 6.0


class Trolley(gym.Env):
    """A trolley on a rail of three cells, moved by volts; it ends in the third."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Box(-BOX, BOX, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v = -1.0 + self.np_random.uniform(-0.1, 0.1), 0.0
        return self._seen(), self._info()

    def step(self, action):
        self.v = 0.5 * self.v + 0.2 * float(action[0])
        self.x = float(np.clip(self.x + 0.1 * self.v, -1.4, 1.4))
        return self._seen(), float(self.x > 0.6), self.x > 0.6, False, self._info()

    def _seen(self):
        return np.array([self.x, 0.0, self.v], np.float32)

    def _info(self):
        return {"success": self.x > 0.6, "position": np.array([self.x, 0.0])}


RAIL = Task(
    name="trolley",
    family="trolley",
    env_id="Trolley-v0",
    observation_dim=3,
    action_dim=1,
    action_low=-BOX,
    action_high=BOX,
    max_episode_steps=LENGTH,
    step_seconds=0.1,
    maze_map=("11111", "10001", "11111"),
    start_cell=(1, 1),
    goal_cell=(1, 3),
    goal_radius=0.4,
)


@pytest.fixture(autouse=True)
def _registered():
    gym.register(RAIL.env_id, entry_point=f"{__name__}:Trolley")
    yield
    del gym.registry[RAIL.env_id]


def recordings():
    """Twelve episodes of random volts, mostly to the right."""
    rng, env, episodes = np.random.default_rng(0), Trolley(), []
    for number in range(12):
        seen, taken, rewards, ended = [env.reset(seed=number)[0]], [], [], False
        while len(taken) < LENGTH and not ended:
            taken.append(rng.uniform(-3, BOX, 1).astype(np.float32))
            observation, reward, ended, _, _ = env.step(taken[-1])
            seen.append(observation)
            rewards.append(reward)
        last = np.arange(len(taken)) == len(taken) - 1
        ends = {"terminations": last & ended, "truncations": last & (not ended)}
        episodes.append({"observations": np.stack(seen), "actions": np.stack(taken), "rewards": rewards, **ends})
    return episodes


def made_of(episodes):
    return Trajectories.from_episodes("trolley", episodes, action_low=-BOX, action_high=BOX)


def test_its_arrays_belong_to_its_own_task(tmp_path):
    data = made_of(recordings())
    data.save(tmp_path / "data")
    back = load_trajectories(f"arrays:{tmp_path / 'data'}", RAIL)
    assert back.fingerprint() == data.fingerprint()
    facts, dimensions = describe(back, task=RAIL, horizon=5)
    assert facts["free cells visited"] == "3 of 3"
    assert 0 < facts["episodes that reach the goal"] == data.terminations.sum()
    assert dimensions["highest"].iloc[-1] <= BOX
    with pytest.raises(DataError, match="got 3 columns, task 'hopper-medium' needs 11"):
        load_trajectories(f"arrays:{tmp_path / 'data'}", get_task("hopper-medium"))


def test_it_is_played_and_drawn_as_the_tables_tasks_are():
    full = RandomActor(1, BOX / 2, BOX)
    result = rollout(RAIL, [Contestant("to the right", full, 3)], workers=0, record=True, progress=False)
    table = result.episodes
    assert table["success"].all()
    assert (table["score"] == 100.0).all()
    assert table["length"].max() < LENGTH
    assert result.paths["to the right", 0].positions[-1, 0] > 0.6
    assert plot_trajectories(RAIL, result, "to the right").axes[0].get_title().startswith("to the right: 100%")
    idle = RandomActor(1, -BOX, -BOX / 2)
    lost = rollout(RAIL, [Contestant("to the left", idle, 2)], workers=0, progress=False).episodes
    assert not lost["success"].any()
    assert (lost["length"] == LENGTH).all()


def test_arrays_without_a_task_train_an_agent_on_the_command_line(tmp_path):
    data = made_of(recordings())
    data.save(tmp_path / "data")
    words = [f"--data.data=arrays:{tmp_path / 'data'}", "--data.validation_fraction=0.2"]
    skill = skill_of(words, tmp_path / "skill", 3)
    policy = ["policy", "fit", *words, *QUIET, *POLICY, f"--data.skill={skill}", "--data.reward_scale=0.1"]
    policy += ["--data.reward_shift=-1", "--trainer.max_steps=3", f"--checkpoint.dirpath={tmp_path / 'policy'}"]
    assert call(*policy, f"--trainer.default_root_dir={tmp_path}") == 0
    place = tmp_path / "agent"
    assert call("publish", "-", place, "--skill", skill, "--policy", tmp_path / "policy" / "last.ckpt") == 0
    agent = DDSAgent.load(place, seed=0)
    actions = np.concatenate([agent.act(row) for row in data.observations[:50]])
    assert (agent.observation_dim, agent.action_dim) == (3, 1)
    assert np.abs(actions).max() <= BOX
    assert np.abs(actions).max() > 1.0  # volts, not the unit box
    played = rollout(RAIL, [Contestant("agent", agent, 2)], workers=0, progress=False)
    assert len(played.episodes["codes"].iloc[0]) == -(-played.episodes["length"].iloc[0] // agent.horizon)


MODULE = """
import gymnasium as gym
import numpy as np

LOW, HIGH = np.array([-2.0, 0.5], np.float32), np.array([1.0, 3.0], np.float32)


class TwoArms(gym.Env):
    observation_space, action_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32), gym.spaces.Box(LOW, HIGH)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 2)
        return self.x.astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.x = 0.8 * self.x + 0.1 * action
        return self.x.astype(np.float32), -float(np.abs(self.x).sum()), False, False, {}


gym.register("TwoArms-v0", entry_point="two_arms:TwoArms")
"""


@pytest.fixture
def arms(tmp_path, monkeypatch):
    """A task file whose environment is a module of one's own, with bounds that no single number describes."""
    (tmp_path / "two_arms.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    address = tmp_path / "arms.yaml"
    address.write_text("env_id: two_arms:TwoArms-v0\nmax_episode_steps: 20\nscore_min: -60\nscore_max: 0\n")
    yield str(address)
    gym.registry.pop("TwoArms-v0", None)


def test_an_environment_in_a_module_of_ones_own_with_a_box_of_its_own_goes_through_every_command(
    tmp_path, arms, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    task, episodes, last = get_task(arms), [], np.arange(20) == 19
    assert (task.action_low, task.action_high) == ((-2.0, 0.5), (1.0, 3.0))
    env = task.make_env()
    for number in range(8):
        seen, taken, rewards = [env.reset(seed=number)[0]], [], []
        for _ in range(20):
            taken.append(env.action_space.sample())
            observation, reward, *_ = env.step(taken[-1])
            seen.append(observation)
            rewards.append(reward)
        fields = {"observations": seen, "actions": taken, "rewards": rewards}
        episodes.append({**{key: np.stack(value) for key, value in fields.items()}, "terminations": last & False})
        episodes[-1]["truncations"] = last
    low, high = task.action_box()
    Trajectories.from_episodes("arms", episodes, action_low=low, action_high=high).save(tmp_path / "data")
    assert call("data", "check", "arrays:data", "--task", arms) == 0
    words = [f"--data.task={arms}", "--data.data=arrays:data", "--data.validation_fraction=0.2"]
    skill = skill_of(words, tmp_path / "skill", 3)
    policy = ["policy", "fit", *words, *QUIET, *POLICY, f"--data.skill={skill}", "--trainer.max_steps=3"]
    assert call(*policy, "--checkpoint.dirpath=policy", f"--trainer.default_root_dir={tmp_path}") == 0
    parts = ["--skill", skill, "--policy", "policy/last.ckpt", "--task", arms]
    assert call("evaluate", *parts, "--episodes", 2, "--workers", 1) == 0
    assert call("publish", "-", "agent", *parts) == 0
    assert call("checkpoints", "verify", "agent") == 0
    assert call("evaluate", "agent", "--task", arms, "--episodes", 2, "--workers", 1) == 0
    few = ["--episodes=1", "--episodes_per_skill=1", "--clone_steps=3", "--workers=0", "--evaluate_every=0"]
    few += ["--skill.model.num_skills=2", "--skill.model.hidden_dim=16", "--policy.model.hidden_dims=[16]"]
    few += ["--skill.data.validation_fraction=0.2", "--policy.data.validation_fraction=0.2"]
    few += [f"--{stage}.trainer.{word}" for stage in ("skill", "policy") for word in ("max_steps=3", "accelerator=cpu")]
    assert call("run", arms, "--data=arrays:data", "--out=run", *few) == 0
    monkeypatch.setattr("dds_lightning.tasks._OWN", {})  # as in another process
    assert call("report", "run", "--task", arms) == 0
    monkeypatch.setattr("dds_lightning.tasks._OWN", {})
    assert call("publish", "run", "of-run", "--task", arms) == 0
    agent = DDSAgent.load("agent", seed=0)
    actions = np.concatenate([agent.act(episode["observations"]) for episode in episodes])
    assert ((actions >= low) & (actions <= high)).all()
    assert (actions[:, 1] > 1.0).any()  # not in the unit box
    capsys.readouterr()
    monkeypatch.setattr("dds_lightning.tasks._OWN", {})
    assert call("evaluate", "agent") == 2
    assert "which imports code: if that is your own, name its task file with --task" in told(capsys.readouterr().err)


def test_minari_sets_of_it_are_taken_without_an_environment_and_refused_with_a_way_out(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    import minari
    from minari.data_collector import EpisodeBuffer

    episodes = recordings()
    spaces = {"observation_space": Trolley.observation_space, "action_space": Trolley.action_space}
    for name, env in (("without", None), ("with", RAIL.env_id)):
        buffers = [EpisodeBuffer(id=i, **episode) for i, episode in enumerate(episodes)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that no author was given
            minari.create_dataset_from_buffers(f"trolley/{name}-v0", buffers, env=env, **spaces)
    assert load_trajectories("minari:trolley/without-v0").fingerprint() == made_of(episodes).fingerprint()
    monkeypatch.setattr("dds_lightning.tasks._OWN", {})
    with pytest.raises(DataError, match=r"'Trolley-v0', which no task uses; .* of your own, give its task with --task"):
        load_trajectories("minari:trolley/with-v0")
    for name in ("with", "without"):
        assert load_trajectories(f"minari:trolley/{name}-v0", RAIL).fingerprint() == made_of(episodes).fingerprint()


@pytest.mark.parametrize("keys", [["observation"], ["observation", "desired_goal"]])
def test_minari_sets_of_its_environment_are_flattened_as_its_task_file_says(tmp_path, monkeypatch, keys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    import minari
    from minari.data_collector import EpisodeBuffer

    address = tmp_path / "reach.yaml"
    address.write_text(
        f"env_id: FetchReach-v4\nmax_episode_steps: 20\nscore_min: -20\nscore_max: 0\nobservation_keys: {keys}\n"
    )
    task = get_task(str(address))
    env, plain, flat, buffers = task.make_env(), gym.make("FetchReach-v4"), [], []
    for number in range(2):
        seen, taken = [plain.reset(seed=number)[0]], plain.action_space.sample()
        flat.append(env.reset(seed=number)[0])
        for _ in range(20):
            seen.append(plain.step(taken)[0])
            flat.append(env.step(taken)[0])
        last = np.arange(20) == 19
        states = {key: np.stack([one[key] for one in seen]) for key in seen[0]}
        fields = {"rewards": -np.ones(20), "terminations": last & False, "truncations": last}
        buffers.append(EpisodeBuffer(id=number, observations=states, actions=np.stack([taken] * 20), **fields))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that no author was given
        minari.create_dataset_from_buffers("fetch/reach-v0", buffers, env="FetchReach-v4")
    data = load_trajectories("minari:fetch/reach-v0", task)
    assert data.lengths.tolist() == [20, 20]
    np.testing.assert_allclose(data.observations, np.stack(flat), atol=1e-6)
    with pytest.raises(
        DataError, match=r"its observation space is a Dict .*needs a Dict with observation, desired_goal"
    ):
        load_trajectories("minari:fetch/reach-v0", replace(task, observation_keys=("observation", "desired_goal", "z")))
