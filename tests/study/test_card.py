"""The card tells what a stranger must know before using an agent."""

import re
from pathlib import Path

import pandas as pd
import pytest

from dds_lightning.study.card import agent_card, with_diagnosis
from dds_lightning.tasks import get_task

SHIPPED = Path(__file__).parents[2] / "checkpoints"
SETTINGS = {
    "skill": {
        "model": {"num_skills": 16, "skill_dim": 64},
        "trainer": {"max_steps": 2500},
        "data": {"batch_size": 128, "horizon": 10},
    },
    "policy": {"model": {"tau": 0.9}, "trainer": {"max_steps": 12000}, "data": {"batch_size": 256}},
}


def card(name, source, success=(True, True, True, False, False, False)):
    actors = ["AWR policy, sampled"] * 4 + ["random skills"] * 2
    episodes = pd.DataFrame(
        {
            "actor": actors,
            "label": actors,
            "episode": [0, 1, 2, 3, 0, 1],
            "success": pd.array(success, dtype="boolean"),
            "score": [100.0, 100.0, 100.0, 0.0, 0.0, 0.0],
            "return": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
            "length": [300, 310, 320, 800, 800, 800],
        }
    )
    data = {"source": source, "steps": 1000}
    return agent_card(
        get_task(name), episodes, seed=3, data=data, settings=SETTINGS, command=f"dds run {name} --seed=3"
    )


def test_the_card_names_task_score_seed_data_settings_and_command():
    text = card("pointmaze-large-diverse", "collected by `dds data collect`")
    for part in (
        "AWR policy, sampled: 75.0 % of\n4 episodes",
        "95 % interval 30.1 to 95.4",
        "seed 3",
        "- steps: 1000",
        "skill: 2,500 steps, batches of 128; num_skills 16",
        "policy: 12,000 steps, batches of 256; tau 0.9",
        "`dds run pointmaze-large-diverse --seed=3`",
        "| random skills | 2 | 0.0 |",
        "made it. Presets change between versions: what this agent was trained with is what stands above.",
        "a skill every 10 steps",
        "The data come from this project's controllers: scores are not comparable",
    ):
        assert part in text or part in " ".join(text.split())
    assert max(map(len, text.splitlines())) < 200


@pytest.mark.parametrize(
    ("name", "source", "known", "whose"),
    [
        ("hopper-medium", "d4rl:hopper_medium-v2.hdf5", "one body in one physics", "D4RL's layout (d4rl:hopper_medium"),
        (
            "hopper-medium@v5",
            "minari:mujoco/hopper/medium-v0",
            "one body",
            "provided by the user who trained it (minari:mujoco",
        ),
        ("kitchen-partial", "d4rl:kitchen.hdf5", "4 subtasks (microwave, kettle, light switch, slide cabinet)", "D4RL"),
        ("antmaze-medium-play", "d4rl:ant.hdf5", "one maze, one start and one goal", "d4rl:ant.hdf5"),
        ("pointmaze-umaze-diverse", "local:mine", "one maze", "(local:mine)"),
    ],
)
def test_the_last_section_is_about_this_task_and_these_data(name, source, known, whose):
    success = [None] * 6 if name.startswith("hopper") else [True] * 3 + [False] * 3
    text = card(name, source, success)
    limits = " ".join(text.partition("## What it cannot do")[2].split())
    assert known in limits
    assert whose in limits
    assert "this project" not in text or "collected" in text
    paper = get_task(name).paper_score
    assert ("The paper reports" in text) == (paper is not None)
    if name.startswith("hopper"):
        assert "success" not in text
        assert "normalised score **75.0 ± 25.0** over 4 episodes, mean return 0.8" in text


@pytest.mark.parametrize("place", sorted(path.parent for path in SHIPPED.glob("*/config.yaml")), ids=lambda p: p.name)
def test_the_last_section_of_a_shipped_card_is_what_is_written_today(place):
    text = (place / "README.md").read_text(encoding="utf-8")
    task, source = re.search(r"get_task\(\"(.*?)\"\)", text)[1], re.search("^- source: (.*)$", text, re.MULTILINE)[1]
    success = [True] * 6 if get_task(task).measures_success else [None] * 6
    last = "## What it cannot do"
    assert text.partition(last)[2] == card(task, source, success).partition(last)[2]


def test_a_published_runs_card_says_which_stage_loses(tmp_path, monkeypatch):
    tables = {
        "scores": pd.DataFrame({"who": ["behaviour cloning"], "score": [6.7]}),
        "measures": pd.DataFrame({"measure": ["codes in use"], "value": ["16"]}),
    }
    monkeypatch.setattr("dds_lightning.study.card.Findings.read", lambda run: run)
    monkeypatch.setattr("dds_lightning.study.card.diagnose", lambda found, logs: tables)
    text = with_diagnosis(card("pointmaze-large-diverse", "collected"), tmp_path)
    assert text.index("## Scores") < text.index("## Where it loses") < text.index("## Data")
    assert "| behaviour cloning | 6.7 |" in text
    assert "| codes in use | 16 |" in text
