"""Baselines on the command line: they train and resume like any stage, and play by `dds evaluate`."""

import pytest
import torch

from tests.fits import QUIET, TASK, call, of_data, skill_of, told

SMALL = ["--model.hidden_dims=[8]", "--model.hidden_dim=8", "--model.blocks=1"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


def fit(name, data, out, steps, *words):
    places = [f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}", f"--trainer.max_steps={steps}"]
    assert call(name, "fit", "--config", f"{name}.yaml", *data, *QUIET, *places, *words) == 0
    return out / "last.ckpt"


@pytest.fixture(scope="module")
def idql(data, tmp_path_factory):
    return fit("idql", data, tmp_path_factory.mktemp("idql"), 6, *SMALL)


def test_a_training_that_stopped_goes_on_bit_for_bit(idql, data, tmp_path):
    words = [*SMALL, "--model.lr_schedule=constant"]  # a cosine would end elsewhere
    stopped = fit("idql", data, tmp_path, 3, *words)
    resumed = fit("idql", data, tmp_path, 6, *words, f"--ckpt_path={stopped}")
    through = fit("idql", data, tmp_path / "through", 6, *words)
    states = [torch.load(path, weights_only=True)["state_dict"] for path in (resumed, through)]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


def test_a_baseline_plays_in_the_task_that_it_was_trained_for(dds, idql, tmp_path):
    words = ["evaluate", "--policy", idql, "--episodes", 2, "--workers", 0]
    answer = dds(*words, "--out", tmp_path / "episodes.parquet", "--json").json
    (row,) = answer["results"]
    assert (row["actor"], row["episodes"], row["checkpoint"]) == ("IDQL", 2, "last")
    assert (answer["task"], answer["protocol"]["method"], answer["agent"]) == (TASK, "idql", str(idql))
    assert (tmp_path / "episodes.parquet").is_file()
    assert dds(*words, "--json").json["results"] == answer["results"]  # the same seed, the same episodes


def test_one_over_continuous_skills_plays_with_them(dds, data, tmp_path):
    skill = skill_of(data, tmp_path / "skill", 3, "--model.bottleneck=gaussian")
    policy = fit("opal", data, tmp_path / "opal", 3, "--model.hidden_dims=[8]", f"--data.skill={skill}")
    words = ["evaluate", "--policy", policy, "--episodes", 1, "--workers", 0]
    answer = dds(*words, "--skill", skill, "--json").json
    assert [row["actor"] for row in answer["results"]] == ["OPAL"]
    assert answer["protocol"]["horizon"] == 5
    acting = ["--noise_scale", "0.5", "--hold", "2", "--selection", "sample", "--temperature", "0.7"]
    protocol = dds(*words, "--skill", skill, *acting, "--json").json["protocol"]
    assert (protocol["noise_scale"], protocol["horizon"], protocol["temperature"]) == (0.5, 2, 0.7)
    refused = dds(*words, "--skill", skill, "--hold", 6)
    assert refused.status == 2
    assert "hold is 6, expected 1 to 5" in told(refused.err)
    refused = dds(*words, "--skill", skill, "--selection", "argmax_q")
    assert refused.status == 2
    assert "'argmax_q', which needs codes, but the skills are cont" in told(refused.err)
    refused = dds(*words)
    assert refused.status == 2
    assert "OPAL plays with checkpoints of skill, opal: skill is missing" in told(refused.err)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--temperature", "0.5"], "--temperature is 0.5, which IDQL has no use for: leave it out"),
        (["--skill", "x.ckpt"], "--skill is x.ckpt, but IDQL has no skills: leave it out"),
        (["--task", "hopper-medium"], "has observation_dim 4, task hopper-medium has 11"),
        (["--episodes", "0"], "--episodes is 0, expected at least 1"),
    ],
)
def test_what_does_not_apply_is_refused(dds, idql, words, sentence):
    answer = dds("evaluate", "--policy", idql, *words)
    assert answer.status == 2
    assert sentence in told(answer.err)
