"""No memory, no room, no temporary folder: the last good file stays, and one sentence tells what happened."""

import contextlib
import os
import resource
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules import collect_pointmaze, load_trajectories
from datamodules.semi_mdp import Relabelled
from datamodules.trajectories import Trajectories
from dds_lightning.cli import main
from dds_lightning.errors import UserError, is_out_of_memory
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.checkpoint import AtomicCheckpointIO, load_ckpt
from dds_lightning.saving.published import load_published, publish
from dds_lightning.skill import SkillModule
from tests.fits import POLICY, QUIET, SKILL, TASK, call, of_data, skill_of, told


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def skill(data, tmp_path_factory):
    return skill_of(data, tmp_path_factory.mktemp("skill"), 3)


SAVING = ["--checkpoint.dirpath=out", "--checkpoint.every_n_steps=2", "--trainer.max_steps=50"]
SAVING += ["--best.monitor=train/loss", "--best.mode=min", "--best.every_n_steps=2", "--trainer.log_every_n_steps=1"]


def failing(monkeypatch, module, step, act):
    """From some step on a module's training steps begin with `act`."""
    real = module.training_step

    def training_step(self, batch, batch_idx):
        result = act() if self.global_step >= step else None
        loss = real(self, batch, batch_idx)
        return loss if result is None else loss * result

    monkeypatch.setattr(module, "training_step", training_step)


