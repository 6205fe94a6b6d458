"""A stage is a file and a row: it gets a command line, exact resuming, checkpoints, publishing, fine-tuning, a step."""

import json

import pandas as pd
import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.pipeline.steps import STEPS, training_step
from dds_lightning.saving.checkpoint import stage_of
from dds_lightning.saving.published import load_published, publish
from dds_lightning.training.stages import STAGES, Stage, get_stage
from tests.fits import QUIET, TASK, of_data, told
from tests.training.toy_stage import Forward

ROW = Stage(
    name="forward",
    description="Predict the next observation.",
    module="tests.training.toy_stage:Forward",
    data="datamodules.segments:SegmentDataModule",
    links=("observation_dim",),
    steps=100,
    widths="model.none",
)


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(STAGES, ROW.name, ROW)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


def weights(path):
    return torch.load(path, weights_only=True)["state_dict"]


def fit(dds, data, out, steps, *more):
    places = [f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}"]
    answer = dds("forward", "fit", *data, *QUIET, *places, "--data.horizon=5", f"--trainer.max_steps={steps}", *more)
    assert answer.status == 0, answer.err
    return out / "last.ckpt"


def test_the_registry_names_modules_that_say_the_same():
    for name, stage in STAGES.items():
        assert stage.module_class().STAGE == name == stage.name
        assert stage.links
        assert "." in stage.widths
    with pytest.raises(UserError, match="stage is 'skil', expected one of skill, policy, clone"):
        get_stage("skil")


def test_a_new_stage_trains_resumes_and_predicts_on_the_command_line(dds, data, tmp_path):
    assert "Predict the next observation" in " ".join(dds("--help").out.split())
    through = fit(dds, data, tmp_path / "through", 30)
    stopped = fit(dds, data, tmp_path / "stopped", 12)
    resumed = fit(dds, data, tmp_path / "stopped", 30, f"--ckpt_path={stopped}")
    assert all(torch.equal(value, weights(resumed)[name]) for name, value in weights(through).items())
    assert stage_of(torch.load(through, weights_only=True)) == "forward"
    answer = dds("forward", "predict", *data, *QUIET, "--data.horizon=5", f"--ckpt_path={through}", "--json")
    assert list(pd.read_parquet(answer.json["file"])) == [f"next {j}" for j in range(4)]


def test_a_checkpoint_of_a_new_stage_is_no_other_stages(dds, data, tmp_path):
    checkpoint = fit(dds, data, tmp_path, 2)
    answer = dds("skill", "fit", *data, *QUIET, f"--ckpt_path={checkpoint}")
    assert answer.status == 2
    assert "is a checkpoint of stage forward, expected skill" in told(answer.err)


def test_a_new_stage_is_published_and_starts_another_training(dds, data, tmp_path):
    checkpoint = fit(dds, data, tmp_path / "first", 5)
    module = Forward.load(checkpoint)
    place = publish(tmp_path / "published", {module.STAGE: module}, {"task": TASK})
    again = load_published(place).module(Forward, "forward")
    verified = dds("checkpoints", "verify", place)
    assert f"is sound: task {TASK}, 20 parameters, a forward model" in " ".join(verified.out.split()), verified.err
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in module.state_dict().items())
    tuned = fit(dds, data, tmp_path / "second", 1, f"--model.init_from={place}", "--model.lr=1e-9")
    change = weights(tuned)["net.weight"] - module.net.weight
    assert 0 < change.abs().max() < 1e-8


@pytest.fixture
def steps():
    """The steps of a run, in their order again afterwards."""
    before = dict(STEPS)
    yield STEPS
    STEPS.clear()
    STEPS.update(before)


def test_a_new_stage_is_a_step_of_a_run(dds, tmp_path, steps):
    step = training_step("forward", ("data",), lambda run, settings: f"forward: {settings['trainer']['max_steps']}")
    for name in list(steps)[1:]:
        del steps[name]
    steps["forward"] = step
    words = ["run", TASK, "--out", tmp_path / "run", "--data_steps=2000", "--workers=1", "--json"]
    words += ["--forward.trainer.max_steps=3", "--forward.data.batch_size", 32, "--forward.trainer.accelerator=cpu"]
    words += [
        "--forward.data.horizon=5",
        "--forward.model.lr_schedule=constant",
    ]
    answer = dds(*words)
    assert answer.status == 0, answer.err
    assert json.loads((tmp_path / "run" / "forward" / "stage.json").read_text())["state"] == "finished"
    assert dds(*words).json["done_before"] == ["data", "forward"]


@pytest.mark.parametrize(("stage", "setting"), [("policy", "tau"), ("skill", "horizon"), ("clone", "action_dim")])
def test_checkpoints_of_before_stages_were_stored_are_known_by_a_setting(stage, setting):
    settings = {"observation_dim": 3, "action_dim": 2, "lr": 0.1} | {setting: 1}
    assert stage_of({"hyper_parameters": settings}) == stage
    assert stage_of({"hyper_parameters": settings, "stage": "other"}) == "other"
    assert stage_of({"hyper_parameters": {}}) is None
