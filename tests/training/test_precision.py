"""The measured choice of a precision, and who overrules it."""

import pytest

from dds_lightning.nn.precision import Choice
from dds_lightning.training import precision
from dds_lightning.training.stage_cli import StageCLI
from tests.fits import QUIET, SKILL, call, of_data, told


@pytest.mark.parametrize(
    ("words", "used"),
    [
        (["--precision=auto"], "bf16-mixed"),
        (["--precision=auto", "--trainer.precision=32-true"], "32-true"),
        ([], "32-true"),
        (["--config", "pointmaze/skill.yaml"], "bf16-mixed"),
    ],
)
def test_a_measured_precision_is_used_unless_one_is_given(words, used, monkeypatch, tmp_path, data):
    monkeypatch.setattr(precision, "fastest_precision", lambda use_gpu: Choice("bf16-mixed", 2.0))
    made = StageCLI("skill", ["fit", *words, *data, *SKILL, *QUIET, f"--trainer.default_root_dir={tmp_path}"]).build()
    assert made.trainer.precision == used


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


def test_a_training_goes_on_in_the_precision_that_it_began_with(monkeypatch, tmp_path, data, capsys):
    """On another machine the measurement may say something else."""
    common = ["skill", "fit", "--precision=auto", *data, *SKILL, *QUIET, f"--checkpoint.dirpath={tmp_path}"]
    common.append(f"--trainer.default_root_dir={tmp_path}")
    monkeypatch.setattr(precision, "fastest_precision", lambda use_gpu: Choice("bf16-mixed", 2.0))
    assert call(*common, "--trainer.max_steps=2") == 0
    assert "precision: bf16-mixed (bfloat16 is 2.0 times as fast as float32 here)" in capsys.readouterr().err
    monkeypatch.setattr(precision, "fastest_precision", lambda use_gpu: Choice("32-true", 0.5))
    resumed = [*common[1:], f"--ckpt_path={tmp_path}/last.ckpt", "--trainer.max_steps=4"]
    assert StageCLI("skill", resumed).build().trainer.precision == "bf16-mixed"
    assert call("skill", *resumed, "--trainer.precision=32-true") == 2
    assert "was trained with 'bf16-mixed'" in told(capsys.readouterr().err)