def check_saved(step, module):
    """The last checkpoint is of a step, the best is there, both are whole."""
    assert sorted(path.name for path in Path("out").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert load_ckpt("out/last.ckpt")["global_step"] == step
    assert load_ckpt("out/best.ckpt")["global_step"] in (2, 4)
    module.load("out/last.ckpt")
    module.load("out/best.ckpt")


# ---------------------------------------------------------------- memory


def raises(error):
    def act():
        raise error

    return act


CUDA = "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 8.00 GiB of which 1 is free."
MEMORY = {
    "a CPU": (lambda: torch.empty(10**15), "can't allocate memory: you tried to allocate 4000000000000000 bytes"),
    "a GPU": (raises(torch.OutOfMemoryError(CUDA)), "CUDA out of memory"),
    "Python": (raises(MemoryError()), "MemoryError"),
}


@pytest.mark.parametrize("kind", MEMORY)
def test_out_of_memory_says_what_to_lower_and_keeps_both_checkpoints(capsys, monkeypatch, data, kind):
    act, reason = MEMORY[kind]
    failing(monkeypatch, SkillModule, 5, act)
    capsys.readouterr()
    assert call("skill", "fit", *data, *QUIET, *SKILL, *SAVING) == 2
    error = told(capsys.readouterr().err)
    assert "out of memory at step 5 with data.batch_size 32 and horizon 5" in error
    assert reason in error
    assert "lower data.batch_size first, then data.horizon or model.hidden_dim" in error
    assert "out/last.ckpt is whole" in error
    check_saved(4, SkillModule)


def test_a_policy_out_of_memory_says_what_to_lower(capsys, monkeypatch, data, skill):
    failing(monkeypatch, PolicyModule, 0, MEMORY["a GPU"][0])
    capsys.readouterr()
    assert call("policy", "fit", *data, *QUIET, *POLICY, *SAVING, f"--data.skill={skill}", "--data.cache=.") == 2
    error = told(capsys.readouterr().err)
    assert "out of memory at step 0 with data.batch_size 32 and horizon 5 (CUDA out of memory)" in error
    assert error.endswith("lower data.batch_size first, then model.hidden_dims")  # nothing was saved yet
    assert not list(Path("out").rglob("*"))


def test_out_of_memory_anywhere_else_is_a_sentence_too(capsys, monkeypatch):
    monkeypatch.setattr("dds_lightning.cli._dispatch", lambda words: np.empty(2**57))
    assert main(["data", "collect", TASK]) == 2
    assert "out of memory (Unable to allocate 1.00 EiB" in told(capsys.readouterr().err)


def test_other_errors_are_not_taken_for_it():
    assert is_out_of_memory(RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 9 bytes."))
    assert is_out_of_memory(RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate`"))
    assert not is_out_of_memory(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))
    assert not is_out_of_memory(ValueError("out of memory"))


def test_a_loss_that_is_not_finite_keeps_both_checkpoints(capsys, monkeypatch, data):
    failing(monkeypatch, SkillModule, 5, lambda: torch.nan)
    capsys.readouterr()
    assert call("skill", "fit", *data, *QUIET, *SKILL, *SAVING) == 2
    assert "step 5: the loss is nan" in told(capsys.readouterr().err)
    check_saved(4, SkillModule)


# ---------------------------------------------------------------- room


@contextlib.contextmanager
def little_room(size):
    """No file may grow beyond a size: writing fails in the middle, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_training_on_a_disk_that_fills_up_ends_with_a_sentence_and_the_last_good_checkpoint(
    capsys, monkeypatch, data
):
    room = contextlib.ExitStack()
    failing(monkeypatch, SkillModule, 5, lambda: room.enter_context(little_room(40_000)) and None)
    capsys.readouterr()
    with room:
        status = call("skill", "fit", *data, *QUIET, *SKILL, *SAVING)
    assert status == 2
    error = told(capsys.readouterr().err)
    assert "ckpt could not be written (File too large); what was there before is untouched" in error
    check_saved(4, SkillModule)


def test_a_full_disk_leaves_every_kind_of_file_as_it_was(tmp_path):
    def steps(n):
        ends = {"terminations": np.zeros(n, bool), "truncations": np.arange(n) == n - 1}
        arrays = {"observations": np.zeros((n + 1, 2)), "actions": np.zeros((n, 1)), "rewards": np.zeros(n)}
        return Trajectories.from_episodes("mine", [{**arrays, **ends}])

    def transitions(n):
        flat, index = torch.zeros(3, n), torch.zeros(3, n, dtype=torch.int64)
        states = torch.zeros(2, n, 2)
        return Relabelled(states[0], index[0], flat[0], states[1], flat[1], flat[2], index[1], index[2], 4)

    def policy(width):
        return {"policy": PolicyModule(3, 4, hidden_dims=[width])}

    def checkpoint(place, size):
        AtomicCheckpointIO().save_checkpoint({"state_dict": {"w": torch.zeros(size)}}, place)

    # Where things go, how large ones are written there, how small ones, and how one looks at them.
    kinds = {
        "last.ckpt": (checkpoint, load_ckpt),
        "agent": (lambda place, size: publish(place, policy(8 if size < 100 else 2048)), load_published),
        "arrays": (lambda place, size: steps(size).save(place, overwrite=True), Trajectories.load),
        "r.safetensors": (lambda place, size: transitions(size).save(place, {}), Relabelled.load),
    }
    for name, (write, look) in kinds.items():
        place = tmp_path / name
        write(place, 50)
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        with little_room(20_000), pytest.raises((OSError, UserError), match=f"{name}.* could not be written"):
            write(place, 50_000)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before, name
        look(place)


def test_recording_on_a_full_disk_stops_before_hdf5_fails(tmp_path, monkeypatch):
    """Its story: where HDF5 itself cannot write, it ends the whole process."""
    settings = {"workers": 1, "progress": False, "overwrite": True}
    before = collect_pointmaze(TASK, 60, 0, tmp_path, **settings)
    usage = namedtuple("usage", "total used free")
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda path: usage(2**40, 2**40, 1000))
        with pytest.raises(OSError, match=r"umaze-diverse-v0 could not be written \(No space left"):
            collect_pointmaze(TASK, 80, 0, tmp_path, **settings)
    assert load_trajectories(f"local:{before}", TASK).num_steps > 50
    assert load_trajectories(f"local:{collect_pointmaze(TASK, 80, 0, tmp_path, **settings)}", TASK).num_steps > 70


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks as on Unix")
@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
def test_a_read_only_folder_raises_and_keeps_the_previous_file(tmp_path):
    """In a child without root's rights, who may write anywhere."""
    io = AtomicCheckpointIO()
    io.save_checkpoint({"state_dict": {}, "epoch": 1}, tmp_path / "a.ckpt")
    tmp_path.chmod(0o555)
    child = os.fork()
    if child == 0:
        status = 1
        try:
            if os.geteuid() == 0:
                os.setegid(65534)
                os.seteuid(65534)
            io.save_checkpoint({"state_dict": {}, "epoch": 2}, "a.ckpt")
        except PermissionError as error:
            status = 0 if "a.ckpt could not be written (Permission denied)" in str(error) else 2
        finally:
            os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    tmp_path.chmod(0o755)
    assert status == 0
    assert load_ckpt("a.ckpt")["epoch"] == 1
    assert os.listdir() == ["a.ckpt"]


def test_a_disk_error_on_the_command_line_is_a_sentence(capsys, monkeypatch):
    def full(words):
        raise PermissionError(13, "Permission denied", "data/set")

    monkeypatch.setattr("dds_lightning.cli._dispatch", full)
    assert main(["tasks"]) == 2
    assert told(capsys.readouterr().err) == "dds: error: data/set: Permission denied"

    def bug(words):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("dds_lightning.cli._dispatch", bug)
    with pytest.raises(ZeroDivisionError):
        main(["tasks"])


# ---------------------------------------------------------------- temporary files


def test_nothing_that_is_saved_goes_through_the_temporary_folder(monkeypatch, data, skill, tmp_path):
    """On another file system than the run, a move out of it would be a copy, which a kill can cut short."""
    monkeypatch.setenv("TMPDIR", "/nowhere")
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    words = [*data, *QUIET, "--trainer.max_steps=2", "--checkpoint.dirpath=out"]
    assert call("skill", "fit", *words, *SKILL, "--trainer.default_root_dir=out") == 0
    SkillModule.load("out/last.ckpt")
    place = data[1].partition("=")[2]
    assert call("relabel", skill, place, "--task", TASK, "--out", "out/r.safetensors") == 0
    assert len(Relabelled.load("out/r.safetensors")) > 1000
    assert call("publish", "-", "out/agent", "--skill", skill) == 0
    load_published("out/agent")
    trajectories = load_trajectories(place, TASK)
    assert Trajectories.load(trajectories.save("out/arrays")).num_steps == trajectories.num_steps
