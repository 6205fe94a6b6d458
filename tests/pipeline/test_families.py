"""`dds run TASK --data d4rl:FILE` and `--data minari:ID` for every row of the papers' table, on files of real steps.

One whole tiny run a family; for every row and both layouts loading, a step of each training and an episode.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from datamodules.relabelled import RelabeledDataModule
from datamodules.segments import SegmentDataModule
from datamodules.trajectories import DataError
from dds_lightning import DDSAgent, tasks
from dds_lightning.cli import main
from dds_lightning.configs import run_defaults
from dds_lightning.interpret.draw import clip
from dds_lightning.pipeline import settings as run_settings
from dds_lightning.policy import PolicyModule
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.skill import SkillModule
from dds_lightning.study import report
from dds_lightning.study.contestants import way_name
from dds_lightning.tasks import get_task, task_names
from tests.minari_recordings import write_minari_set
from tests.recordings import record, write_d4rl_file

ROWS = [name for name in task_names() if get_task(name).family != "pointmaze"]
CAP = 12
"""Steps of an evaluation episode here; the tasks' own caps take minutes."""
TINY = ["--clone_steps=10", "--episodes=2", "--episodes_per_skill=1", "--workers=0", "--seed=1"]
TINY += [f"--{stage}.{word}" for stage in ("skill", "policy") for word in (
    "trainer.max_steps=20", "trainer.accelerator=cpu", "data.validation_fraction=0.3", "data.batch_size=16",
    "trainer.val_check_interval=10", "trainer.log_every_n_steps=10",
)]  # fmt: skip
TINY += ["--skill.model.num_skills=2", "--skill.model.hidden_dim=16", "--skill.model.skill_dim=8"]
TINY += ["--skill.model.encoder_layers=1", "--skill.model.encoder_heads=2", "--skill.model.decoder_blocks=1"]
TINY += ["--policy.model.hidden_dims=[16]"]


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    """The task table with episodes of a few steps (variants follow their row), few of them, and small pictures."""
    monkeypatch.setattr(run_settings, "WATCH_EPISODES", 2)
    monkeypatch.setattr(report, "DPI", 30)
    monkeypatch.setattr(clip, "write_clip", functools.partial(clip.write_clip, frames=3, fps=2))
    for name in ROWS:
        monkeypatch.setitem(tasks._TABLE, name, replace(get_task(name), max_episode_steps=CAP))


@functools.cache
def recorded(env_id, name):
    """Two short episodes of a world; tasks of one world share them."""
    return record(get_task(name), 70, seed=3, episode_steps=35)


def write(layout, folder, name, monkeypatch):
    """A small file of real steps, and what to type after `--data`.

    Args:
        layout: "d4rl" for the row as it is, "minari" for what Minari publishes of it: the AntMazes there are
            gymnasium-robotics'.
    """
    task = get_task(name)
    if layout == "d4rl":
        return f"d4rl:{write_d4rl_file(folder / 'data.hdf5', task, recorded(task.env_id + str(task.subtasks), name))}"
    recorder = task.variant("robotics") if task.family == "antmaze" else task
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    episodes = recorded(recorder.env_id + str(task.subtasks), recorder.name)
    write_minari_set(folder, f"{name}-v0", recorder, episodes)
    return f"minari:{name}-v0"


# -------------------------------------------------------------------- one whole run a family


