"""`dds run` from collecting to the report on the smallest maze, in-process: what is made, skipped and resumed."""

import contextlib
import dataclasses
import inspect
import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest
import torch

from dds_lightning import DDSAgent
from dds_lightning.cli import commands, main
from dds_lightning.errors import UserError
from dds_lightning.pipeline.settings import RunSettings, Trainings
from dds_lightning.pipeline.steps import STEPS
from dds_lightning.study import report
from dds_lightning.study.contestants import final_contestants, way_name
from dds_lightning.tasks import get_task

TASK = "pointmaze-umaze-diverse"
STAGES = ["data", "skill", "relabel", "policy", "clone", "examine", "evaluate", "report"]
SMALL = ["--data_steps=2000", "--clone_steps=20", "--episodes=2", "--episodes_per_skill=1", "--workers=1"]
SMALL += ["--skill.trainer.max_steps=20", "--skill.data.validation_fraction=0.2", "--skill.data.batch_size=32"]
SMALL += ["--skill.model.num_skills", "4", "--skill.model.hidden_dim=16", "--skill.model.skill_dim=8"]
SMALL += ["--policy.trainer.max_steps=20", "--policy.data.batch_size=32", "--policy.model.hidden_dims=[16]"]
SMALL += ["--policy.data.validation_fraction=0.2", "--skill.trainer.accelerator=cpu"]
SMALL += ["--policy.trainer.accelerator=cpu"]


