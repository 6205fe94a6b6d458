"""Steps and seeds at the same time: the same results as one after the other, and nothing lost when one fails."""

import contextlib
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from dds_lightning.cli import main
from dds_lightning.errors import UserError
from dds_lightning.pipeline.beside import Beside
from dds_lightning.pipeline.seeds import Turns, over_seeds
from dds_lightning.pipeline.steps import STEPS, every_step
from tests.pipeline.test_run import SMALL, TASK


def call(capsys, *words):
    capsys.readouterr()
    status = main(["run", TASK, *map(str, words), "--json"])
    out, err = capsys.readouterr()
    return status, json.loads(out) if out else None, err


# -------------------------------------------------------------------- which steps begin when


class Recorder:
    """In place of the processes: what began, in which order, and how it ends."""

    def __init__(self, fails=()):
        self.began, self.fails = [], fails

    def run(self, name, *_):
        self.began.append(name)
        time.sleep(0.02)
        if name in self.fails:
            raise UserError(f"{name} cannot be done")
        return {}


def beside(recorder, lanes, ready=("data", "skill", "relabel")):
    run = type("Run", (), {"done": dict.fromkeys(ready), "wanted": None})()
    parts = [part for part in every_step() if part.beside]
    made = Beside(run, parts, lambda step, work: (step.name, work(Path(), False)), lanes)
    made._children.run = recorder.run
    return made


def test_the_clone_and_those_without_a_policy_are_done_while_the_policy_trains():
    assert [step.name for step in STEPS.values() if step.one_core] == ["policy"]
    assert [part.name for part in every_step() if part.beside] == ["clone", "baselines", "online"]
    recorder = Recorder()
    with beside(recorder, lanes=1) as made:
        assert recorder.began == []
        made.begin()
        made.take(STEPS["clone"])
    assert recorder.began[0] == "clone"


def test_a_step_begins_when_what_it_reads_is_done():
    recorder = Recorder()
    with beside(recorder, lanes=2) as made:
        made.begin()
        while "baselines" not in recorder.began:
            time.sleep(0.01)
        assert made.take(STEPS["evaluate"].ahead)[0] == "baselines"
    assert recorder.began.index("clone") < recorder.began.index("baselines")


def test_with_one_core_nothing_is_done_beside():
    recorder = Recorder()
    with beside(recorder, lanes=0) as made:
        made.begin()
        assert [made.take(step) for step in STEPS.values()] == [None] * len(STEPS)
    assert recorder.began == []


def test_a_failure_beside_is_told_at_once_and_raised_where_the_result_is_needed(capsys):
    with beside(Recorder(fails=("clone",)), lanes=1) as made:
        made.begin()
        with pytest.raises(UserError, match="clone cannot be done"):
            made.take(STEPS["clone"])
        assert made.take(STEPS["online"])[0] == "online"  # the others go on
    assert "clone has failed: clone cannot be done; what is being done beside it goes on" in capsys.readouterr().err


def test_a_failure_in_front_lets_what_is_beside_it_end(capsys):
    recorder = Recorder()
    made = beside(recorder, lanes=1)
    made.begin()
    while not recorder.began:
        time.sleep(0.001)
    made.__exit__(UserError, UserError("diverged"), None)
    assert "diverged; the run ends when clone beside it has come to its end" in capsys.readouterr().err
    assert made._futures["clone"].result()[0] == "clone"
    assert recorder.began == ["clone"]  # nothing else begins


# -------------------------------------------------------------------- whole runs


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder of the maze's data, as `--data` takes it."""
    out = tmp_path_factory.mktemp("collected")
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        assert main(["run", TASK, "--out", str(out), *SMALL, "--until=data"]) == 0
    return f"--data=local:{out / 'data' / TASK}"


@pytest.mark.slow
def test_side_by_side_gives_the_same_bits_and_the_same_table(capsys, tmp_path, data):
    runs = {jobs: tmp_path / str(jobs) for jobs in (1, 2)}
    said = {}
    for jobs, out in runs.items():
        status, said[jobs], err = call(capsys, "--out", out, *SMALL, data, f"--jobs={jobs}")
        assert status == 0, err
        assert ("clone | dds clone fit" in err) == (jobs == 2)
    tables = [pd.read_parquet(out / "evaluate" / "episodes.parquet") for out in runs.values()]
    pd.testing.assert_frame_equal(*tables)
    assert list(tables[0]["actor"].unique())[-2:] == ["single skill", "behaviour cloning"]
    for stage in ("skill", "policy", "clone"):
        one, two = (torch.load(out / stage / "last.ckpt", weights_only=True)["state_dict"] for out in runs.values())
        assert all(torch.equal(one[name], two[name]) for name in one)
    assert call(capsys, "--out", runs[2], *SMALL, data)[1]["done_before"] == list(STEPS)[:-1]

    # A run of before: everyone played in one step, and nothing of it is done again.
    for name in ("stage.json", "episodes.parquet", "paths.npz"):
        (runs[1] / "baselines" / name).unlink()
    assert call(capsys, "--out", runs[1], *SMALL, data)[1]["done_before"] == list(STEPS)[:-1]
    assert not (runs[1] / "baselines" / "episodes.parquet").exists()


