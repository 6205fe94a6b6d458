"""Changed files of checkpoints: each is refused in one clear sentence, or loads as what was saved."""

import contextlib
import hashlib
import io
import json
import os
import pickle
import random
import re
import shutil
import struct
import zipfile
from pathlib import Path

import pytest
import safetensors.torch
import torch
import yaml

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.published import CONTENTS, SUMS
from dds_lightning.skill import SkillModule


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    torch.manual_seed(0)
    skill = SkillModule(4, 2, num_skills=4, skill_dim=8, hidden_dim=16, encoder_layers=1, encoder_heads=2)
    skill.normaliser.fit(torch.zeros(4), torch.ones(4))
    skill.bottleneck.start_from(torch.randn(32, 8))
    policy = PolicyModule(4, 4, hidden_dims=(16,))
    policy.normaliser.fit(torch.zeros(4), torch.ones(4))
    return DDSAgent(skill, policy).save(tmp_path_factory.mktemp("published") / "agent", task="pointmaze-umaze-play")


@pytest.fixture(scope="module")
def checkpoint(published, tmp_path_factory):
    """A skill model as Lightning writes it."""
    skill = DDSAgent.load(published).skill
    path = tmp_path_factory.mktemp("lightning") / "last.ckpt"
    state = {"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}
    torch.save({**state, "pytorch-lightning_version": "2.6.6", "global_step": 3, "epoch": 0}, path)
    return path


def reseal(directory):
    """What an attacker does, or somebody who edits by hand: hashes that fit the changed files."""
    lines = (f"{hashlib.sha256((directory / name).read_bytes()).hexdigest()}  {name}\n" for name in CONTENTS)
    (directory / SUMS).write_text("".join(lines))


def refused(load, path):
    """Loading `path` raises one sentence for the user that names it, and no other kind of exception."""
    with pytest.raises(UserError) as caught:
        load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 600


def flipped(data, rng):
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ (1 << rng.randrange(8))]) + data[place + 1 :]


@pytest.mark.parametrize("name", [*CONTENTS, SUMS])
def test_any_changed_byte_of_a_published_file_is_noticed(published, tmp_path, name):
    rng = random.Random(name)
    shutil.copytree(published, tmp_path / "agent")
    data = (published / name).read_bytes()
    for _ in range(15):
        (tmp_path / "agent" / name).write_bytes(flipped(data, rng))
        refused(DDSAgent.load, tmp_path / "agent")


@pytest.mark.parametrize("name", [*CONTENTS, SUMS])
def test_any_truncated_published_file_is_noticed(published, tmp_path, name):
    rng = random.Random(name)
    shutil.copytree(published, tmp_path / "agent")
    data = (published / name).read_bytes()
    for cut in (0, 1, len(data) - 2, *(rng.randrange(len(data) - 1) for _ in range(5))):
        (tmp_path / "agent" / name).write_bytes(data[:cut])
        refused(DDSAgent.load, tmp_path / "agent")


def test_two_files_that_changed_places_are_noticed(published, tmp_path):
    for one in CONTENTS:
        for other in CONTENTS:
            if one < other:
                directory = tmp_path / f"{one}-{other}"
                shutil.copytree(published, directory)
                (directory / one).write_bytes((published / other).read_bytes())
                (directory / other).write_bytes((published / one).read_bytes())
                refused(DDSAgent.load, directory)
                reseal(directory)
                if {one, other} != {"README.md", "metrics.json"}:
                    refused(DDSAgent.load, directory)


def _header(data):
    size = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def _packed(header, body, size=None):
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + body


def _overlapping(data):
    header, body = _header(data)
    names = [name for name in header if name != "__metadata__"]
    header[names[1]]["data_offsets"] = header[names[0]]["data_offsets"]
    return _packed(header, body)


def _declared(shape):
    def change(data):
        header, body = _header(data)
        name = next(name for name in header if name != "__metadata__")
        header[name]["shape"] = shape
        return _packed(header, body)

    return change


def _renamed(new):
    def change(data):
        header, body = _header(data)
        name = next(name for name in header if name != "__metadata__")
        header[new] = header.pop(name)
        return _packed(header, body)

    return change


WEIGHTS = {
    "oversize header": lambda data: _packed(*_header(data), size=2**62),
    "header longer than the file": lambda data: _packed(*_header(data), size=len(data)),
    "overlapping tensors": _overlapping,
    "a declared shape larger than the file": _declared([2**40]),
    "a negative shape": _declared([-1]),
    "a shape that overflows": _declared([2**32, 2**32]),
    "a tensor named like a path": _renamed("../../outside"),
    "a tensor nobody knows": _renamed("skill.surprise"),
    "a header that is no JSON": lambda data: struct.pack("<Q", 4) + b"{{{{" + data,
    "a pickle": lambda data: pickle.dumps({"skill": 1}),
    "an archive": lambda data: b"PK\x03\x04" + data,
    "nothing": lambda data: b"",
}


@pytest.mark.parametrize("change", WEIGHTS.values(), ids=WEIGHTS)
def test_hostile_weights_under_fitting_hashes_are_refused(published, tmp_path, change):
    directory = tmp_path / "agent"
    shutil.copytree(published, directory)
    weights = directory / "model.safetensors"
    weights.write_bytes(change(weights.read_bytes()))
    reseal(directory)
    refused(DDSAgent.load, directory)
    assert not (tmp_path.parent / "outside").exists()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(published, tmp_path, value):
    directory = tmp_path / "agent"
    shutil.copytree(published, directory)
    state = safetensors.torch.load_file(directory / "model.safetensors")
    state["skill.decoder.net.output.weight"][0, 0] = value
    safetensors.torch.save_file(state, directory / "model.safetensors", metadata={"format": "pt"})
    reseal(directory)
    refused(DDSAgent.load, directory)