def call(capsys, *words):
    capsys.readouterr()
    status = main(["run", TASK, *map(str, words), "--json"])
    out, err = capsys.readouterr()
    return status, json.loads(out) if out else None, err


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run."""
    out = tmp_path_factory.mktemp("runs") / "umaze"
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        assert main(["run", TASK, "--out", str(out), *SMALL]) == 0
    return out


def test_every_stage_leaves_a_marker_and_its_files(finished):
    markers = {name: json.loads((finished / name / "stage.json").read_text()) for name in STAGES}
    assert all(marker["state"] == "finished" for marker in markers.values())
    assert markers["skill"]["facts"]["steps"] == 20
    assert markers["skill"]["settings"]["model"]["num_skills"] == 4
    episodes = pd.read_parquet(finished / "evaluate" / "episodes.parquet")
    counts = episodes.groupby("actor").size().to_dict()
    assert counts == {
        "AWR policy, sampled": 2,
        "AWR policy, greedy": 2,
        "AWR policy, sampled at temperature 0.5": 2,
        "argmax-Q": 2,
        "random skills": 2,
        "the data's choice of skills (alpha 0)": 2,
        "single skill": 4,
        "behaviour cloning": 2,
        "the data's controller": 2,
    }
    evidence = set(markers["examine"]["facts"])
    assert evidence >= {"terminates", "codes_used", "fidelity", "fidelity_clone", "critic_rank", "policy_shift"}
    assert json.loads((finished / "report" / "stage.json").read_text())["facts"]["verdict"]["text"]
    assert (finished / "report" / "report.md").is_file()


def test_a_second_call_does_nothing(finished, capsys):
    status, said, err = call(capsys, "--out", finished, *SMALL)
    assert status == 0
    assert said["done_before"] == STAGES
    assert err.count("done before") == len(STAGES)
    assert {row["contestant"] for row in said["table"]} >= {"AWR policy, sampled", "random skills"}


def test_a_second_call_with_nothing_but_the_folder_goes_on_with_the_same_settings(finished, capsys):
    status, said, err = call(capsys, "--out", finished)
    assert (status, said["done_before"]) == (0, STAGES)
    assert "as in the earlier call: --data_steps=2000 " in err


def test_the_agent_of_the_run_acts_without_data_or_run(finished, tmp_path):
    (tmp_path / "agent").symlink_to(finished / "agent")
    agent = DDSAgent.load(tmp_path / "agent", seed=3)
    agent.reset(5, seed=3)
    actions = agent.act(np.zeros((5, 4), np.float32))
    assert actions.shape == (5, 2)
    assert np.abs(actions).max() <= 1


def test_evaluating_a_run_prints_a_row_for_each_way_of_choosing(finished, capsys):
    capsys.readouterr()
    words = ["evaluate", str(finished), "--episodes=2", "--workers=0", "--selection=[greedy,random]", "--json"]
    assert main([*words, "--out=table.parquet"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["actor"] for row in said["results"]] == ["AWR policy, greedy", "random skills"]
    assert {row["checkpoint"] for row in said["results"]} == {"last"}
    how = said["protocol"]
    assert (how["task"], how["environment"], how["episodes"], how["best"]) == (TASK, "PointMaze_UMaze-v3", 2, None)
    assert (how["score_min"], how["score_max"], how["paper_score"]) == (0.0, 1.0, None)
    assert len(pd.read_parquet("table.parquet")) == 4


def test_an_agent_in_an_environment_of_other_dimensions_is_refused(finished, capsys, monkeypatch):
    from dds_lightning import agent as rooms

    capsys.readouterr()
    monkeypatch.setattr(rooms.DDSAgent, "load", lambda *a, **k: type("A", (), {"observation_dim": 29, "action_dim": 8}))
    assert main(["evaluate", str(finished)]) == 2
    assert "(29, 8)" in capsys.readouterr().err


def test_the_printed_command_makes_the_same_checkpoint(finished, capsys, tmp_path):
    """`dds run` is nothing but the commands that it prints."""
    _, _, err = call(capsys, "--out", tmp_path / "again", *SMALL, "--until=skill")
    command = next(line for line in err.splitlines() if line.startswith("dds skill fit"))
    words = [word for word in command.split()[1:] if not word.startswith("--checkpoint.dirpath")]
    assert main([*words, f"--checkpoint.dirpath={tmp_path / 'typed'}"]) == 0
    ours, typed, first = (
        torch.load(path / "last.ckpt", weights_only=True)["state_dict"]
        for path in (tmp_path / "again" / "skill", tmp_path / "typed", finished / "skill")
    )
    assert all(torch.equal(ours[name], typed[name]) for name in ours)
    assert all(torch.equal(ours[name], first[name]) for name in ours)  # the same seed, the same data, the same bits


def test_only_what_a_changed_setting_touches_is_done_again(finished, capsys, tmp_path):
    out = tmp_path / "run"
    given = [*SMALL, f"--data=local:{finished / 'data' / TASK}"]
    call(capsys, "--out", out, *given, "--until=policy")
    _, said, err = call(capsys, "--out", out, *given, "--until=policy", "--policy.model.alpha=7")
    assert said["done_before"] == ["data", "skill", "relabel"]
    assert "model.alpha" in err
    assert (out / "previous" / "policy" / "last.ckpt").is_file()
    _, said, _ = call(capsys, "--out", out, *given, "--until=relabel", "--policy.data.gamma=0.9")
    assert said["done_before"] == ["data", "skill"]


def test_an_interrupted_run_goes_on_and_ends_with_the_same_bits(finished, capsys, tmp_path):
    out = tmp_path / "run"
    checkpoint = out / "skill" / "last.ckpt"
    sender = threading.Thread(target=_signal_when, args=(checkpoint, signal.SIGINT))
    sender.start()
    long = [f"--data=local:{finished / 'data' / TASK}"]
    long += ["--skill.trainer.max_steps=100", "--skill.checkpoint.every_n_steps=3", "--until=skill"]
    status, _, err = call(capsys, "--out", out, *SMALL, *long)
    sender.join()
    assert status == 130
    assert "the same command continues" in err
    stopped = torch.load(checkpoint, weights_only=True)["global_step"]
    assert 3 <= stopped < 100
    status, said, err = call(capsys, "--out", out, *SMALL, *long)
    assert status == 0, err
    assert said["done_before"] == ["data"]
    assert "going on after" in err
    through = tmp_path / "through"
    call(capsys, "--out", through, *SMALL, *long)
    one, two = (torch.load(path / "skill" / "last.ckpt", weights_only=True)["state_dict"] for path in (out, through))
    assert all(torch.equal(one[name], two[name]) for name in one)


def _signal_when(path, signum):
    for _ in range(2400):
        if path.exists():
            os.kill(os.getpid(), signum)
            return
        time.sleep(0.02)


def test_data_of_your_own_are_used_where_they_lie(finished, capsys, tmp_path):
    data = finished / "data" / TASK
    _, said, _ = call(capsys, "--out", tmp_path / "run", *SMALL, f"--data=local:{data}", "--until=data")
    assert said["outputs"]["data"] == {}
    assert not (tmp_path / "run" / "data" / TASK).exists()


def test_a_run_with_another_tasks_data_stops_at_the_first_stage(finished, capsys, tmp_path):
    data = f"local:{finished / 'data' / TASK}"
    capsys.readouterr()
    assert main(["run", "pointmaze-large-diverse", "--out", "run", "--data", data]) == 2
    assert "PointMaze_Large-v3" in capsys.readouterr().err
    assert not Path("run/skill").exists()


# -------------------------------------------------------------------- the best checkpoint beside the last


def test_the_best_policy_is_told_beside_the_last_and_leaves_when_it_is_not_wanted(
    finished, capsys, tmp_path, monkeypatch
):
    monkeypatch.setattr(report, "_draw", lambda *arguments: {})  # what is drawn is for other tests
    out = tmp_path / "run"
    given = [*SMALL, f"--data=local:{finished / 'data' / TASK}", "--out", out]
    _, said, err = call(capsys, *given, "--evaluate_every=10")
    assert "--best.monitor=rollout/score" in err
    best = said["protocol"]["best"]
    assert (best["monitor"], best["evaluations"]) == ("rollout/score", 2)
    assert best["step"] in (10, 20)
    names = [row["contestant"] for row in said["table"]]
    assert names[0] == "AWR policy, greedy"
    label = f"(best of 2 evaluations while training, step {best['step']}: optimistic)"
    assert [name for name in names if label in name] == [f"AWR policy, sampled {label}", f"AWR policy, greedy {label}"]
    assert DDSAgent.load(out / "evaluate" / "best").policy is not None
    last, kept = (torch.load(out / "policy" / f"{name}.ckpt", weights_only=True) for name in ("last", "best"))
    assert (last["global_step"], kept["global_step"]) == (20, best["step"])
    untouched = torch.load(finished / "policy" / "last.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(last["state_dict"][name], untouched[name]) for name in untouched)  # watching changes no bit

    _, said, err = call(capsys, *given, "--evaluate_every=10", "--workers=0")
    assert said["done_before"] == STAGES  # how many processes play changes nothing
    _, said, _ = call(capsys, *given, "--evaluate_every=0")
    assert said["done_before"] == ["data", "skill", "relabel", "clone"]
    assert said["protocol"]["best"] is None
    assert not (out / "evaluate" / "best").exists()


def test_a_run_without_a_best_says_so(finished, capsys):
    assert main(["evaluate", str(finished), "--checkpoint=best"]) == 2
    assert "holds only the last one" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("task", "every", "steps", "found"),
    [
        (TASK, None, 20, 0),
        (TASK, 5, 20, 5),
        ("hopper-medium", None, 20, 5),
        ("hopper-medium", None, 3, 1),
        ("antmaze-umaze", 0, 20, 0),
        ("kitchen-mixed", None, 10_000, 2500),
    ],
)
def test_the_policy_is_evaluated_four_times_except_where_the_maze_is_easy(task, every, steps, found):
    wanted = RunSettings(task, Path("out"), evaluate_every=every, stages={"policy": (f"--trainer.max_steps={steps}",)})
    trainings = Trainings(wanted, get_task(task))
    assert trainings.evaluate_every == found
    settings = trainings.settings("policy")
    assert settings["best"]["monitor"] == ("rollout/score" if found else None)
    assert settings["best"]["every_n_steps"] == (found or None)
    callbacks = [callback["init_args"] for callback in settings["trainer"]["callbacks"] or []]
    assert [(chosen["every_n_steps"], chosen["episodes"], chosen["seed"]) for chosen in callbacks] == (
        [(found, 10, 1)] if found else []
    )
    other = Trainings(dataclasses.replace(wanted, workers=3), get_task(task))
    assert other.cache_key_settings("policy") == trainings.cache_key_settings("policy")
    assert set(trainings.cache_key_settings("skill")["best"]) == {
        "monitor",
        "mode",
    }  # runs of earlier versions are still done


def _watching(trainings):
    (callback,) = trainings.settings("policy")["trainer"]["callbacks"]
    return {name: callback["init_args"][name] for name in ("selections", "temperature", "noise_scale")}


def test_the_best_checkpoint_is_chosen_by_episodes_played_as_the_run_plays():
    """The kitchen acts greedily without noise: sampled codes with noise would keep another checkpoint."""
    kitchen = RunSettings.with_preset("kitchen-mixed", Path("out"))
    assert _watching(Trainings(kitchen, get_task("kitchen-mixed"))) == {
        "selections": ["greedy"],
        "temperature": 1.0,
        "noise_scale": 0.0,
    }
    asked = dataclasses.replace(kitchen, selection="sample", temperature=0.5, noise_scale=None)
    assert _watching(Trainings(asked, get_task("kitchen-mixed"))) == {
        "selections": ["sample"],
        "temperature": 0.5,
        "noise_scale": None,
    }


def test_what_an_earlier_version_finished_is_still_done(finished, capsys, tmp_path):
    """Version 0.1.0 kept three numbers of the clone, and evaluated the policy by sampled codes whatever the run did."""
    out = tmp_path / "run"
    given = [*SMALL, f"--data=local:{finished / 'data' / TASK}", "--out", out, "--evaluate_every=10"]
    given += ["--selection=greedy", "--until=clone"]
    call(capsys, *given)
    clone, policy = (json.loads((out / name / "stage.json").read_text()) for name in ("clone", "policy"))
    clone["settings"] = {"task": TASK, "seed": 0, "steps": 20}
    (callback,) = policy["settings"]["trainer"]["callbacks"]
    assert callback["init_args"]["selections"] == ["greedy"]
    callback["init_args"]["selections"] = ["sample"]
    for name, marker in (("clone", clone), ("policy", policy)):
        (out / name / "stage.json").write_text(json.dumps(marker))
    _, said, _ = call(capsys, *given)
    assert said["done_before"] == STAGES[:5]
    _, said, _ = call(capsys, *given, "--clone.model.lr=0.01")
    assert said["done_before"] == STAGES[:4]


def test_the_steps_come_after_what_they_read_and_are_those_that_until_takes():
    assert list(STEPS) == [*STAGES, "online"]
    for index, step in enumerate(STEPS.values()):
        assert set(step.reads) <= set(STAGES[:index])
    until = inspect.signature(commands.run).parameters["until"].annotation
    assert list(get_args(until)) == list(STEPS)


def test_a_finished_run_goes_on_online_with_its_data_and_skills(finished, capsys):
    words = ["--out", finished, *SMALL, "--until=online", "--online.trainer.max_steps=3", "--online.data.num_envs=2"]
    words += ["--online.data.random_steps=20", "--online.data.batch_size=16", "--online.trainer.accelerator=cpu"]
    status, said, _ = call(capsys, *words)
    assert status == 0
    assert said["done_before"] == STAGES
    agent = DDSAgent.load(said["outputs"]["online"]["agent"])
    assert agent.policy.STAGE == "online"
    assert said["online"]["episodes"] == 2
    told = json.loads((Path(said["outputs"]["online"]["agent"]) / "metrics.json").read_text())
    assert told["results"][0]["score"] == said["online"]["score"]
    assert agent.skill.fingerprint() == DDSAgent.load(finished / "agent").skill.fingerprint()
    assert call(capsys, *words)[1]["done_before"] == [*STAGES, "online"]


@pytest.mark.parametrize("every", [-1, 21])
def test_an_interval_that_cannot_work_is_refused_before_anything_is_written(capsys, every):
    words = [*SMALL, f"--evaluate_every={every}"]
    assert main(["run", TASK, *words]) == 2
    assert f"--evaluate_every is {every}, expected 0 (never) " in capsys.readouterr().err
    assert list(Path().iterdir()) == []


def test_a_task_that_nothing_collects_asks_for_data_before_anything_is_written(capsys, monkeypatch):
    monkeypatch.setattr("datamodules.collect.collectors.COLLECTORS", {})
    assert main(["run", "hopper-medium"]) == 2
    said = capsys.readouterr().err
    assert all(part in said for part in ("hopper-medium", "d4rl:FILE", "minari:ID", "dds data fetch hopper-medium"))
    assert list(Path().iterdir()) == []


# -------------------------------------------------------------------- who plays


def test_a_run_publishes_the_chosen_way_and_shows_it_first():
    class Agent:
        selection, temperature, num_skills = "greedy", 1.0, 3

        def variant(self, *args, **settings):
            return (args, settings)

    names = [c.name for c in final_contestants(Agent(), get_task(TASK), 5, 2)]
    assert names[0] == "AWR policy, greedy"
    assert len(names) == len(set(names)) == 6


def test_an_unknown_way_of_choosing_is_refused():
    with pytest.raises(UserError, match=r"'guess'.*greedy"):
        way_name("guess")
