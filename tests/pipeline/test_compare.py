"""`dds online compare`: a row for each variant, one figure, and nothing done twice."""

import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from dds_lightning.interpret.draw.online import on_one_grid
from dds_lightning.pipeline.compare import Comparison
from tests.fits import POLICY, QUIET, TASK, call, of_data, skill_of, told

TINY = ["--data.batch_size=16", "--data.random_steps=60", "--data.num_envs=2", "--data.updates=0.1"]
TINY += ["--model.hidden_dims=[16]", "--trainer.log_every_n_steps=2", "--trainer.enable_progress_bar=false"]


@pytest.mark.slow
def test_variants_are_trained_once_and_compared(dds, tmp_path):
    data = of_data(tmp_path / "data")
    discrete = skill_of(data, tmp_path / "discrete", 1)
    gaussian = skill_of(data, tmp_path / "gaussian", 1, "--model.bottleneck=gaussian")
    (spec,) = [word.partition("=")[2] for word in data if word.startswith("--data.data=")]
    words = ["online", "compare", TASK, "--skill", discrete, "--gaussian", gaussian, "--data", spec, "--seeds=2"]
    words += ["--env_steps=700", "--episodes=1", "--workers=0", "--out", tmp_path / "out", "--json"]
    words += [f"--set+={word}" for word in TINY]
    answer = dds(*words)
    assert answer.status == 0, answer.err
    variants = ["discrete skills", "continuous skills", "raw actions", "discrete skills, prior data"]
    assert [row["variant"] for row in answer.json["table"]] == variants
    for row in answer.json["table"]:
        assert row["seeds"] == 2
        assert 600 <= row["env_steps"] <= 800
        assert 0 <= row["success"] <= 100
        assert row["cells"] >= 1
    assert (tmp_path / "out" / "comparison.png").stat().st_size > 10_000
    assert (tmp_path / "out" / "raw-actions" / "1-played" / "agent" / "model.safetensors").is_file()
    (tmp_path / "out" / "raw-actions" / "1" / "curve.csv").unlink()
    again = dds(*words)
    assert again.json["table"] == answer.json["table"]
    assert again.err.count("done before") == 7 + 8  # made again bit for bit, so it need not play again
    other = dds(*[word for word in words if word not in ("--gaussian", gaussian)], "--episodes=2")
    assert other.status == 0, other.err
    assert other.err.count("done before") == 6  # nothing is trained again for other files or more episodes


def test_too_few_steps_are_refused_before_anything_is_made(dds, tmp_path):
    answer = dds("online", "compare", TASK, "--env_steps=10", "--out", tmp_path / "out")
    assert answer.status == 2
    assert "--env_steps is 10, expected more than data.random_steps 4000" in told(answer.err)
    assert not (tmp_path / "out").exists()


def test_variants_are_those_whose_files_are_given_or_that_are_named():
    files = {"skill": "s", "data": "local:d", "policy": "p"}
    asked = Comparison(TASK, Path("out"), **files)
    named = replace(asked, chosen=("offline", "prior"))
    assert list(asked.variants()) == [
        "discrete skills",
        "raw actions",
        "discrete skills, prior data",
        "offline to online",
    ]
    assert list(named.variants()) == ["discrete skills, prior data", "offline to online"]
    assert "--model.offline=p" in named.variants()["offline to online"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            "--variants prio",
            "--variants has prio, expected some of discrete, continuous, raw, prior, offline: did",
        ),
        ("--variants [raw,continuous]", "--variants has continuous, which needs --gaussian too"),
        ("--variants offline --skill s", "--variants has offline, which needs --data and --policy too"),
    ],
)
def test_a_variant_that_cannot_be_is_refused(dds, tmp_path, words, sentence):
    answer = dds("online", "compare", TASK, *words.split(), "--out", tmp_path / "out")
    assert answer.status == 2
    assert sentence in told(answer.err)
    assert not (tmp_path / "out").exists()


def test_skills_of_the_wrong_kind_are_refused_before_the_first_training(dds, tmp_path):
    gaussian = skill_of(of_data(tmp_path / "data"), tmp_path / "gaussian", 1, "--model.bottleneck=gaussian")
    answer = dds("online", "compare", TASK, "--skill", gaussian, "--out", tmp_path / "out")
    assert answer.status == 2
    assert "whose skills are continuous, expected discrete: give it as --gaussian" in told(answer.err)
    assert not (tmp_path / "out").exists()


def test_an_offline_policy_with_other_networks_is_refused_before_the_first_training(dds, tmp_path):
    data = of_data(tmp_path / "data")
    skill = skill_of(data, tmp_path / "skill", 1)
    fit = ["policy", "fit", *data, *QUIET, *POLICY, f"--data.skill={skill}", "--trainer.max_steps=1"]
    assert call(*fit, f"--checkpoint.dirpath={tmp_path}", f"--trainer.default_root_dir={tmp_path}") == 0
    (spec,) = [word.partition("=")[2] for word in data if word.startswith("--data.data=")]
    files = ["--skill", skill, "--data", spec, "--policy", tmp_path / "last.ckpt"]
    answer = dds("online", "compare", TASK, *files, "--out", tmp_path / "out")
    assert answer.status == 2
    assert re.search(r"model.hidden_dims is \[256, 256\], but the policy in .* has \[16\]: give", told(answer.err))
    assert not (tmp_path / "out").exists()


def test_curves_are_compared_where_every_seed_has_a_value():
    one = pd.DataFrame({"env_steps": [0, 100, 200], "success": [0.0, 10.0, 20.0]})
    two = pd.DataFrame({"env_steps": [50, 150], "success": [50.0, 50.0]})
    steps, values = on_one_grid([one, two], "success")
    assert (steps[0], steps[-1]) == (50, 150)
    assert values[:, 0].tolist() == pytest.approx([5.0, 50.0])
    assert values[:, -1].tolist() == pytest.approx([15.0, 50.0])