CONFIGS = {
    "a module that is code": {"skill": {"_instantiator": "os.system", "class_path": "os.system"}},
    "a width of another kind": {"skill": {"observation_dim": "four"}},
    "a negative width": {"skill": {"hidden_dim": -16}},
    "a huge width": {"skill": {"hidden_dim": 10**12}},
    "an unknown setting": {"skill": {"surprise": 1}},
    "a newer format": {"format_version": 99},
    "a format that is text": {"format_version": "one"},
    "no skill": {"skill": None},
    "a selection nobody knows": {"agent": {"selection": "best"}},
    "an agent setting nobody knows": {"agent": {"selection": "sample", "surprise": 1}},
}


@pytest.mark.parametrize("change", CONFIGS.values(), ids=CONFIGS)
def test_hostile_settings_under_fitting_hashes_are_refused(published, tmp_path, change):
    directory = tmp_path / "agent"
    shutil.copytree(published, directory)
    config = yaml.safe_load((directory / "config.yaml").read_text())
    for key, value in change.items():
        config[key] = {**config[key], **value} if isinstance(value, dict) and key == "skill" else value
    if "_instantiator" in (config.get("skill") or {}):
        del config["skill"]["class_path"]
        (directory / "config.yaml").write_text(yaml.safe_dump(config))
        reseal(directory)
        DDSAgent.load(directory)  # names of code are never followed
        config["skill"]["class_path"] = "os.system"
    (directory / "config.yaml").write_text(yaml.safe_dump(config))
    reseal(directory)
    refused(DDSAgent.load, directory)


@pytest.mark.parametrize(
    "text", ["!!python/object/apply:os.mkdir [ran]", "- 1\n- 2", "a: &a [*a]", "\x00", "[" * 10_000]
)
def test_settings_that_are_no_plain_yaml_are_refused(published, tmp_path, text):
    directory = tmp_path / "agent"
    shutil.copytree(published, directory)
    (directory / "config.yaml").write_text(text)
    reseal(directory)
    refused(DDSAgent.load, directory)
    assert not Path("ran").exists()


# ---------------------------------------------------------------- Lightning's files


class Payload:
    """Makes a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("ran",)


def test_the_payload_is_real(tmp_path):
    pickle.loads(pickle.dumps(Payload()))
    assert Path("ran").is_dir()


@pytest.mark.parametrize("place", ["state_dict", "hyper_parameters", "callbacks", "surprise"])
def test_a_pickled_payload_in_a_checkpoint_is_refused_and_never_run(checkpoint, tmp_path, place):
    content = torch.load(checkpoint, weights_only=True)
    torch.save({**content, place: Payload()}, tmp_path / "hostile.ckpt")
    refused(SkillModule.load, tmp_path / "hostile.ckpt")
    assert not Path("ran").exists()


def test_a_bare_pickle_and_an_old_style_file_are_refused_and_never_run(checkpoint, tmp_path):
    (tmp_path / "bare.ckpt").write_bytes(pickle.dumps(Payload()))
    refused(SkillModule.load, tmp_path / "bare.ckpt")
    content = {**torch.load(checkpoint, weights_only=True), "surprise": Payload()}
    torch.save(content, tmp_path / "old.ckpt", _use_new_zipfile_serialization=False)
    refused(SkillModule.load, tmp_path / "old.ckpt")
    assert not Path("ran").exists()


def test_truncated_checkpoints_are_refused(checkpoint, tmp_path):
    data = checkpoint.read_bytes()
    rng = random.Random(0)
    for cut in (0, 1, 100, len(data) - 1, *(rng.randrange(len(data)) for _ in range(16))):
        (tmp_path / "cut.ckpt").write_bytes(data[:cut])
        refused(SkillModule.load, tmp_path / "cut.ckpt")


def test_a_changed_byte_of_a_checkpoint_is_refused_or_changes_nothing(checkpoint, tmp_path):
    """Its story: torch reads a zip file without looking at its checksums, so changed weights loaded silently."""
    data, rng = checkpoint.read_bytes(), random.Random(1)
    expected = torch.load(checkpoint, weights_only=True)["state_dict"]
    outcomes = {"refused": 0, "equal": 0}
    for _ in range(80):
        (tmp_path / "flipped.ckpt").write_bytes(flipped(data, rng))
        try:
            found = SkillModule.load(tmp_path / "flipped.ckpt")
        except UserError:
            outcomes["refused"] += 1
            continue
        assert all(torch.equal(value, found.state_dict()[name]) for name, value in expected.items())
        outcomes["equal"] += 1
    assert outcomes["refused"] > 40, outcomes


def test_members_with_path_names_in_a_checkpoint_write_nothing(checkpoint, tmp_path):
    buffer = io.BytesIO(checkpoint.read_bytes())
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr("../../outside", "text")
    (tmp_path / "paths.ckpt").write_bytes(buffer.getvalue())
    with contextlib.suppress(UserError):
        SkillModule.load(tmp_path / "paths.ckpt")
    assert not (tmp_path.parent / "outside").exists()


def test_the_package_unpickles_nothing_that_comes_from_outside():
    """Only the environments' workers do, what their own caller sent them through a private pipe."""
    unsafe = re.compile(
        r"pickle\.loads?\(|allow_pickle=True|weights_only=False|torch\.jit\.load|yaml\.(unsafe_)?load\("
    )
    root = Path(__file__).parents[2]
    sources = [path for package in ("dds_lightning", "datamodules") for path in (root / package).rglob("*.py")]
    found = {str(path.relative_to(root)) for path in sources if unsafe.search(path.read_text(encoding="utf-8"))}
    assert found == {"dds_lightning/envs/worker.py"}
