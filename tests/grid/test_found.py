"""What a study has found, as a file: another folder, or another machine, goes on from it."""

import json

import pandas as pd
import pytest

from dds_lightning.cli import main
from dds_lightning.errors import UserError
from dds_lightning.grid.found import FILE, Found, Outcome, Work
from dds_lightning.grid.report import report_study
from dds_lightning.grid.results import Results
from dds_lightning.grid.run import Asked, run_study
from tests.grid.test_report import LONG, SECONDS, made

KEY = "evaluate-0123456789abcdef"


def test_the_file_of_a_report_holds_all_that_its_tables_are_made_of(tmp_path):
    place = made(tmp_path, best=True, paper="table2", watch=4)
    report_study(place)
    first = Results.read(place)
    found = Found.load(place / "report" / FILE)
    assert found.works == first.found.works
    other = tmp_path / "elsewhere" / "mine"
    other.mkdir(parents=True)
    (other / "cells.json").write_bytes((place / "cells.json").read_bytes())
    (other / "known.json").write_bytes((place / "report" / FILE).read_bytes())
    second = Results.read(other)
    pd.testing.assert_frame_equal(first.cells, second.cells)
    assert first.seconds == second.seconds == SECONDS * len(found.works)
    assert first.budgets().keys() == second.budgets().keys()
    text = (place / "report" / "report.md").read_text()
    report_study(other)
    assert (other / "report" / "report.md").read_text() == text


def test_known_cells_are_not_done_again_and_are_in_the_report(tmp_path):
    half = made(tmp_path / "here", left_out=range(6, 12))
    report_study(half)
    file, out = str(tmp_path / "here" / "mine.yaml"), tmp_path / "there"
    alone = run_study(Asked(file, out, plan_only=True))
    beside = run_study(Asked(file, out, plan_only=True, known=[half / "report"]))
    assert alone.data["jobs"] == {"data": 1, "skill": 12, "relabel": 12, "policy": 12, "evaluate": 12}
    assert beside.data["jobs"] == {"data": 1, "skill": 6, "relabel": 6, "policy": 6, "evaluate": 6}
    whole = made(tmp_path / "whole")
    report_study(whole)
    done = run_study(Asked(file, out, known=[half / "report" / FILE, whole / "report"]))
    assert done.status == 0
    assert set(done.data["table"]["state"]) == {"done"}
    for known in (str(whole / "report"), f"[{half / 'report'},{whole / 'report'}]"):
        assert main(["study", "run", file, "--out", str(tmp_path / "new"), "--known", known, "--plan"]) == 0
    again = run_study(Asked(file, out, plan_only=True))
    assert again.data["jobs"] == {}, "what is known is remembered"


def test_reports_of_several_machines_become_one(tmp_path):
    whole, first, second = (
        made(tmp_path / name, left_out=left_out)
        for name, left_out in {"whole": (), "one": range(6, 12), "two": range(6)}.items()
    )
    report_study(whole)
    report_study(second)
    assert main(["study", "report", str(first), "--known", str(second / "report")]) == 0
    texts = [(place / "report" / "report.md").read_text() for place in (whole, first)]
    assert texts[0].replace(str(tmp_path / "whole"), str(tmp_path / "one")) == texts[1]
    assert set(Results.read(first).cells["state"]) == {"done"}, "what was taken over is remembered"
    other = made(tmp_path / "other", grid={"skill.model.skill_dim": [16], "skill.model.num_skills": [2, 3]})
    report_study(other)
    with pytest.raises(UserError, match="has no cell of this study"):
        report_study(first, [other / "report"])


