"""Resuming with something that is not what it was: other data, no steps left, what another job left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from tests.fits import QUIET, SKILL, TASK, call, of_data, resuming_words, skill_of, told

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


def fit(data, *words):
    return call(
        "skill", "fit", *data, *QUIET, *SKILL, "--checkpoint.dirpath=out", "--trainer.default_root_dir=out", *words
    )


def test_other_data_of_the_same_size_are_refused(data, tmp_path_factory, capfd):
    """Its story: the number of segments was all that was compared."""
    skill_of(data, Path("out"), 2)
    other = tmp_path_factory.mktemp("other")
    assert call("data", "collect", TASK, "--steps", 2000, "--out", other, "--workers", 1, "--seed", 1) == 0
    elsewhere = [word.replace(str(Path(data[1].split("local:")[1]).parent), str(other)) for word in data]
    before = Path("out/last.ckpt").read_bytes()
    assert fit(elsewhere, "--ckpt_path=out/last.ckpt", "--trainer.max_steps=4") == 2
    assert "the checkpoint was trained on" in told(capfd.readouterr().err)
    assert Path("out/last.ckpt").read_bytes() == before
    assert call("skill", "validate", *elsewhere, *QUIET, "--data.horizon=5", "--ckpt_path=out/last.ckpt") == 0
    moved = tmp_path_factory.mktemp("moved") / "elsewhere"
    moved.symlink_to(Path(data[1].split("local:")[1]))
    assert (
        fit([data[0], f"--data.data=local:{moved}", data[2]], "--ckpt_path=out/last.ckpt", "--trainer.max_steps=4") == 0
    )


@pytest.mark.parametrize("steps", [3, 2])
def test_a_training_that_has_its_steps_already_names_the_checkpoint_that_there_is(data, dds, steps):
    skill_of(data, Path("out"), 3)
    words = [*data, *QUIET, *SKILL, "--ckpt_path=out/last.ckpt", f"--trainer.max_steps={steps}"]
    answer = dds("skill", "fit", *words)
    assert answer.status == 0
    assert f"trained for 3 steps already, and trainer.max_steps is {steps}" in answer.out
    assert "checkpoint: out/last.ckpt" in answer.out
    assert dds("skill", "fit", *words, "--json").json["checkpoint"] == "out/last.ckpt"


def test_last_is_the_latest_training_in_the_place(data):
    assert fit(data, "--trainer.max_steps=2") == 0
    assert fit(data, "--trainer.max_steps=4", "--ckpt_path=last") == 0
    assert torch.load("out/last.ckpt", weights_only=True)["global_step"] == 4
    for steps in (2, 3):
        assert call("skill", "fit", *data, *QUIET, *SKILL, f"--trainer.max_steps={steps}") == 0
    assert call("skill", "fit", *data, *QUIET, *SKILL, "--trainer.max_steps=5", "--ckpt_path=last") == 0
    (latest,) = Path("runs/skill/logs/version_2/checkpoints").iterdir()
    assert torch.load(latest, weights_only=True)["global_step"] == 5


@pytest.fixture
def slurm(monkeypatch):
    for name, value in (("JOB_NAME", "train"), ("NTASKS", "1"), ("JOB_ID", "8"), ("PROCID", "0"), ("LOCALID", "0")):
        monkeypatch.setenv(f"SLURM_{name}", value)
    monkeypatch.setenv("SLURM_NODEID", "0")


@pytest.mark.usefixtures("slurm")
def test_what_another_job_left_is_not_gone_on_from(data, capfd):
    """Its story: a new training silently started from it, with its learning rate."""
    skill_of(data, Path("left"), 2)
    Path("out").mkdir()
    Path("left/last.ckpt").rename("out/hpc_ckpt_1.ckpt")
    assert fit(data, "--trainer.max_steps=4", "--model.lr=0.01") == 2
    assert "hpc_ckpt_1.ckpt is of an earlier SLURM job" in told(capfd.readouterr().err)
    assert [path.name for path in Path("out").iterdir()] == ["hpc_ckpt_1.ckpt"]


@pytest.mark.usefixtures("slurm")
def test_a_job_that_was_put_back_in_the_queue_goes_on_with_its_own_settings(data, monkeypatch, capfd):
    skill_of(data, Path("left"), 2)
    Path("out").mkdir()
    Path("left/last.ckpt").rename("out/hpc_ckpt_1.ckpt")
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert fit(data, "--trainer.max_steps=4", "--model.lr=0.01") == 2
    assert "--model.lr is 0.01" in told(capfd.readouterr().err)
    assert fit(data, "--trainer.max_steps=4") == 0
    assert torch.load("out/last.ckpt", weights_only=True)["global_step"] == 4


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_the_whole_group_during_a_rollout_saves_and_says_how_to_go_on(data, signum):
    """Its story: the environments' processes died first, and the training ended in their traceback."""
    rollouts = ["--trainer.callbacks+=dds_lightning.callbacks.RolloutEvaluation", "--trainer.callbacks.every_n_steps=1"]
    rollouts += ["--trainer.callbacks.episodes=40", "--trainer.callbacks.slots=8", "--trainer.callbacks.workers=2"]
    words = ["skill", "fit", *data, *QUIET, *SKILL, "--trainer.max_steps=100000", "--checkpoint.dirpath=out", *rollouts]
    words += ["--checkpoint.every_n_steps=1", "--trainer.log_every_n_steps=1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "dds_lightning", *words],
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        process_group=0,
    )
    deadline = time.monotonic() + 300
    while not Path("out/last.ckpt").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)  # in the next rollout, which takes nearly all of the time
    os.killpg(process.pid, signum)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 128 + signum, err
    assert "Traceback" not in err
    assert "--ckpt_path" in resuming_words(err)
