"""A published directory is what it says it is, or the first thing wrong is named."""

import shutil
from pathlib import Path

import pytest
import safetensors.torch
import yaml

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.saving.files import sha256
from dds_lightning.saving.published import CONTENTS, SUMS
from dds_lightning.sharing.verify import find_published, verify_published

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