def test_a_curve_of_online_training_survives_the_file(tmp_path):
    curve = pd.DataFrame({"env_steps": [1000.0, 2000.0], "value": [0.1, 0.5]})
    made_by = {"versions": {"torch": "2.13"}, "commit": None, "machine": "x"}
    outcome = Outcome({"last": 3.0}, curve["value"].to_numpy())
    found = Found({KEY: Work(2.5, made=made_by)}, {KEY: outcome}, {KEY: curve})
    found.save(tmp_path / FILE)
    read = Found.load(tmp_path / FILE)
    pd.testing.assert_frame_equal(read.curves[KEY], curve)
    assert read.works == found.works
    assert read.made() == [made_by]
    assert read.outcomes[KEY].episodes.tolist() == [0.1, 0.5]
    assert read.only([]).outcomes == {}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda v: v | {"format": 99}, "install a newer one"),
        (lambda v: v | {"cells": []}, "cells is"),
        (lambda v: v | {"nodes": {"../../x": {}}}, "is not the name of a job"),
        (lambda v: v | {"nodes": {KEY: {"seconds": "long"}}}, "seconds is 'long'"),
        (lambda v: v | {"nodes": {KEY: {"seconds": 1, "command": ["dds"]}}}, "command is"),
        (lambda v: v | {"cells": {KEY: {"scores": {}, "episodes": []}}}, "last is"),
        (lambda v: v | {"curves": {KEY: {"a": [1]}}}, "a curve has other columns"),
        (
            lambda v: v | {"curves": {KEY: {"env_steps": [1], "value": [None]}}},
            r"has \[None\], expected a list",
        ),
        (lambda v: v | {"curves": {KEY: {"env_steps": [1], "value": [1, 2]}}}, "is damaged"),
        (lambda v: v | {"curves": {KEY: [1]}}, "holds a list"),
        (
            lambda v: v | {"cells": {KEY: {"scores": {"last": 1.0}, "episodes": []}}},
            r"has \[\], expected a list",
        ),
        (lambda v: v | {"cells": {KEY: {"scores": {"last": 1.0}, "episodes": [[1]]}}}, "expected a list of finite"),
        (lambda v: v | {"cells": {KEY: {"scores": {"last": 1.0, "best": "high"}, "episodes": [1]}}}, "best is 'high'"),
        (lambda v: v | {"cells": {KEY: {"scores": [1], "episodes": [1]}}}, "scores is"),
        (lambda v: v | {"cells": {"policy-0123456789abcdef": {}}}, "is not the name of a job"),
        (lambda v: v | {"made": [{}]}, "versions is"),
        (lambda v: v | {"made": [{"versions": {"torch": 2}, "machine": "x"}]}, "torch is '2'"),
        (
            lambda v: v | {"nodes": {KEY: {"seconds": 1, "chosen": "", "made": 3}}},
            "damaged: list index out of range",
        ),
        (lambda v: [], "holds a list"),
    ],
)
def test_a_damaged_file_is_told_in_a_sentence(tmp_path, change, told):
    Found().save(tmp_path / FILE)
    value = json.loads((tmp_path / FILE).read_text())
    (tmp_path / FILE).write_text(json.dumps(change(value)))
    with pytest.raises(UserError, match=told):
        Found.load(tmp_path / FILE)


def test_a_damaged_report_is_refused_at_once_and_nothing_is_remembered(tmp_path):
    place, damaged = made(tmp_path / "a", left_out=range(1, 12)), tmp_path / FILE
    report_study(place)
    value = json.loads((place / "report" / FILE).read_text())
    key = next(iter(value["cells"]))
    value["cells"][key]["episodes"] = []
    damaged.write_text(json.dumps(value))
    for call in (
        lambda: report_study(place, [damaged]),
        lambda: run_study(Asked(str(tmp_path / "a" / "mine.yaml"), tmp_path / "b", known=[damaged])),
    ):
        with pytest.raises(UserError, match="expected a list of finite numbers"):
            call()
    assert not (place / "known.json").exists()
    assert not (tmp_path / "b").exists()


def test_results_of_another_study_are_refused(tmp_path):
    place = made(tmp_path / "a")
    report_study(place)
    other = made(tmp_path / "b", tasks=["pointmaze-medium-diverse"], left_out=range(12))
    with pytest.raises(UserError, match="no cell of this study"):
        run_study(Asked(str(other.parent / "mine.yaml"), tmp_path / "c", known=[place / "report"]))
    with pytest.raises(UserError, match="is not there"):
        run_study(Asked(str(other.parent / "mine.yaml"), tmp_path / "c", known=[tmp_path / "none.json"]))
    assert not (tmp_path / "c").exists()


def test_a_command_stays_whole_and_in_one_line(tmp_path):
    path = tmp_path / FILE
    work = Work(1.0, f"dds fit {LONG}", "", None, None)
    Found({KEY: work}, {KEY: Outcome({"last": 1.0}, pd.Series([1.0]).to_numpy())}, {}).save(path)
    assert Found.load(path).works == {KEY: work}
    value = json.loads(path.read_text())
    value["nodes"][KEY]["command"] = "dds\n```\n# Fit\x1b[2J"
    path.write_text(json.dumps(value))
    assert Found.load(path).works[KEY].command == "dds# Fit[2J"
