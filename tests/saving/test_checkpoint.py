"""Files are whole or absent, what was there survives, and what is wrong is named."""

import contextlib
import itertools
import json
import os
import pickle
import shutil
import signal
import subprocess
import time

import lightning.pytorch as pl
import numpy as np
import pytest
import safetensors.torch
import torch
import yaml

import dds_lightning.saving.published as publishing
from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.checkpoint import AtomicCheckpointIO, load_ckpt, load_module
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.published import load_published, publish
from dds_lightning.skill import SkillModule


def small_policy(seed=0, width=8):
    torch.manual_seed(seed)
    return PolicyModule(3, 4, hidden_dims=(width,))


def small_skill():
    return SkillModule(3, 2, num_skills=4, skill_dim=4, hidden_dim=8, encoder_layers=1, encoder_heads=2)


def files_of(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


# ---------------------------------------------------------------- atomic files


def test_a_failed_write_leaves_the_previous_file_and_no_rubbish(tmp_path):
    file = tmp_path / "table"
    file.write_text("before")
    with contextlib.suppress(KeyboardInterrupt), written_whole(file) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert files_of(tmp_path) == {"table": b"before"}
    with written_whole(file) as part:
        part.write_text("after")
    assert files_of(tmp_path) == {"table": b"after"}


def test_what_a_kill_left_is_tidied_after_an_hour(tmp_path):
    for name, age in ((".table.00000000.part", 4000), (".table.11111111.part", 10), (".other.00000000.part", 4000)):
        (tmp_path / name).write_text("half")
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    with written_whole(tmp_path / "table") as part:
        part.write_text("whole")
    assert sorted(files_of(tmp_path)) == [".other.00000000.part", ".table.11111111.part", "table"]


def test_a_checkpoint_goes_to_disk_and_comes_back(tmp_path):
    io = AtomicCheckpointIO()
    path = tmp_path / "deep" / "er" / "a.ckpt"
    io.save_checkpoint({"state_dict": {"w": torch.arange(3.0)}, "epoch": 2}, path)
    loaded = io.load_checkpoint(path)
    assert loaded["epoch"] == 2
    assert loaded["state_dict"]["w"].tolist() == [0.0, 1.0, 2.0]
    assert [entry.name for entry in path.parent.iterdir()] == ["a.ckpt"]
    io.remove_checkpoint(path)
    assert not path.exists()
    with pytest.raises(TypeError, match="storage_options"):
        io.save_checkpoint({}, path, storage_options={})


@pytest.mark.parametrize("step", ["torch.save", "os.fsync", "os.replace"])
def test_a_save_that_fails_raises_and_keeps_the_previous_checkpoint(tmp_path, monkeypatch, step):
    io, path = AtomicCheckpointIO(), tmp_path / "a.ckpt"
    io.save_checkpoint({"state_dict": {}, "epoch": 1}, path)

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    module, name = step.split(".")
    with monkeypatch.context() as patch:
        patch.setattr({"torch": torch, "os": os}[module], name, fail)
        with pytest.raises(OSError, match="No space"):
            io.save_checkpoint({"state_dict": {}, "epoch": 2}, path)
    assert io.load_checkpoint(path)["epoch"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ckpt"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks as on Unix")
@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
def test_kills_while_saving_leave_a_whole_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    io, path = AtomicCheckpointIO(), tmp_path / "a.ckpt"
    io.save_checkpoint({"state_dict": {"w": torch.zeros(200_000)}, "epoch": 0}, path)
    last = 0
    for attempt in itertools.count():
        if attempt >= 8 and last:  # on a busy machine the first children may be killed before their first save
            break
        child = os.fork()
        if child == 0:
            for epoch in range(last + 1, 10**6):
                io.save_checkpoint({"state_dict": {"w": torch.full((200_000,), float(epoch))}, "epoch": epoch}, path)
        time.sleep(min(0.02 + 0.017 * attempt, 2.0))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        loaded = load_ckpt(path)
        assert loaded["epoch"] >= last
        assert (loaded["state_dict"]["w"] == loaded["epoch"]).all()
        last = loaded["epoch"]


# ---------------------------------------------------------------- loading training checkpoints


class Hostile:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("was_here",)


def test_a_hostile_checkpoint_is_refused_and_runs_nothing(tmp_path):
    torch.save({"state_dict": {}, "extra": Hostile()}, tmp_path / "hostile.ckpt")
    (tmp_path / "plain.ckpt").write_bytes(pickle.dumps({"state_dict": Hostile()}, protocol=2))
    for name in ("hostile.ckpt", "plain.ckpt"):
        with pytest.raises(UserError, match=f"{name} is"):
            load_ckpt(tmp_path / name)
        with pytest.raises(UserError, match=f"{name} is"):
            AtomicCheckpointIO().load_checkpoint(tmp_path / name, weights_only=False)
    assert not os.path.exists("was_here")


def test_damaged_and_missing_checkpoints_are_named(tmp_path):
    torch.save({"state_dict": {"w": torch.zeros(1000)}}, tmp_path / "a.ckpt")
    whole = (tmp_path / "a.ckpt").read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 3):
        (tmp_path / "cut.ckpt").write_bytes(whole[:size])
        with pytest.raises(UserError, match=r"cut\.ckpt"):
            load_ckpt(tmp_path / "cut.ckpt")
    with pytest.raises(UserError, match=r"no checkpoint .*b\.ckpt; .* holds a\.ckpt, cut\.ckpt"):
        load_ckpt(tmp_path / "b.ckpt")
    torch.save({"w": torch.zeros(1)}, tmp_path / "bare.ckpt")
    with pytest.raises(UserError, match="no state_dict"):
        load_ckpt(tmp_path / "bare.ckpt")


