"""An exported file does what the agent does."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dds_lightning import examples
from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.sharing.export import (
    ActingGraph,
    check_exported,
    describe,
    example_inputs,
    export_agent,
    load_exported,
)
from dds_lightning.skill import SkillModule

K = 5
SHIPPED = Path(__file__).parents[2] / "checkpoints"
NEEDS_ONNX = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="needs the extra 'export'",
)
FORMATS = ["torch", pytest.param("onnx", marks=NEEDS_ONNX)]


def make_agent(decoder="diffusion", sampler="ddpm", fourier_features=0, **settings):
    torch.manual_seed(0)
    skill = SkillModule(
        4,
        2,
        horizon=5,
        num_skills=K,
        skill_dim=8,
        hidden_dim=16,
        encoder_layers=1,
        encoder_heads=2,
        decoder=decoder,
        sampler=sampler,
    )
    skill.normaliser.fit(torch.arange(4.0), torch.full((4,), 2.0))
    skill.action_box.fit(torch.tensor([-2.0, -1.0]), torch.tensor([3.0, 1.0]))
    skill.bottleneck.start_from(torch.randn(64, 8))
    policy = PolicyModule(4, K, hidden_dims=(16,), fourier_features=fourier_features)
    policy.normaliser.fit(torch.arange(4.0), torch.ones(4))
    policy.support_mask[1] = False
    return DDSAgent(skill, policy, **settings)


@pytest.fixture(scope="module", params=FORMATS)
def exported(request, tmp_path_factory):
    """An agent with every part that an exporter could trip over, and its file."""
    agent = make_agent(fourier_features=4, temperature=0.7, noise_scale=0.5)
    suffix = {"torch": "pt2", "onnx": "onnx"}[request.param]
    path = tmp_path_factory.mktemp("export") / f"agent.{suffix}"
    return agent, export_agent(agent, path, request.param, task="pointmaze-large-diverse")


def test_the_file_gives_the_agents_actions_and_codes_for_fixed_noise(exported):
    agent, path = exported
    found = check_exported(agent, path)
    assert found["difference"] <= 1e-5
    assert 0 < found["file_ms"]["median"] <= found["file_ms"]["p95"]


def test_the_file_and_the_agent_agree_where_the_agent_draws_its_own_noise(exported):
    agent, path = exported
    call, facts = load_exported(path)
    observations = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    codes = np.array([0, 3, 4])
    agent.reset(3, seed=11)
    with torch.inference_mode():
        acted = agent.decode(torch.from_numpy(observations), codes)
    stream = torch.Generator().manual_seed(11)
    noise = torch.stack([torch.randn((3, 2), generator=stream) for _ in range(facts["draws"])]).numpy()
    actions, in_use = call(observations, codes, np.zeros((3, K), np.float32), noise)
    np.testing.assert_allclose(actions, acted, atol=1e-5)
    np.testing.assert_array_equal(in_use, codes)


def test_gumbel_noise_samples_from_the_policy_at_its_temperature(exported):
    agent, path = exported
    call, _ = load_exported(path)
    count = 4000
    observation = np.tile(np.array([0.5, 1.0, 2.0, -3.0], np.float32), (count, 1))
    gumbel = np.random.default_rng(1).gumbel(size=(count, K)).astype(np.float32)
    _, codes = call(observation, np.full(count, -1), gumbel, np.zeros((agent.skill.draws, count, 2), np.float32))
    with torch.inference_mode():
        expected = (agent.policy.logits(torch.from_numpy(observation[:1])) / agent.temperature).softmax(-1)[0].numpy()
    np.testing.assert_allclose(np.bincount(codes, minlength=K) / count, expected, atol=4 * np.sqrt(0.25 / count))
    assert expected[1] == 0  # the data never use this code


def test_the_facts_in_the_file_are_enough_to_call_it(exported):
    agent, path = exported
    _, facts = load_exported(path)
    assert facts == describe(agent, "pointmaze-large-diverse")
    assert (facts["horizon"], facts["draws"], facts["noise_scale"], facts["temperature"]) == (5, 5, 0.5, 0.7)


@pytest.mark.parametrize(
    ("settings", "draws"),
    [({"sampler": "ddim"}, 1), ({"decoder": "mlp"}, 0), ({"selection": "argmax_q"}, 5), ({"selection": "greedy"}, 5)],
)
def test_every_decoder_and_way_of_choosing_can_be_traced(settings, draws, tmp_path):
    agent = make_agent(**settings)
    assert len(example_inputs(agent, 2)[3]) == draws
    path = export_agent(agent, tmp_path / "agent.pt2", "torch")
    assert check_exported(agent, path)["difference"] <= 1e-5


@NEEDS_ONNX
def test_it_is_compared_where_the_data_are_and_in_parts_of_the_actions_range(tmp_path):
    agent = make_agent()
    agent.skill.normaliser.fit(torch.tensor([0.0, 1e3, -5.0, 1.0]), torch.tensor([1e-3, 10.0, 1e-3, 4.0]))
    agent.policy.normaliser.fit(agent.skill.normaliser.mean, agent.skill.normaliser.std)
    agent.skill.action_box.fit(torch.tensor([-400.0, -1.0]), torch.tensor([600.0, 1.0]))
    seen = agent.skill.normaliser(example_inputs(agent, 500)[0])
    np.testing.assert_allclose(seen.mean(0), 0, atol=0.2)
    np.testing.assert_allclose(seen.std(0), 1, atol=0.2)
    assert check_exported(agent, export_agent(agent, tmp_path / "agent.onnx"))["difference"] <= 1e-5


@NEEDS_ONNX
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.parent.name for path in SHIPPED.glob("*/model.safetensors")))
def test_every_shipped_agent_exports(name, tmp_path):
    agent = DDSAgent.load(SHIPPED / name)
    assert check_exported(agent, export_agent(agent, tmp_path / "agent.onnx"))["difference"] <= 1e-5


def test_what_needs_no_policy_is_refused_and_nothing_is_written(tmp_path):
    agent = make_agent().variant("random")
    with pytest.raises(UserError, match=r"selection is 'random'.*sample, greedy or argmax_q"):
        export_agent(agent, tmp_path / "agent.onnx")
    with pytest.raises(UserError, match="format is 'tflite', expected one of torch, onnx"):
        export_agent(make_agent(), tmp_path / "agent.tflite", "tflite")
    for name, form in (("agent", "onnx"), ("agent.pt2", "onnx"), ("agent.onnx", "torch")):
        with pytest.raises(UserError, match=f"--out is .*{name}, expected .* for the format {form}"):
            export_agent(make_agent(), tmp_path / name, form)
        assert not (tmp_path / name).exists()
    assert not list(tmp_path.iterdir())


def test_damaged_and_missing_files_are_refused(exported, tmp_path):
    _, path = exported
    damaged = tmp_path / path.name
    damaged.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match="is not an exported agent, or damaged"):
        load_exported(damaged)
    with pytest.raises(UserError, match=r"there is no file .*`dds export`"):
        load_exported(tmp_path / "nothing.onnx")


def test_an_agent_that_changed_since_is_noticed(exported, tmp_path):
    agent, path = exported
    other = DDSAgent(make_agent(fourier_features=4).skill, agent.policy, temperature=0.7, noise_scale=0.6)
    with pytest.raises(UserError, match="actions differ from the agent's by"):
        check_exported(other, path)


def test_the_graph_is_the_agent_in_training_mode_too(tmp_path):
    agent = make_agent()
    agent.skill.train()
    assert not ActingGraph(agent).skill.training


@NEEDS_ONNX
def test_the_example_reaches_the_goal_without_torch(tmp_path):
    agent = DDSAgent.load(SHIPPED / "pointmaze-large")
    path = export_agent(agent, tmp_path / "agent.onnx")
    script = Path(examples.__file__).parent / "act_with_onnx.py"
    # `-X importtime` would be long: a path hook that refuses torch is shorter and stricter.
    program = (
        "import sys, runpy\n"
        "sys.modules['torch'] = None\n"
        f"sys.argv = ['act', {str(path)!r}]\n"
        f"runpy.run_path({str(script)!r})\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "reached the goal in" in done.stdout
    assert "did not" not in done.stdout
