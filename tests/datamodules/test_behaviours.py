"""Behaviour policies: the NumPy actor, the Ant's frames, and training."""

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from datamodules.behaviours import AntController, MLPPolicy, load_ladder
from datamodules.behaviours.ant import ANKLE_SIGN, motor_actions, see
from datamodules.validation import DataError
from dds_lightning.envs.antmaze import TORQUE, D4RLAntMazeEnv
from dds_lightning.errors import UserError


def small_policy(output="clip", activation="tanh", seed=0):
    rng = np.random.default_rng(seed)
    sizes = (5, 16, 16, 3)
    pairs = list(pairwise(sizes))
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    return MLPPolicy(
        weights=tuple(draw(i, o) / np.float32(i**0.5) for i, o in pairs),
        biases=tuple(draw(o) for _, o in pairs),
        mean=draw(5),
        std=np.exp(draw(5)),
        log_std=draw(3) - 1,
        activation=activation,
        output=output,
        metadata={"steps": 7},
    )


# ---------------------------------------------------------------------- the actor


@pytest.mark.parametrize(("output", "activation"), [("clip", "tanh"), ("tanh", "relu")])
def test_actor_equals_the_torch_network(output, activation):
    policy = small_policy(output, activation)
    layers = []
    for weight, bias in zip(policy.weights, policy.biases, strict=True):
        layer = torch.nn.Linear(*weight.shape)
        layer.weight.data, layer.bias.data = torch.from_numpy(weight.T.copy()), torch.from_numpy(bias)
        layers += [layer, torch.nn.Tanh() if activation == "tanh" else torch.nn.ReLU()]
    network = torch.nn.Sequential(*layers[:-1])
    observations = np.random.default_rng(1).normal(size=(200, 5)).astype(np.float32) * 3
    x = torch.from_numpy((observations - policy.mean) / policy.std).clamp(-10, 10)
    out = network(x)
    expected = (out.clamp(-1, 1) if output == "clip" else out.tanh()).detach().numpy()
    actions = policy.act(observations)
    assert actions.shape == (200, 3)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions, expected, atol=1e-6)
    np.testing.assert_allclose(policy.act(observations[0]), expected[0], atol=1e-6)


def test_sampled_actions_have_the_policys_deviation():
    policy = replace(small_policy(), biases=(*small_policy().biases[:2], np.zeros(3, np.float32)))
    policy = replace(policy, weights=(*policy.weights[:2], np.zeros((16, 3), np.float32)))
    actions = policy.act(np.zeros((20_000, 5)), np.random.default_rng(0))
    inside = np.exp(policy.log_std) < 0.3  # where clipping hardly matters
    assert inside.any()
    np.testing.assert_allclose(actions.std(axis=0)[inside], np.exp(policy.log_std)[inside], rtol=0.03)


def test_a_saved_actor_comes_back(tmp_path):
    policy = small_policy("tanh", "relu")
    again = MLPPolicy.load(policy.save(tmp_path / "p.safetensors"))
    observations = np.random.default_rng(1).normal(size=(10, 5))
    np.testing.assert_array_equal(again.act(observations), policy.act(observations))
    assert again.metadata == {"steps": 7}
    assert (again.output, again.activation) == ("tanh", "relu")


def spoiled(tmp_path, change):
    path = small_policy().save(tmp_path / "p.safetensors")
    arrays = load_file(path)
    header = {"format": "1", "activation": "tanh", "output": "clip", "metadata": "{}"}
    change(arrays, header)
    save_file(arrays, path, metadata=header)
    return path


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays, header: arrays.pop("mean"),
        lambda arrays, header: arrays.pop("layers.1.bias"),
        lambda arrays, header: arrays.update({"layers.1.weight": np.zeros((3, 4), np.float32)}),
        lambda arrays, header: arrays.update(mean=np.full(5, np.nan, np.float32)),
        lambda arrays, header: arrays.update(std=np.zeros(5, np.float32)),
        lambda arrays, header: arrays.update(log_std=np.zeros(2, np.float32)),
        lambda arrays, header: header.update(output="exec"),
        lambda arrays, header: header.update(format="9"),
        lambda arrays, header: header.update(metadata="{"),
        lambda arrays, header: header.pop("activation"),
    ],
)
def test_a_spoiled_actor_is_refused_in_one_sentence(tmp_path, change):
    with pytest.raises(DataError, match=r"behaviour policy .*p\.safetensors") as caught:
        MLPPolicy.load(spoiled(tmp_path, change))
    assert "\n" not in str(caught.value)


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="missing or damaged"):
        MLPPolicy.load(tmp_path / "nothing.safetensors")
    (tmp_path / "text.safetensors").write_text("hello", encoding="utf-8")
    with pytest.raises(DataError, match="missing or damaged"):
        MLPPolicy.load(tmp_path / "text.safetensors")
    with pytest.raises(UserError, match="expected one of d4rl, robotics"):
        AntController("moon", tmp_path)
    with pytest.raises(UserError, match="holds no policies"):
        load_ladder("hopper", tmp_path)


