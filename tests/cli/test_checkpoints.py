"""`dds publish`, `dds checkpoints` and `dds export` in-process."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from dds_lightning import DDSAgent
from dds_lightning.skill import SkillModule
from tests.saving.test_hub import FolderHub

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "pointmaze-large"


def refused(answer, *parts):
    status, out, err = answer
    assert status == 2
    assert out == ""
    assert err.startswith("dds: error: ")
    assert len(err.splitlines()) == 1
    for part in parts:
        assert part in err


def test_a_published_agent_keeps_scores_card_and_task_and_is_sound(dds):
    status, out, _ = dds("publish", SHIPPED, "copy", "--json")
    assert status == 0
    assert json.loads(out)["task"] == "pointmaze-large-diverse"
    assert Path("copy/README.md").read_bytes() == (SHIPPED / "README.md").read_bytes()
    assert json.loads(Path("copy/metrics.json").read_text()) == json.loads((SHIPPED / "metrics.json").read_text())
    assert DDSAgent.load("copy").golden() == DDSAgent.load(SHIPPED).golden()
    status, out, _ = dds("checkpoints", "verify", "copy")
    assert status == 0
    assert out.startswith("copy is sound: task pointmaze-large-diverse")
    assert "answers as published" in out


def test_checkpoints_of_separate_stages_can_be_published(dds):
    torch.manual_seed(0)
    skill = SkillModule(4, 2, num_skills=4, skill_dim=8, hidden_dim=16, encoder_layers=1, encoder_heads=2)
    skill.normaliser.fit(torch.zeros(4), torch.ones(4))
    skill.bottleneck.start_from(torch.randn(32, 8))
    state = {"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}
    torch.save({**state, "pytorch-lightning_version": "2.6.6"}, "skill.ckpt")
    status, out, _ = dds("publish", "-", "alone", "--skill", "skill.ckpt", "--json")
    assert status == 0
    assert json.loads(out)["num_skills"] == 4
    agent = DDSAgent.load("alone")
    assert agent.selection == "random"
    assert agent.policy is None


def test_another_agent_is_replaced_only_where_that_is_asked_for(dds):
    """The same agent may be published once more, for example with another card."""
    torch.manual_seed(0)
    for name in ("mine", "other"):
        skill = SkillModule(4, 2, num_skills=4, skill_dim=8, hidden_dim=16, encoder_layers=1, encoder_heads=2)
        DDSAgent(skill, selection="random").save(name)
    Path("card.md").write_text("# Mine\n")
    assert dds("publish", "mine", "shared")[0] == 0
    assert dds("publish", "mine", "shared", "--card", "card.md")[0] == 0
    refused(dds("publish", "other", "shared"), "shared holds another published agent", "or give --replace")
    assert Path("shared/README.md").read_text() == "# Mine\n"
    assert dds("publish", "other", "shared", "--replace")[0] == 0
    assert DDSAgent.load("shared").golden() == DDSAgent.load("other").golden()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["publish", "-", "out"], ["run is '-' and --skill is None"]),
        (["publish", SHIPPED, "out", "--policy", "p.ckpt"], ["--policy is p.ckpt without --skill"]),
        (["publish", SHIPPED, "out", "--task", "nothing"], ["there is no task 'nothing'"]),
        (["publish", SHIPPED, "out", "--card", "none.md"], ["--card: none.md cannot be read"]),
        (["publish", "nowhere", "out"], ["there is no folder nowhere"]),
        (["checkpoints", "verify", "nowhere"], ["there is no published checkpoint nowhere"]),
        (["export", SHIPPED, "--selection", "random"], ["selection"]),
    ],
)
def test_mistakes_are_one_sentence_and_write_nothing(dds, words, parts):
    refused(dds(*words), *parts)
    assert not list(Path().iterdir())


def test_a_changed_directory_is_named_and_listed_with_its_problem(dds):
    shutil.copytree(SHIPPED, "runs/changed")
    Path("runs/changed/metrics.json").write_text("{}")
    refused(dds("checkpoints", "verify", "runs/changed"), "metrics.json is not the file that was published")
    status, out, _ = dds("checkpoints", "list", "--json")
    assert status == 0
    (row,) = json.loads(out)
    assert row["checkpoint"] == "runs/changed"
    assert "metrics.json" in row["problem"]


def test_an_empty_list_says_what_makes_one(dds):
    status, out, _ = dds("checkpoints", "list")
    assert status == 0
    assert "no published agents in checkpoints, runs; `dds run` and `dds publish` make some" in out


def test_publishing_to_the_hub_and_back(dds, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", FolderHub(tmp_path / "hub"))
    status, out, _ = dds("publish", SHIPPED, "hf:somebody/maze")
    assert status == 0
    assert 'DDSAgent.load("hf:somebody/maze")' in out
    assert DDSAgent.load("hf:somebody/maze").golden() == DDSAgent.load(SHIPPED).golden()
    assert dds("checkpoints", "verify", "hf:somebody/maze")[0] == 0


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")),
    reason="needs the extra 'export'",
)
def test_export_writes_one_file_and_says_how_fast_it_acts(dds):
    status, out, _ = dds("export", SHIPPED, "--json")
    assert status == 0
    said = json.loads(out)
    assert said["file"] == "pointmaze-large.onnx"
    assert [path.name for path in Path().iterdir()] == ["pointmaze-large.onnx"]
    assert said["difference"] <= 1e-5
    assert said["file_ms"]["median"] > 0
    assert (said["horizon"], said["task"]) == (10, "pointmaze-large-diverse")
