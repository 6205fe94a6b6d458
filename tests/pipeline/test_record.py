"""What a run was asked for is the default of a later call in its folder; what could run code is not."""

import json

import pytest

from dds_lightning.errors import UserError
from dds_lightning.pipeline.record import RECORD, keep, recall
from dds_lightning.pipeline.settings import RunSettings

TASK = "pointmaze-umaze-diverse"
NOTHING = {"seed": None, "episodes": None, "temperature": None, "seeds": None}


def kept(out, seeds=None, **asked):
    keep(RunSettings.with_preset(TASK, out, **asked), seeds)


def test_settings_left_out_are_those_of_the_earlier_call_and_are_told(tmp_path, capsys):
    kept(tmp_path, seed=3, episodes=7, stages={"skill": ("--trainer.max_steps=5", "--model.lr=1e-4")}, seeds=2)
    found, words = recall(tmp_path, TASK, {**NOTHING, "episodes": 9}, {"skill": ["--model.lr=2e-4"]})
    assert found == {**NOTHING, "seed": 3, "episodes": 9, "seeds": 2}
    assert words["skill"] == ["--trainer.max_steps=5", "--model.lr=2e-4"]
    assert "as in the earlier call: --seed=3 --seeds=2 --skill.trainer.max_steps=5 (what you" in capsys.readouterr().err


def test_the_same_words_again_are_the_same_words(tmp_path, capsys):
    given = ("--trainer.callbacks+=EarlyStopping", "--trainer.callbacks.monitor=val/loss", "--trainer.max_steps=5")
    kept(tmp_path, stages={"skill": given})
    assert recall(tmp_path, TASK, {**NOTHING, "seed": 0}, {"skill": given})[1]["skill"] == list(given)
    assert capsys.readouterr().err == ""
    fewer = recall(tmp_path, TASK, NOTHING, {"skill": ["--trainer.callbacks+=Timer"]})[1]["skill"]
    assert fewer == ["--trainer.max_steps=5", "--trainer.callbacks+=Timer"]


@pytest.mark.parametrize(
    "word",
    [
        "--config=skill.yaml",
        "--trainer.callbacks+=somebodys.module.Callback",
        '--trainer.callbacks+={"class_path": "evil"}',
        "--model.init_from=elsewhere/last.ckpt",
    ],
)
def test_what_may_name_code_has_to_be_typed_again(tmp_path, word):
    kept(tmp_path, stages={"skill": (word,)})
    with pytest.raises(UserError, match="not taken from a file: type it again, or give another --out"):
        recall(tmp_path, TASK, NOTHING, {})
    assert recall(tmp_path, TASK, NOTHING, {"skill": [word]})[1]["skill"] == [word]


def test_a_folder_as_preset_has_to_be_typed_again_too(tmp_path):
    (tmp_path / RECORD).write_text(json.dumps({"task": TASK, "settings": {"preset": "theirs"}, "stages": {}}))
    with pytest.raises(UserError, match="was made with --preset=theirs, which may name code"):
        recall(tmp_path, TASK, {**NOTHING, "preset": None}, {})


def test_another_tasks_record_and_a_folder_without_one_change_nothing(tmp_path, capsys):
    assert recall(tmp_path, TASK, NOTHING, {}) == (NOTHING, {})
    kept(tmp_path, seed=3)
    assert recall(tmp_path, "hopper-medium", NOTHING, {}) == (NOTHING, {})
    assert capsys.readouterr().err == ""
