"""The registry of methods agrees with the registry of stages."""

from importlib import import_module

import pytest

from dds_lightning.baselines.methods import METHODS, get_method, method_of
from dds_lightning.errors import UserError
from dds_lightning.training.options import options
from dds_lightning.training.stages import STAGES, run_stages


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_method_names_stages_that_can_be_trained_in_its_order(method):
    for index, name in enumerate(method.stages):
        stage, known = STAGES[name], options(STAGES[name])
        assert set(stage.reads) <= set(method.stages[:index])
        assert {*stage.reads.values(), *method.settings.get(name, ())} <= set(known)
        assert name == stage.module_class().STAGE
    module, _, function = method.actor.partition(":")
    assert callable(getattr(import_module(module), function))
    assert method_of(method.stages[-1]) is method
    assert set(method.settings) <= set(method.stages)


def test_ours_comes_first_and_a_method_that_does_not_exist_is_refused():
    assert list(METHODS)[:2] == ["dds", "clone"]
    with pytest.raises(UserError, match="method is 'ddz', expected one of dds, clone"):
        get_method("ddz")
    with pytest.raises(UserError, match="DDS plays with checkpoints of skill, policy: policy is missing"):
        get_method("dds").play({"skill": "x.ckpt"})


def test_a_run_takes_the_settings_of_its_own_stages_only():
    assert run_stages()[:4] == ["skill", "policy", "clone", "online"]
    assert all(STAGES[name].in_run for name in run_stages())