def test_acting_needs_no_torch():
    code = "import sys, datamodules.behaviours.ant; assert 'torch' not in sys.modules, 'torch was imported'"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------------- the Ant's frames


@pytest.fixture(scope="module")
def ant():
    env = D4RLAntMazeEnv(("0",), (0, 0), (0, 0))
    yield env
    env.close()


def about_z(angle):
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def times(a, b):
    w, v, x, u = a[0], a[1:], b[0], b[1:]
    return np.concatenate([[w * x - v @ u], w * u + x * v + np.cross(v, u)])


def plane(vector, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def same_ant(state, turn, quarters):
    """The same body in a world turned by `turn`, its legs numbered from `quarters` on."""
    state, legs = state.copy(), (np.arange(4) + quarters) % 4
    signs = ANKLE_SIGN[legs] * ANKLE_SIGN
    for at in (7, 21):
        block = state[at : at + 8].reshape(4, 2)[legs]
        state[at : at + 8] = np.stack([block[:, 0], block[:, 1] * signs], axis=1).ravel()
    state[3:7] = times(about_z(turn), times(state[3:7], about_z(quarters * np.pi / 2)))
    state[18:20] = plane(state[18:20], -quarters * np.pi / 2)
    state[:2], state[15:17] = plane(state[:2], turn), plane(state[15:17], turn)
    return state


def walk(env, state, heading, weights, steps=5):
    """What is seen on the way under some fixed feedback."""
    env.set_state(state[:15], state[15:])
    seen = []
    for _ in range(steps):
        features, turns = see(np.concatenate([env.data.qpos, env.data.qvel])[None], np.array([heading]))
        seen.append(features[0])
        env.do_simulation(TORQUE * motor_actions(np.tanh(features @ weights), turns)[0], env.frame_skip)
    return np.array(seen)


@pytest.mark.parametrize(("turn", "quarters"), [(1.0, 0), (2.5, 1), (-1.3, 2), (0.4, 3)])
def test_turned_and_renumbered_ants_walk_alike(ant, turn, quarters):
    rng = np.random.default_rng(0)
    state = np.concatenate([ant.init_qpos + rng.uniform(-0.1, 0.1, 15), rng.normal(size=14)])
    state[3:7] /= np.linalg.norm(state[3:7])
    weights = rng.normal(size=(28, 8)) * 0.3
    expected = walk(ant, state, 0.3, weights)
    found = walk(ant, same_ant(state, turn, quarters), 0.3 + turn, weights)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_motors_and_joints_are_in_the_simulators_order(ant):
    model = ant.model
    joints = [model.joint(model.actuator(i).trnid[0]).name for i in range(8)]
    order = [model.joint(i).name for i in range(1, 9)]
    marks = np.arange(1.0, 9.0)  # hips 1 to 4, ankles 5 to 8
    motors = motor_actions(marks[None], np.array([0]))[0]
    for name, value in zip(joints, motors, strict=True):
        kind, leg = name.split("_")
        assert value == {"hip": int(leg), "ankle": 4 + int(leg)}[kind]
    assert order == [f"{kind}_{leg}" for leg in range(1, 5) for kind in ("hip", "ankle")]


def test_heading_is_seen_within_45_degrees_and_speed_in_the_yaw_frame(ant):
    state = np.concatenate([ant.init_qpos, np.zeros(14)])
    state[3:7] = about_z(0.2)
    state[15:17] = [np.cos(1.0), np.sin(1.0)]  # moves along 1.0 rad
    states = np.repeat(state[None], 100, axis=0)
    headings = np.linspace(-np.pi, np.pi, 100)
    features, turns = see(states, headings)
    assert features[:, -2].min() >= np.cos(np.pi / 4) - 1e-9
    assert set(turns) == {0, 1, 2, 3}
    error = np.arctan2(features[:, -1], features[:, -2])
    moving = np.arctan2(features[:, 13], features[:, 12])
    np.testing.assert_allclose(np.cos(moving - error), np.cos(1.0 - headings), atol=1e-9)
    np.testing.assert_allclose(features[:, 1:4], [[0.0, 0.0, -1.0]] * 100, atol=1e-12)


# ---------------------------------------------------------------------- training


def tiny(name):
    from datamodules.behaviours.training.recipes import get_recipe

    recipe = get_recipe(name)
    return replace(recipe, environments=2, steps=256, settings={**recipe.settings, "n_steps": 64}, coarse_steps=128)


def test_the_exported_actor_equals_the_learners():
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.learner import build_learner, export_policy

    learner = build_learner(tiny("hopper"), seed=0)
    learner.learn(128)
    world = learner.get_vec_normalize_env()
    raw = world.get_original_obs()
    expected, _ = learner.predict(world.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(export_policy(learner, {}).act(raw), np.clip(expected, -1, 1), atol=1e-6)


def test_runners_differ_from_each_other_and_repeat_with_the_seed():
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.learner import build_world

    first, again, other = (build_world(tiny("hopper"), seed).reset() for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[0] - first[1]).max() > 1e-5
    assert np.abs(first - other).max() > 1e-5


def test_the_first_steps_are_coarse_in_every_environment(tmp_path):
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.learner import build_learner
    from datamodules.behaviours.training.train import EULER, Bookkeeper

    recipe = tiny("hopper")
    book = Bookkeeper(recipe, build_learner(recipe, seed=0), tmp_path, hours=0.0)
    true = book.integrator
    assert true != EULER
    for steps, expected in ((0, EULER), (127, EULER), (128, true)):
        book.num_timesteps = steps
        book._on_rollout_start()
        assert [model.opt.integrator for model in book.models] == [expected] * 2
    assert book.models[0] is not book.models[1]


@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_training_leaves_snapshots_and_goes_on(tmp_path, name):
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.train import train

    recipe = replace(tiny(name), rungs=2)
    assert train(recipe, tmp_path / "run") == 256
    with pytest.raises(UserError, match="not empty; add --resume"):
        train(recipe, tmp_path / "run")
    assert train(replace(recipe, steps=384), tmp_path / "run", resume=True) == 384
    paths = sorted((tmp_path / "run" / "snapshots").glob("*.safetensors"))
    assert [MLPPolicy.load(path).metadata["steps"] for path in paths] == [0, 128, 256, 384]
    first, last = MLPPolicy.load(paths[0]), MLPPolicy.load(paths[-1])
    assert np.abs(first.weights[0] - last.weights[0]).max() > 1e-4


def test_resuming_restores_every_number(tmp_path):
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.learner import build_learner, load_state, save_state

    recipe = tiny("hopper")
    learner = build_learner(recipe, seed=0)
    learner.learn(256)
    save_state(learner, tmp_path / "state.pt", {"hours": 1.5})
    again = build_learner(recipe, seed=1)
    assert load_state(again, tmp_path / "state.pt") == {"hours": 1.5}
    for mine, theirs in zip(again.policy.parameters(), learner.policy.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    mine, theirs = (one.policy.optimizer.state_dict()["state"] for one in (again, learner))
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[i][name], theirs[i][name]) for i in mine for name in ("exp_avg", "exp_avg_sq", "step"))
    assert again.num_timesteps == 256
    world, other = again.get_vec_normalize_env(), learner.get_vec_normalize_env()
    np.testing.assert_array_equal(world.obs_rms.var, other.obs_rms.var)
    assert world.ret_rms.count == other.ret_rms.count
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    del state["optimizer"]
    torch.save(state, tmp_path / "state.pt")
    with pytest.raises(UserError, match="an earlier version wrote it"):
        load_state(again, tmp_path / "state.pt")


@pytest.mark.parametrize("command", ["train", "publish"])
def test_the_documented_commands_run(command):
    if command == "train":
        pytest.importorskip("stable_baselines3")
    module = f"datamodules.behaviours.{command}"
    ran = subprocess.run([sys.executable, "-m", module, "--help"], capture_output=True, text=True, check=True)
    assert ran.stdout.startswith(f"usage: python -m {module} ")


def test_rungs_spread_over_the_scores():
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.publish import choose_rungs

    scores = [1.0, 5.0, 30.0, 20.0, 52.0, 80.0, 100.0, 70.0]
    assert choose_rungs(scores, 5) == [0, 2, 4, 5, 6]
    assert choose_rungs([3.0], 5) == [0]


def test_a_resting_ant_neither_moves_nor_falls():
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.evaluation import score_walker

    score = score_walker(lambda seen: np.zeros((len(seen), 8)), "d4rl", ants=2, steps=60)
    assert abs(score.speed) < 0.2
    assert score.falls_per_1000 == 0
    assert score.steps == 120


def test_speed_beyond_the_cruise_earns_nothing():
    pytest.importorskip("stable_baselines3")
    from datamodules.behaviours.training.ant_world import AntWorld, calm

    rewards = {}
    for cruise in (np.inf, 0.05):
        world = AntWorld("d4rl", 4, replace(calm("d4rl"), cruise=cruise), seed=1)
        world.reset()
        world.step_async(np.full((4, 8), 0.5, np.float32))
        rewards[cruise] = world.step_wait()[1]
    beyond = np.maximum(world.speed - 0.05, 0.0)
    assert (beyond > 0).any()
    np.testing.assert_allclose(rewards[np.inf] - rewards[0.05], beyond, atol=1e-6)