def lightning_ckpt(path, module, **changes):
    settings = {**dict(module.hparams), "_instantiator": "os.mkdir", **changes}
    torch.save({"state_dict": module.state_dict(), "hyper_parameters": settings}, path)
    return path


def test_a_module_comes_back_from_a_lightning_checkpoint(tmp_path):
    policy = small_policy()
    loaded = PolicyModule.load(lightning_ckpt(tmp_path / "p.ckpt", policy))
    assert not loaded.training
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path):
    wide = lightning_ckpt(tmp_path / "wide.ckpt", small_policy(), hidden_dims=[16])
    with pytest.raises(UserError, match=r"wide\.ckpt does not fit PolicyModule: .* is \(.*\), expected \("):
        load_module(PolicyModule, wide, "policy")
    with pytest.raises(UserError, match=r"wide\.ckpt is a checkpoint of stage policy, expected skill"):
        SkillModule.load(wide)
    single = lightning_ckpt(tmp_path / "single.ckpt", small_policy(), num_skills=1)
    with pytest.raises(UserError, match=r"single\.ckpt: model\.num_skills is 1"):
        PolicyModule.load(single)
    policy = small_policy()
    checkpoint = {"state_dict": dict(policy.state_dict()), "hyper_parameters": dict(policy.hparams)}
    name = next(iter(checkpoint["state_dict"]))
    checkpoint["state_dict"]["_orig_mod." + name] = checkpoint["state_dict"].pop(name)
    torch.save(checkpoint, tmp_path / "names.ckpt")
    with pytest.raises(UserError, match=f"lacks {name} and has unknown _orig_mod.{name}"):
        PolicyModule.load(tmp_path / "names.ckpt")
    torch.nn.init.constant_(next(policy.actor.parameters()), torch.nan)
    with pytest.raises(UserError, match="holds NaN in actor"):
        PolicyModule.load(lightning_ckpt(tmp_path / "nan.ckpt", policy))


# ---------------------------------------------------------------- published directories


@pytest.fixture
def published(tmp_path):
    return publish(tmp_path / "agent", {"policy": small_policy()}, {"task": "t"}, {"success": 99.0}, "# card\n")


def resum(directory):
    """Write the sums anew, as somebody who edits a file would."""
    lines = [f"{publishing.sha256(directory / name)}  {name}\n" for name in publishing.CONTENTS]
    (directory / "SHA256SUMS").write_text("".join(lines))


