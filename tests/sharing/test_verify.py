"""A published directory is what it says it is, or the first thing wrong is named."""

import json
import math
import os
import shutil
import struct
import time
from pathlib import Path

import pytest
import safetensors.torch
import yaml

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.saving.files import sha256
from dds_lightning.saving.published import CONTENTS, SUMS
from dds_lightning.sharing.verify import cpu_budget, find_published, verify_published

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "pointmaze-large"


@pytest.fixture
def copy(tmp_path):
    """A published copy of the shipped agent, with its golden answers."""
    return DDSAgent.load(SHIPPED).save(tmp_path / "agent", task="pointmaze-large-diverse")


def reseal(directory):
    """What somebody does who changes a file and writes the sums anew."""
    (directory / SUMS).write_text("".join(f"{sha256(directory / name)}  {name}\n" for name in CONTENTS))


def test_a_sound_directory_tells_what_it_holds(copy):
    facts = verify_published(copy)
    assert facts["task"] == "pointmaze-large-diverse"
    assert (facts["horizon"], facts["num_skills"]) == (10, 16)
    assert facts["golden"] < 1e-5
    assert facts["parameters"] > 100_000


def test_changed_weights_are_noticed_by_their_answers_even_under_new_hashes(copy):
    state = safetensors.torch.load_file(copy / "model.safetensors")
    state["skill.decoder.net.output.bias"] += 0.01
    safetensors.torch.save_file(state, copy / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(UserError, match=r"model.safetensors is not the file that was published"):
        verify_published(copy)
    reseal(copy)
    with pytest.raises(UserError, match=r"golden, actions: this installation answers .* apart"):
        verify_published(copy)


@pytest.mark.parametrize(
    ("golden", "message"),
    [
        ({"actions": [[0.0, 0.0]]}, r"golden, actions: found shape \(1, 2\), expected \(8, 2\)"),
        ({}, "golden, actions: expected a table of numbers"),
        ({"actions": "much"}, "golden, actions: expected a table of numbers"),
    ],
)
def test_golden_answers_that_are_none_are_refused(copy, golden, message):
    config = yaml.safe_load((copy / "config.yaml").read_text())
    (copy / "config.yaml").write_text(yaml.safe_dump({**config, "golden": golden}))
    reseal(copy)
    with pytest.raises(UserError, match=message):
        verify_published(copy)


def test_a_directory_of_an_older_version_has_no_golden_answers(copy):
    config = yaml.safe_load((copy / "config.yaml").read_text())
    del config["golden"]
    (copy / "config.yaml").write_text(yaml.safe_dump(config))
    reseal(copy)
    assert verify_published(copy)["golden"] is None


def test_golden_answers_do_not_depend_on_how_the_agent_acts(copy):
    agent = DDSAgent.load(copy)
    assert agent.golden() == agent.variant("greedy", noise_scale=0.1, seed=9).golden()


def test_the_list_names_every_directory_and_what_is_wrong_with_it(copy, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(copy, broken)
    (broken / "README.md").write_text("changed")
    found = find_published([tmp_path]).set_index("checkpoint")
    assert len(found) == 2
    assert found.loc[str(copy), "problem"] == ""
    assert found.loc[str(copy), "task"] == "pointmaze-large-diverse"
    assert "README.md is not the file" in found.loc[str(broken), "problem"]


def test_an_empty_folder_lists_nothing(tmp_path):
    assert find_published([tmp_path]).empty


# ---------------------------------------------------------------- what only looks sound


def tampered(copy, **changes):
    """The published copy with other entries in config.yaml, under hashes that fit."""
    config = yaml.safe_load((copy / "config.yaml").read_text())
    for name, value in changes.items():
        part, _, entry = name.partition("__")
        config[part] = {**config[part], entry: value} if entry else value
    (copy / "config.yaml").write_text(yaml.safe_dump(config))
    reseal(copy)
    return copy


UNSOUND = {
    "temperature NaN": ({"agent__temperature": float("nan")}, "temperature is nan, expected more than 0"),
    "temperature infinite": ({"agent__temperature": float("inf")}, "temperature is inf"),
    "temperature a text": ({"agent__temperature": "hot"}, "temperature is 'hot', expected another kind"),
    "noise NaN": ({"agent__noise_scale": float("nan")}, "noise_scale is nan"),
    "codes out of range": ({"agent__fixed_codes": [0, 16]}, "fixed_codes is .*expected a list of codes of 0 to 15"),
    "codes of no kind": ({"agent__fixed_codes": {"a": 1}}, "fixed_codes is"),
    "agent a list": ({"agent": [1]}, "agent holds a list"),
    "an agent's name of no kind": ({"agent__selection": ["sample"]}, "selection is"),
    "a task that is a path": ({"task": "../../etc/passwd"}, "task is '../../etc/passwd', expected the name of a task"),
    "a task that is a file": ({"task": "mine.yaml"}, "task is 'mine.yaml'"),
    "a task that is a module": ({"task": "os:system"}, "task is 'os:system'"),
    "a task that is a mapping": ({"task": {"a": 1}}, "expected the name of a task"),
    "a billion blocks": ({"skill__decoder_blocks": 10**9}, r"decoder_blocks to 1,000,000,000, expected at most"),
    "a billion layers": ({"skill__encoder_layers": 10**9}, "encoder_layers to 1,000,000,000, expected at most"),
    "a long list of layers": ({"policy__hidden_dims": [8] * 10**4}, "hidden_dims to 10000 layers"),
    "a billion wide": ({"skill__hidden_dim": 10**9}, "hidden_dim to 1,000,000,000, expected at most"),
    "a billion features": ({"policy__fourier_features": 10**9}, "fourier_features to 1,000,000,000"),
    "a million denoising steps": ({"skill__diffusion_steps": 10**6}, "diffusion_steps to 1,000,000, expected at most"),
    "another file to start from": ({"skill__init_from": "/etc/passwd"}, "sets init_from to '/etc/passwd'"),
}


@pytest.mark.parametrize("case", UNSOUND)
def test_what_only_looks_sound_is_not_called_so(copy, case):
    changes, message = UNSOUND[case]
    with pytest.raises(UserError, match=message):
        verify_published(tampered(copy, **changes))


LAUGHS = "golden: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)


def alias_bomb(copy):
    (copy / "config.yaml").write_text((copy / "config.yaml").read_text().replace("golden:", "older:") + LAUGHS)


def task_bomb(copy):
    text = (copy / "config.yaml").read_text().replace("task:", "former:") + LAUGHS.replace("golden", "bomb")
    (copy / "config.yaml").write_text(f"{text}task: *a11\n")


def empty_tensors(copy):
    entries = {f"t{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(800_000)}
    header = json.dumps(entries).encode()
    (copy / "model.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)


def sparse_weights(copy):
    with (copy / "model.safetensors").open("wb") as file:
        file.truncate(2**40)


def endless_metrics(copy):
    (copy / "metrics.json").unlink()
    (copy / "metrics.json").symlink_to("/dev/zero")


def pipe(copy):
    (copy / "config.yaml").unlink()
    os.mkfifo(copy / "config.yaml")


BOMBS = [alias_bomb, task_bomb, empty_tensors, sparse_weights, endless_metrics, pipe]


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_in_a_moment(copy, bomb):
    bomb(copy)
    if bomb in (alias_bomb, task_bomb, empty_tensors):
        reseal(copy)
    before = time.process_time()
    with pytest.raises(UserError, match=str(copy)):
        verify_published(copy)
    assert time.process_time() - before < 5


def test_a_link_out_of_the_directory_is_not_followed(copy, tmp_path):
    (tmp_path / "secret.md").write_text("secret")
    (copy / "README.md").unlink()
    (copy / "README.md").symlink_to("../secret.md")
    reseal(copy)
    with pytest.raises(UserError, match=r"README\.md is a link to .*secret\.md, outside of"):
        verify_published(copy)


def test_links_into_the_cache_of_the_hub_are_followed(copy, tmp_path):
    """The Hub's client keeps a snapshot as links to files that several revisions share."""
    snapshot = tmp_path / "models--somebody--agent" / "snapshots" / "abc"
    blobs = tmp_path / "models--somebody--agent" / "blobs"
    snapshot.mkdir(parents=True)
    blobs.mkdir()
    for path in copy.iterdir():
        shutil.move(path, blobs / path.name)
        (snapshot / path.name).symlink_to(f"../../blobs/{path.name}")
    assert verify_published(snapshot)["num_skills"] == 16


def test_work_without_end_is_stopped():
    def endless():
        while True:
            math.sqrt(2.0)

    before = time.process_time()
    with pytest.raises(UserError, match="too much"), cpu_budget(0.2, "too much"):
        endless()
    assert time.process_time() - before < 2
    for _ in range(10**6):  # and the clock has stopped
        pass
