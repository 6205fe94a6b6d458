"""`dds atlas` in-process: from a published directory, a run's skills and a checkpoint; mistakes in one sentence."""

import functools
import json
import shutil
from pathlib import Path

import pytest
import torch

from dds_lightning.interpret.atlas import pictures as atlas_pictures
from dds_lightning.study import subject as atlas
from dds_lightning.tasks import get_task
from tests.interpret.tiny import hold_shorter, recorded, tiny_agent, tiny_skill

TASK = get_task("pointmaze-umaze-diverse")


@pytest.fixture(scope="module", autouse=True)
def _small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atlas_pictures, "DPI", 30)
        hold_shorter(patch, pointmaze=0.1)
        patch.setattr(atlas, "make_atlas", functools.partial(atlas.make_atlas, states=3))
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A published agent and data of its task."""
    root = tmp_path_factory.mktemp("atlas")
    recorded(TASK, 60).save(root / "data")
    tiny_agent(TASK).save(root / "agent", task=TASK.name)
    return root


def checkpoint(path, skill):
    """What a training of skills leaves behind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {"state_dict": skill.state_dict(), "hyper_parameters": dict(skill.hparams)}
    torch.save({**state, "pytorch-lightning_version": "2.6.6"}, path)
    return path


def test_a_published_agent_has_its_page_where_it_was_asked_for(dds, place):
    words = ("--episodes", "0", "--out", "my.html", "--figures", "pictures")
    status, out, err = dds("atlas", place / "agent", "--data", place / "data", *words)
    assert status == 0, err
    assert "my.html" in out
    assert "found again" in out
    assert "reading the data" in err  # what it is doing, where there is no bar
    text = Path("my.html").read_text(encoding="utf-8")
    assert "Skill atlas: pointmaze-umaze-diverse" in text
    assert "--episodes" not in text.split("<footer>")[0]
    assert str(place) not in text  # others read it: the folders of its maker are not for them
    assert "<code>dds atlas agent --data arrays:data " in text
    assert sorted(path.name for path in Path().iterdir()) == ["my.html", "pictures"]
    pictures = sorted(path.name for path in Path("pictures").iterdir())
    assert len(pictures) == text.count("<figure ")
    assert {"my-starts-by-skill.png", "my-recovery.png", "my-values.png", "my-diversity.png"} <= set(pictures)
    assert not [entry for entry in (place / "agent").iterdir() if entry.suffix == ".html"]


def test_a_run_with_skills_alone_knows_its_data_and_compares_with_others(dds, place, tmp_path):
    run = tmp_path / "run"
    checkpoint(run / "skill" / "last.ckpt", tiny_skill(TASK))
    (run / "skill" / "stage.json").write_text(json.dumps({"state": "finished"}))
    (run / "data").mkdir()
    settings = {"task": TASK.name, "data": f"arrays:{place / 'data'}"}
    (run / "data" / "stage.json").write_text(json.dumps({"settings": settings}))
    other = checkpoint(tmp_path / "gaussian.ckpt", tiny_skill(TASK, bottleneck="gaussian"))
    status, out, err = dds("atlas", run, "--episodes=0", f"--against=[{other}]", "--json")
    assert status == 0, err
    facts = json.loads(out)
    assert facts["task"] == TASK.name
    assert [row["kind"] for row in facts["comparison"]] == ["discrete", "continuous"]
    assert facts["recovery"]["states"] == 3
    assert Path(facts["atlas"]).name == "atlas.html"
    (run / "skill" / "stage.json").write_text(json.dumps({"state": "started"}))
    status, _, err = dds("atlas", run)
    assert status == 2
    assert "whose skills are not trained yet" in err


@pytest.mark.parametrize(
    ("place", "shown"),
    [
        ("{here}/runs/hop", "runs/hop"),
        ("runs/hop", "runs/hop"),
        ("../data", "../data"),
        ("/home/anna/secret/hop", "hop"),
        ("/home/anna/.cache/hub/models--anna--my-hop/snapshots/12ab", "hf:anna/my-hop@12ab"),
    ],
)
def test_a_page_names_no_folder_of_its_makers_machine(place, shown):
    assert atlas._shown(place.format(here=Path.cwd())) == shown


def refused(answer, *parts):
    status, out, err = answer
    assert status == 2
    assert out == ""
    errors = [line for line in err.splitlines() if line.startswith("dds: error: ")]
    assert len(errors) == 1
    for part in parts:
        assert part in errors[0]
    assert not list(Path().glob("*.html"))


def test_mistakes_are_told_in_one_sentence(dds, place, tmp_path):
    agent, data = place / "agent", place / "data"
    refused(dds("atlas", "nowhere"), "there is no nowhere", "a run of `dds run`")
    refused(dds("atlas", agent, "--data", data, "--out", "atlas.png"), "--out is atlas.png", ".html")
    refused(dds("atlas", agent, "--data", data, "--episodes", "-1"), "--episodes is -1")
    refused(
        dds("atlas", agent, "--data", data, "--figures", agent / "config.yaml"), "--figures is", "expected a folder"
    )
    refused(dds("atlas", agent), "does not know its data: give --data")
    alone = checkpoint(tmp_path / "alone" / "skill.ckpt", tiny_skill(TASK))
    refused(dds("atlas", alone, "--data", data), "does not say which task", "--task")
    ant = ("--task", "antmaze-umaze")
    refused(dds("atlas", agent, "--data", data, *ant), "antmaze-umaze")
    wide = checkpoint(tmp_path / "alone" / "wide.ckpt", tiny_skill(get_task("hopper-medium")))
    refused(dds("atlas", agent, "--data", data, f"--against=[{wide}]"), "observation_dim 11")
    shutil.copytree(agent, tmp_path / "cut")
    (tmp_path / "cut" / "model.safetensors").unlink()
    refused(dds("atlas", tmp_path / "cut", "--data", data), "neither a finished run")