def test_a_published_directory_holds_what_was_given(published):
    assert set(files_of(published)) == {
        "model.safetensors", "config.yaml", "metrics.json", "README.md", "SHA256SUMS"
    }  # fmt: skip
    read = load_published(published)
    assert read.config["format_version"] == 1
    assert read.config["task"] == "t"
    assert read.config["policy"]["hidden_dims"] == [8]
    assert read.metrics == {"success": 99.0}
    assert (published / "README.md").read_text() == "# card\n"
    assert all(name.startswith("policy.") for name in read.state)
    sums = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=published, capture_output=True)
    assert sums.returncode == 0
    assert [entry.name for entry in published.parent.iterdir()] == ["agent"]


def test_no_pickle_and_no_object_tag_is_in_a_published_directory(published):
    assert "!!python" not in (published / "config.yaml").read_text()
    assert yaml.safe_load((published / "config.yaml").read_text())["policy"]["lr"] == 1e-4


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml", "metrics.json", "README.md", "SHA256SUMS"])
def test_a_missing_file_is_named_with_what_is_there(published, name):
    (published / name).unlink()
    with pytest.raises(UserError, match=f"lacks {name}; it holds ") as error:
        load_published(published)
    assert sum(other in str(error.value).split("it holds")[1] for other in publishing.CONTENTS) >= 3


@pytest.mark.parametrize("name", ["model.safetensors", "config.yaml", "metrics.json", "README.md", "SHA256SUMS"])
def test_one_changed_byte_is_noticed(published, name):
    whole = (published / name).read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 9)):
        changed = bytearray(whole)
        changed[place] ^= 0x20
        (published / name).write_bytes(changed)
        with pytest.raises(UserError, match=str(published)):
            load_published(published)
    (published / name).write_bytes(whole[:-1])
    if name != "SHA256SUMS":  # there it is only the last line's end
        with pytest.raises(UserError, match=name):
            load_published(published)