@pytest.mark.slow
def test_a_stopped_run_stops_all_its_trainings_where_they_can_go_on(capsys, tmp_path, data):
    words = ["--out", tmp_path / "run", *SMALL, data, "--jobs=2", "--until=clone", "--clone_steps=20000"]
    words += ["--policy.trainer.max_steps=20000", "--clone.checkpoint.every_n_steps=1"]
    kept = [tmp_path / "run" / stage / "last.ckpt" for stage in ("policy", "clone")]

    def stop():
        while not kept[1].exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=stop)
    thread.start()
    assert call(capsys, *words)[0] == 143
    thread.join()
    steps = [torch.load(path, weights_only=True)["global_step"] for path in kept]
    assert all(0 < step < 20000 for step in steps)
    markers = [json.loads((path.parent / "stage.json").read_text())["state"] for path in kept]
    assert markers == ["started", "started"]


# -------------------------------------------------------------------- seeds


def test_a_core_goes_to_the_run_that_has_had_the_fewest():
    turns, order, began = Turns(1), [], threading.Barrier(3)

    def work(name, times):
        began.wait()
        for _ in range(times):
            with turns.of(name):
                order.append(name)
                time.sleep(0.01)

    workers = [threading.Thread(target=work, args=(name, 4)) for name in "abc"]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    counts = [[order[:end].count(name) for name in "abc"] for end in range(len(order) + 1)]
    assert max(max(count) - min(count) for count in counts) <= 2
    assert sorted(order) == sorted("aaaabbbbcccc")


def test_no_more_work_at_once_than_there_are_cores():
    turns, now, most = Turns(2), [0], [0]

    def work(name):
        for _ in range(5):
            with turns.of(name):
                now[0] += 1
                most[0] = max(most[0], now[0])
                time.sleep(0.002)
                now[0] -= 1

    workers = [threading.Thread(target=work, args=(str(number),)) for number in range(5)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert most[0] == 2


def row(contestant, score, kind="contestant", success=None):
    return {"contestant": contestant, "kind": kind, "score": score, "success": success}


def test_the_table_over_seeds_has_mean_deviation_and_interquartile_mean():
    scores = [0.0, 80.0, 90.0, 100.0]
    found = over_seeds([[row("AWR policy, greedy", score, success=score)] for score in scores]).iloc[0]
    assert (found["seeds"], found["score"], found["score_iqm"], found["success_iqm"]) == (4, 67.5, 85.0, 85.0)
    assert found["score_std"] == pytest.approx(np.std(scores, ddof=1))
    assert found["scores"] == scores
    assert np.isnan(over_seeds([[row("AWR policy, greedy", 1.0)]]).iloc[0]["score_std"])


def test_rows_of_several_seeds_meet_though_steps_and_skills_differ():
    tables = [
        [row(f"AWR policy, sampled (best of 4 evaluations while training, step {step}: optimistic)", step),
         row(f"best single skill (skill {skill})", skill, kind="best"), row(f"skill {skill} alone", 0, kind="skill")]
        for step, skill in ((2500, 3), (5000, 7))
    ]  # fmt: skip
    found = over_seeds(tables)
    assert found["contestant"].tolist() == [
        "AWR policy, sampled (best of 4 evaluations while training: optimistic)",
        "best single skill",
    ]
    assert found["score"].tolist() == [3750, 5]
    assert "success" not in found


@pytest.mark.slow
def test_seeds_share_cores_and_data_and_leave_one_table(capsys, tmp_path, data):
    words = ["--out", tmp_path / "runs", *SMALL, data, "--seeds=2", "--seed=3", "--jobs=2"]
    status, said, err = call(capsys, *words)
    assert status == 0, err
    assert said["seeds"] == [3, 4]
    assert [run["seed"] for run in said["runs"]] == [3, 4]
    assert {row["seeds"] for row in said["table"]} == {2}
    page = (tmp_path / "runs" / "seeds.md").read_text()
    assert "![Scores](seeds.png)" in page
    assert (tmp_path / "runs" / "seeds.png").read_bytes().startswith(b"\x89PNG")
    for seed in (3, 4):
        folder = tmp_path / "runs" / f"seed-{seed}"
        assert f"(seed-{seed}/report/report.md)" in page
        assert (folder / "report" / "report.md").is_file()
        assert not (folder / "data" / TASK).exists()
    status, said, err = call(capsys, *words)
    assert all(run["done_before"] == list(STEPS)[:-1] for run in said["runs"])


@pytest.mark.parametrize("words", ["--seeds=0", "--seeds=2 --seed=4294967295", "--jobs=0", "--seeds=2 --episodes=0"])
def test_a_number_that_cannot_work_is_refused_before_anything_is_written(capsys, words):
    assert call(capsys, *words.split())[0] == 2
    assert list(Path().iterdir()) == []
