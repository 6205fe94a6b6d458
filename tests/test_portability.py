"""Files from other machines and from other versions: loaded on this CPU with equal bits, or refused in a sentence."""

import json
import warnings
import zipfile

import numpy as np
import pytest
import torch
from rich.console import Console

from datamodules.semi_mdp import Relabelled
from datamodules.trajectories import Trajectories
from dds_lightning._version import __version__
from dds_lightning.callbacks.resume import rng_state, set_rng_state
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.checkpoint import FORMAT_KEY, AtomicCheckpointIO, load_ckpt
from dds_lightning.saving.run_directory import RunDirectory
from dds_lightning.study.findings import read_marker

NEWER = rf"has format 2, but this version of dds-lightning \({__version__}\) reads up to 1: install a newer one"


def small_policy():
    torch.manual_seed(0)
    return PolicyModule(3, 4, hidden_dims=[8])


@pytest.fixture
def checkpoint(tmp_path):
    """A policy with the state of its optimiser."""
    policy = small_policy()
    optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
    sum(value.sum() for value in policy.parameters() if value.requires_grad).backward()
    optimizer.step()
    content = {"state_dict": policy.state_dict(), "hyper_parameters": dict(policy.hparams)}
    path = tmp_path / "policy.ckpt"
    AtomicCheckpointIO().save_checkpoint({**content, "optimizer_states": [optimizer.state_dict()]}, path)
    return path


# ---------------------------------------------------------------- other devices


def written_on(device, path, to):
    """The same file with tensors that say they were on a device: torch notes it once in the archive's pickle."""
    place = b"X" + len(device).to_bytes(4, "little") + device.encode()
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(to, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name.endswith("/data.pkl"):
                assert data.count(b"X\x03\x00\x00\x00cpu") == 1
                data = data.replace(b"X\x03\x00\x00\x00cpu", place)
            target.writestr(name, data)
    return to


@pytest.mark.parametrize("device", ["cuda:0", "cuda:7", "mps"])
def test_a_checkpoint_written_on_an_accelerator_loads_on_a_cpu(checkpoint, tmp_path, device):
    other = written_on(device, checkpoint, tmp_path / "there.ckpt")
    if not torch.cuda.is_available() and device != "mps":
        with pytest.raises(RuntimeError, match="CUDA"):
            torch.load(other, weights_only=True)  # so it is marked as it should be
    ours, theirs = load_ckpt(checkpoint), load_ckpt(other)
    assert all(value.device.type == "cpu" for value in theirs["state_dict"].values())
    assert all(torch.equal(value, theirs["state_dict"][name]) for name, value in ours["state_dict"].items())
    moments = theirs["optimizer_states"][0]["state"][0]["exp_avg"]
    assert torch.equal(moments, ours["optimizer_states"][0]["state"][0]["exp_avg"])
    assert moments.device.type == "cpu"
    module = PolicyModule.load(other)
    assert module.fingerprint() == PolicyModule.load(checkpoint).fingerprint()
    # Also where somebody asks for another device: a Trainer moves what it needs by itself.
    through = AtomicCheckpointIO().load_checkpoint(other, map_location="cuda:0")
    assert all(value.device.type == "cpu" for value in through["state_dict"].values())


def test_random_streams_of_an_accelerator_are_left_out_where_there_is_none():
    state = rng_state()
    expected = torch.rand(3)
    elsewhere = {**state, "cuda": [torch.zeros(16, dtype=torch.uint8)] * (torch.cuda.device_count() + 1)}
    with pytest.warns(UserWarning, match=r"random streams of \d GPUs, here are \d.*not bit for bit"):
        set_rng_state(elsewhere)
    assert torch.equal(torch.rand(3), expected)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        set_rng_state(state)


# ---------------------------------------------------------------- newer versions


def test_a_checkpoint_says_its_format_and_one_of_before_is_of_the_first(checkpoint, tmp_path):
    content = torch.load(checkpoint, weights_only=True)
    assert content.pop(FORMAT_KEY) == 1
    torch.save(content, tmp_path / "old.ckpt")
    assert PolicyModule.load(tmp_path / "old.ckpt").fingerprint() == PolicyModule.load(checkpoint).fingerprint()


def test_a_checkpoint_of_a_newer_format_is_refused(checkpoint, tmp_path):
    content = torch.load(checkpoint, weights_only=True)
    torch.save({**content, FORMAT_KEY: 2}, tmp_path / "newer.ckpt")
    for load in (PolicyModule.load, load_ckpt, AtomicCheckpointIO().load_checkpoint):
        with pytest.raises(UserError, match=rf"newer\.ckpt {NEWER}"):
            load(tmp_path / "newer.ckpt")
    torch.save({**content, FORMAT_KEY: "two"}, tmp_path / "strange.ckpt")
    with pytest.raises(
        UserError, match=r"strange\.ckpt: format_version is 'two', expected a whole number of at least 1"
    ):
        load_ckpt(tmp_path / "strange.ckpt")


def test_a_run_of_a_newer_format_is_refused_and_nothing_in_it_is_touched(tmp_path):
    def work(folder, resuming):
        (folder / "out.txt").write_text("made")
        return {"file": folder / "out.txt"}

    RunDirectory(tmp_path, Console(quiet=True)).do("first", "first", {}, [], work)
    marker = tmp_path / "first" / "stage.json"
    marker.write_text(json.dumps({**json.loads(marker.read_text()), "format": 2}))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(UserError, match=rf"stage\.json {NEWER}"):
        RunDirectory(tmp_path, Console(quiet=True)).do("first", "first", {}, [], work)
    with pytest.raises(UserError, match=rf"stage\.json {NEWER}"):
        read_marker(tmp_path / "first")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_relabelled_data_of_a_newer_format_are_refused(tmp_path, monkeypatch):
    states, flat = torch.zeros(2, 1, 2), torch.zeros(3, 1)
    index = torch.zeros(3, 1, dtype=torch.int64)
    made = Relabelled(states[0], index[0], flat[0], states[1], flat[1], flat[2], index[1], index[2], num_skills=4)
    made.save(tmp_path / "now.safetensors", {})
    assert len(Relabelled.load(tmp_path / "now.safetensors")) == 1
    monkeypatch.setattr("datamodules.semi_mdp.FORMAT", 2)
    made.save(tmp_path / "newer.safetensors", {})
    monkeypatch.setattr("datamodules.semi_mdp.FORMAT", 1)
    with pytest.raises(UserError, match=rf"newer\.safetensors {NEWER}"):
        Relabelled.load(tmp_path / "newer.safetensors")


def test_arrays_of_a_newer_format_are_refused(tmp_path):
    episode = {"observations": np.zeros((3, 2)), "actions": np.zeros((2, 1)), "rewards": np.zeros(2)}
    ends = {"terminations": np.zeros(2, bool), "truncations": np.array([False, True])}
    folder = Trajectories.from_episodes("mine", [{**episode, **ends}]).save(tmp_path / "mine")
    facts = json.loads((folder / "trajectories.json").read_text())
    (folder / "trajectories.json").write_text(json.dumps({**facts, "format": 2}))
    with pytest.raises(UserError, match=rf"trajectories\.json {NEWER}"):
        Trajectories.load(folder)