def test_consistent_but_wrong_directories_are_refused(published):
    def change(name, text, message):
        before = (published / name).read_bytes()
        (published / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        resum(published)
        with pytest.raises(UserError, match=message):
            load_published(published).module(PolicyModule, "policy")
        (published / name).write_bytes(before)
        resum(published)

    config = yaml.safe_load((published / "config.yaml").read_text())
    change("config.yaml", yaml.safe_dump({**config, "format_version": 99}), "format 99.*reads up to 1")
    change("config.yaml", yaml.safe_dump({**config, "format_version": "x"}), "format_version is 'x'")
    change("config.yaml", "- a\n- b\n", "config.yaml holds a list")
    change("config.yaml", "a: [", "config.yaml cannot be read")
    change("config.yaml", "!!python/object/apply:os.mkdir [was_here]", "config.yaml cannot be read")
    change("config.yaml", yaml.safe_dump({"format_version": 1}), "describes no 'policy'")
    settings = {**config["policy"], "wings": 2}
    change(
        "config.yaml", yaml.safe_dump({**config, "policy": settings}), "not hold a PolicyModule of this version.*wings"
    )
    settings = {**config["policy"], "hidden_dims": [9]}
    change("config.yaml", yaml.safe_dump({**config, "policy": settings}), r"policy\) does not fit .* expected")
    change("metrics.json", "{", "metrics.json cannot be read")
    change("model.safetensors", b"\xff" * 100, "model.safetensors is damaged")
    change("model.safetensors", b"", "model.safetensors is damaged")
    assert not os.path.exists("was_here")
    load_published(published).module(PolicyModule, "policy")


def test_names_that_lead_elsewhere_are_refused(published):
    with (published / "SHA256SUMS").open("a") as file:
        file.write(f"{'0' * 64}  ../../etc/passwd\n")
    with pytest.raises(UserError, match="is not a valid line"):
        load_published(published)


def test_a_wrong_directory_says_what_is_there(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(UserError, match=r"run is not a published checkpoint: it lacks model.* it holds nothing"):
        load_published(tmp_path / "run")
    with pytest.raises(UserError, match=r"no published checkpoint .*rum; .* holds run"):
        load_published(tmp_path / "rum")


def test_publishing_again_replaces_all(published):
    publish(published, {"policy": small_policy(1)}, {}, {"success": 1.0})
    read = load_published(published)
    assert read.metrics == {"success": 1.0}
    assert "task" not in read.config
    policy = read.module(PolicyModule, "policy")
    assert all(torch.equal(*pair) for pair in zip(policy.parameters(), small_policy(1).parameters(), strict=True))
    assert [entry.name for entry in published.parent.iterdir()] == ["agent"]


def test_what_was_not_published_is_never_replaced(tmp_path, published):
    (published / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"holds what was not published: notes\.txt"):
        publish(published, {"policy": small_policy()})
    home = tmp_path / "home"
    home.mkdir()
    (home / "config.yaml").write_text("mine")
    with pytest.raises(UserError, match=r"holds what was not published: config\.yaml"):
        publish(home, {"policy": small_policy()})
    with pytest.raises(UserError, match="is a file"):
        publish(home / "config.yaml", {"policy": small_policy()})
    assert files_of(home) == {"config.yaml": b"mine"}
    assert (published / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("failing", ["save_file", "write", "rename", "second rename"])
def test_a_failure_while_publishing_leaves_the_previous_directory(published, monkeypatch, failing):
    before = files_of(published)
    renames = []
    rename = os.rename

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    def fail_second(source, target):
        renames.append(target)
        if len(renames) == 2:
            fail()
        rename(source, target)

    with monkeypatch.context() as patch:
        if failing == "save_file":
            patch.setattr(safetensors.torch, "save_file", fail)
        elif failing == "write":
            patch.setattr("pathlib.Path.write_text", fail)
        else:
            patch.setattr(os, "rename", fail if failing == "rename" else fail_second)
        with pytest.raises(OSError, match="No space"):
            publish(published, {"policy": small_policy(1)})
    assert files_of(published) == before
    assert [entry.name for entry in published.parent.iterdir()] == ["agent"]


def test_a_kill_between_the_two_renames_is_mended_at_the_next_look(published):
    before = files_of(published)
    os.rename(published, published.with_name(".agent.previous"))
    load_published(published)
    assert files_of(published) == before
    shutil.copytree(published, published.with_name(".agent.previous"))  # killed just before the tidying
    publish(published, {"policy": small_policy(1)})
    assert [entry.name for entry in published.parent.iterdir()] == ["agent"]


def test_values_that_are_not_plain_are_refused_by_name(tmp_path):
    with pytest.raises(UserError, match=r"metrics\.json: score is a object"):
        publish(tmp_path / "a", {"policy": small_policy()}, {}, {"score": object()})
    assert list(tmp_path.iterdir()) == []
    publish(tmp_path / "a", {"policy": small_policy()}, {}, {"score": np.float32(0.5), "by": (1, 2)})
    assert json.loads((tmp_path / "a" / "metrics.json").read_text()) == {"score": 0.5, "by": [1, 2]}


# ---------------------------------------------------------------- with Lightning


def test_a_trainer_saves_and_resumes_through_it(tmp_path):
    class Line(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(1, 1)

        def training_step(self, batch, batch_idx):
            return self.layer(batch).square().mean()

        def configure_optimizers(self):
            return torch.optim.Adam(self.parameters(), 0.1)

    def trainer(steps):
        return pl.Trainer(
            max_steps=steps, accelerator="cpu", logger=False, enable_progress_bar=False,
            enable_model_summary=False, enable_checkpointing=False, plugins=[AtomicCheckpointIO()],
            default_root_dir=tmp_path,
        )  # fmt: skip

    data = torch.utils.data.DataLoader(torch.ones(2, 1), batch_size=1)
    torch.manual_seed(0)
    model = Line()
    first = trainer(4)
    first.fit(model, data)
    first.save_checkpoint(tmp_path / "a.ckpt")
    resumed = Line()
    trainer(8).fit(resumed, data, ckpt_path=tmp_path / "a.ckpt")
    torch.manual_seed(0)
    straight = Line()
    trainer(8).fit(straight, data)
    assert torch.equal(resumed.layer.weight, straight.layer.weight)


def test_the_agent_says_which_file_is_missing(tmp_path):
    DDSAgent(small_skill(), small_policy()).save(tmp_path / "agent")
    (tmp_path / "agent" / "config.yaml").unlink()
    with pytest.raises(UserError, match=r"agent is not a published checkpoint: it lacks config\.yaml"):
        DDSAgent.load(tmp_path / "agent")