def run(*words):
    """`dds run ... --json` in this process: what it printed."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["run", *map(str, words), *TINY, "--json"]) == 0
    return json.loads(out.getvalue())


WHOLE = [
    ("hopper-medium", "d4rl", "hopper-medium@v4", "Hopper-v4"),
    ("antmaze-umaze", "d4rl", "antmaze-umaze@d4rl", "dds/AntMazeD4RL_UMaze-v0"),
    ("antmaze-medium-play", "minari", "antmaze-medium-play@robotics", "AntMaze_Medium-v4"),
    ("kitchen-partial", "d4rl", "kitchen-partial", "FrankaKitchen-v1"),
]


@pytest.mark.parametrize(("name", "layout", "variant", "env_id"), WHOLE, ids=[f"{row[0]}-{row[1]}" for row in WHOLE])
def test_a_whole_run_from_a_published_layout_to_the_report(name, layout, variant, env_id, tmp_path, monkeypatch, capfd):
    task = get_task(name)
    said = run(name, "--data", write(layout, tmp_path, name, monkeypatch), "--out", tmp_path / "run")
    told = capfd.readouterr().err
    assert (f"evaluating in {variant} ({env_id})" in told) == (layout == "minari")

    how, preset = said["protocol"], run_defaults(task.family)
    noise = 1.0 if preset["noise_scale"] is None else preset["noise_scale"]
    assert (how["task"], how["environment"], how["checkpoint"]) == (variant, env_id, "last")
    assert (how["episodes"], how["seed"], how["noise_scale"], how["sampler"], how["horizon"]) == (
        2,
        1,
        noise,
        "ddpm",
        10,
    )
    assert (how["score_min"], how["score_max"]) == (task.score_min, task.score_max)
    assert how["paper_score"] == task.paper_score
    assert how["best"]["monitor"] == "rollout/score"
    assert (how["best"]["evaluations"], how["best"]["step"] % 5) == (4, 0)

    rows = {row["contestant"]: row for row in said["table"]}
    label = f"(best of 4 evaluations while training, step {how['best']['step']}: optimistic)"
    assert f"AWR policy, sampled {label}" in rows
    assert f"AWR policy, greedy {label}" in rows
    assert next(iter(rows)) == said["main"] == way_name(preset["selection"])
    assert "behaviour cloning" in rows
    main_row = rows[said["main"]]
    expected = task.normalised_score(main_row["return"])
    assert main_row["score"] == pytest.approx(float(expected), abs=1e-2)
    assert (main_row["success"] is None) == (task.family == "locomotion")
    assert said["diagnosis"]["scores"][0]["who"] == "the data, mean episode"
    assert {row["measure"] for row in said["diagnosis"]["measures"]} >= {"AWR weights that are clipped, %"}

    page = (tmp_path / "run" / "report" / "report.md").read_text()
    card = (tmp_path / "run" / "agent" / "README.md").read_text()
    for text in (page, card):
        assert ("success" in text) == (task.maze_map is not None or "(median, successes)" in text)
        assert "The paper reports" in text
        assert "scripted controller" not in text
    assert f"{variant} ({env_id}): 2 episodes each, seed 1, last checkpoint, decoder noise {noise:g} (ddpm)" in page
    pictures = {path.name for path in (tmp_path / "run" / "report").glob("*.png")}
    maze = {"trajectories.png", "failed_ends.png", "values.png"}
    assert pictures & {*maze, "scores.png"} == (maze if task.maze_map is not None else {"scores.png"})
    assert ("failures_table" in said["outputs"]["report"]) == task.measures_success

    agent = DDSAgent.load(tmp_path / "run" / "agent")
    assert agent.act(np.zeros(task.observation_dim, np.float32)).shape == (task.action_dim,)
    if task.family == "locomotion":  # once is enough: from here on all families go one way
        _last_and_best_are_evaluated_again(tmp_path / "run", variant, task)


def _last_and_best_are_evaluated_again(folder, variant, task):
    def evaluate(*words):
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            status = main(
                ["evaluate", str(folder), "--episodes=1", "--workers=0", "--selection=[sample]", *words, "--json"]
            )
        return status, json.loads(out.getvalue() or "null")

    status, both = evaluate()
    assert status == 0
    assert [row["checkpoint"] for row in both["results"]] == ["last", "best"]
    assert both["protocol"]["checkpoint"] == "last and best"
    assert both["protocol"]["task"] == variant
    assert [row["success"] is None for row in both["results"]] == [not task.measures_success] * 2
    _, best = evaluate("--checkpoint=best")
    assert [row["actor"] for row in best["results"]] == [both["results"][1]["actor"]]
    _, last = evaluate("--checkpoint=last")
    assert last["protocol"]["best"] is None


# -------------------------------------------------------------------- every row, both layouts


def test_the_policys_data_module_also_takes_the_variant_of_the_data(tmp_path, monkeypatch):
    name = "antmaze-umaze"
    task = get_task(name)
    skill = SkillModule(
        task.observation_dim, task.action_dim, horizon=5, num_skills=2, skill_dim=4, hidden_dim=8, encoder_layers=1,
        encoder_heads=2, decoder_blocks=1,
    )  # fmt: skip
    skill.normaliser.fit(torch.zeros(29), torch.ones(29))
    DDSAgent(skill, selection="random").save(tmp_path / "skill")
    spec = write("minari", tmp_path, name, monkeypatch)
    data = RelabeledDataModule(name, spec, str(tmp_path / "skill"), cache=str(tmp_path / "cache"))
    assert data.task == task
    data.prepare_data()
    data.setup()
    assert data.task.name == "antmaze-umaze@robotics"
    pinned = RelabeledDataModule(f"{name}@d4rl", spec, str(tmp_path / "skill"), cache=str(tmp_path / "cache"))
    with pytest.raises(DataError, match="AntMaze_UMaze-v4"):
        pinned.prepare_data()


@pytest.mark.filterwarnings("ignore:.*shorter than horizon.*")
@pytest.mark.parametrize("layout", ["d4rl", "minari"])
@pytest.mark.parametrize("name", ROWS)
def test_every_row_loads_learns_and_plays_from_both_layouts(name, layout, tmp_path, monkeypatch):
    data = SegmentDataModule(name, write(layout, tmp_path, name, monkeypatch), horizon=5, batch_size=8)
    data.setup()
    assert data.task is not None
    assert data.task.physics == (
        "robotics" if layout == "minari" and data.task.family == "antmaze" else get_task(name).physics
    )
    skill = SkillModule(
        data.observation_dim, data.action_dim, horizon=5, num_skills=2, skill_dim=4, hidden_dim=8, encoder_layers=1,
        encoder_heads=2, decoder_blocks=1, dropout=0.0,
    )  # fmt: skip
    statistics = data.statistics()
    skill.normaliser.fit(statistics["observation_mean"], statistics["observation_std"])
    skill.action_box.fit(statistics["action_low"], statistics["action_high"])
    batch = next(iter(data.train_dataloader()))
    before = [value.clone() for value in skill.parameters()]
    optimiser = torch.optim.Adam(skill.parameters(), 1e-2)
    loss, _, _ = skill.loss(batch)
    loss.backward()
    optimiser.step()
    assert torch.isfinite(loss)
    assert any(not torch.equal(old, new) for old, new in zip(before, skill.parameters(), strict=True))

    policy = PolicyModule(data.observation_dim, 2, hidden_dims=[8])
    policy.normaliser.fit(statistics["observation_mean"], statistics["observation_std"])
    players = [Contestant("untrained", DDSAgent(skill, policy), 1)]
    row = rollout(data.task, players, workers=0, progress=False).episodes.iloc[0]
    assert 1 <= row["length"] <= CAP
    assert row["score"] == pytest.approx(float(data.task.normalised_score(row["return"])))
    assert pd.isna(row["success"]) == (data.task.family == "locomotion")
