"""Ctrl-C and SIGTERM in every command that works long: what is done stays, the status tells, the command goes on."""

import signal
from pathlib import Path

import pytest
import torch

from datamodules.collect import pointmaze
from datamodules.relabel import relabel
from datamodules.segments import SegmentDataModule
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from tests.fits import POLICY, QUIET, SKILL, TASK, call, of_data, resuming_words, skill_of

STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
SIGNALS = pytest.mark.parametrize("signum", STATUS, ids=lambda signum: signum.name)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def skill(data, tmp_path_factory):
    return skill_of(data, tmp_path_factory.mktemp("skill"), 2)


def interrupt(monkeypatch, owner, name, signum, call_number):
    """Send a signal to this process in the n-th call of a method, once; returns how often it has been called."""
    real, calls = getattr(owner, name), []

    def method(*args, **kwargs):
        calls.append(args)
        if len(calls) == call_number:
            signal.raise_signal(signum)
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, name, method)
    return calls


def stopped(capsys, words, signum):
    """The command ends as an interrupted one; returns what it said."""
    capsys.readouterr()
    assert call(*words) == STATUS[signum]
    err = capsys.readouterr().err
    assert "dds: interrupted" in err
    assert "Traceback" not in err
    return err


@SIGNALS
@pytest.mark.parametrize("stage", ["skill", "policy"])
def test_a_training_saves_and_names_the_command_that_goes_on(capsys, monkeypatch, data, skill, stage, signum):
    own = SKILL if stage == "skill" else [*POLICY, f"--data.skill={skill}", "--data.cache=."]
    words = [stage, "fit", *data, *QUIET, *own, "--trainer.max_steps=6", "--checkpoint.dirpath=out"]
    with monkeypatch.context() as patch:
        interrupt(patch, SkillModule if stage == "skill" else PolicyModule, "training_step", signum, 3)
        err = stopped(capsys, words, signum)
    assert "the state is in out/last.ckpt, and this command continues from it:" in err
    assert torch.load("out/last.ckpt", weights_only=True)["global_step"] == 3
    again = resuming_words(err)
    assert again == [*map(str, words), "--ckpt_path", "out/last.ckpt"]
    assert call(*again) == 0
    assert torch.load("out/last.ckpt", weights_only=True)["global_step"] == 6


@SIGNALS
def test_a_training_stopped_before_its_first_step_begins_again(capsys, monkeypatch, data, signum):
    words = ["skill", "fit", *data, *QUIET, *SKILL, "--trainer.max_steps=2", "--checkpoint.dirpath=out"]
    with monkeypatch.context() as patch:
        interrupt(patch, SegmentDataModule, "setup", signum, 1)
        err = stopped(capsys, words, signum)
    assert "before anything was saved; the same command begins again" in err
    assert not Path("out").exists()
    assert resuming_words(err) == words
    assert call(*words) == 0


@SIGNALS
def test_relabelling_goes_on_where_it_stopped(capsys, monkeypatch, data, skill, signum):
    monkeypatch.setitem(relabel.__wrapped__.__kwdefaults__, "batch_size", 400)
    place = data[1].partition("=")[2]
    words = ["relabel", skill, place, "--task", TASK, "--out"]
    with monkeypatch.context() as patch:
        calls = interrupt(patch, SkillModule, "encode", signum, 0)
        assert call(*words, "through.safetensors") == 0
    batches = len(calls)
    assert batches > 3
    calls = interrupt(monkeypatch, SkillModule, "encode", signum, 3)
    err = stopped(capsys, [*words, "stopped.safetensors"], signum)
    assert "the same command continues where it stopped" in err
    assert not Path("stopped.safetensors").exists()
    assert call(*resuming_words(err)) == 0
    assert len(calls) == batches + 1  # the third batch began twice, the first two did not
    assert Path("stopped.safetensors").read_bytes() == Path("through.safetensors").read_bytes()
    assert sorted(path.name for path in Path().iterdir()) == ["stopped.safetensors", "through.safetensors"]
    assert call(*words, "stopped.safetensors") == 0
    assert len(calls) == batches + 1  # what is done is not done again


def test_kept_codes_of_other_inputs_are_not_taken(monkeypatch, data, skill, capsys):
    monkeypatch.setitem(relabel.__wrapped__.__kwdefaults__, "batch_size", 400)
    words = ["relabel", skill, data[1].partition("=")[2], "--task", TASK, "--out", "made.safetensors"]
    calls = interrupt(monkeypatch, SkillModule, "encode", signal.SIGINT, 3)
    stopped(capsys, words, signal.SIGINT)
    assert call(*words, "--stride=2") == 0
    assert len(calls) > 3 + 1
    kept = Path(".made.safetensors.codes")
    assert not kept.exists()
    kept.write_bytes(b"PK\x03\x04 no archive")
    Path("made.safetensors").unlink()
    assert call(*words) == 0


@SIGNALS
def test_collecting_goes_on_where_it_stopped(capsys, monkeypatch, data, signum):
    calls = interrupt(monkeypatch, pointmaze._Recorder, "__call__", signum, 6)
    words = ["data", "collect", TASK, "--steps", "4000", "--workers", "1", "--out", "data"]
    err = stopped(capsys, words, signum)
    assert "the same command continues where it stopped" in err
    assert resuming_words(err) == words
    assert call(*words) == 0
    assert len(calls) == 8 + 2  # of eight episodes the first four were kept, the fifth and half of the sixth not


@SIGNALS
def test_a_run_goes_on_where_it_stopped(capsys, monkeypatch, signum):
    words = ["run", TASK, "--out", "run", "--data_steps=2000", "--workers=1", "--until=data", "--fresh"]
    calls = interrupt(monkeypatch, pointmaze._Recorder, "__call__", signum, 2)
    err = stopped(capsys, words, signum)
    assert "the same command continues where it stopped" in err
    assert resuming_words(err) == words[:-1]  # --fresh would begin anew
    assert call(*resuming_words(err)) == 0
    assert len(calls) == 4 + 2


def test_any_other_command_begins_again(capsys, monkeypatch):
    monkeypatch.setattr("dds_lightning.cli._report", lambda *_: signal.raise_signal(signal.SIGTERM))
    err = stopped(capsys, ["tasks"], signal.SIGTERM)
    assert "interrupted before anything was saved; the same command begins again:" in err
    assert resuming_words(err) == ["tasks"]
