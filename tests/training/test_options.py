"""What the sources say about a stage's options is what the real parser, which imports everything, has."""

import pytest

from dds_lightning.training.options import FLAGS, GENERAL, METHODS, help_of, options
from dds_lightning.training.source import parameters_of
from dds_lightning.training.stage_cli import StageCLI
from dds_lightning.training.stages import STAGES


@pytest.mark.parametrize("stage", STAGES)
def test_the_options_are_those_of_the_parser(stage):
    cli = StageCLI(stage, ["fit"], parse_only=True)
    found = {action.dest for action in cli._parser("fit")._actions if "." in action.dest or action.dest in GENERAL}
    found = {name for name in found if not name.endswith(".help")} - set(METHODS)
    found -= {f"model.{name}" for name in STAGES[stage].links}
    known = {name for name in options(STAGES[stage]) if name not in FLAGS}
    assert found - set(FLAGS) == known


@pytest.mark.parametrize("stage", STAGES)
def test_the_defaults_are_those_of_the_parser(stage):
    real = StageCLI(stage, ["fit"], parse_only=True).settings
    for name, one in options(STAGES[stage]).items():
        if name.startswith("model.") and isinstance(one.default, int | float | str):
            assert real[name] == one.default, name


def test_keywords_that_are_passed_on_are_found_in_the_class_that_takes_them():
    found = parameters_of("datamodules.relabelled:RelabeledDataModule")
    assert found["gamma"].default == 0.99
    assert found["stride"].annotation is int
    assert found["reward_scale"].text


def test_the_help_is_short_and_ours_comes_first():
    text = help_of("skill", ["fit", "--help"])
    assert text.index("--model.num_skills") < text.index("--data.horizon") < text.index("--trainer.max_steps")
    assert "--trainer.gradient_clip_val" not in text
    assert "at least 2" in text
    assert "--trainer.gradient_clip_val" in help_of("skill", ["fit", "--help", "trainer"])
    assert help_of("skill", ["fit", "--model.lr=1"]) is None
