"""The report of a study, from results made up by hand: its tables, its intervals, its page."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from rich.console import Console

from dds_lightning.errors import UserError
from dds_lightning.grid import figures
from dds_lightning.grid.file import read_study
from dds_lightning.grid.job import MADE, NODES
from dds_lightning.grid.nodes import in_order, plan
from dds_lightning.grid.report import report_study
from dds_lightning.grid.results import STATE, Results
from dds_lightning.grid.run import CELLS, Asked, _table
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.saving.run_directory import MARKER, RunDirectory, write_json

TASK = "pointmaze-large-diverse"
SCORES = {(32, 4): (10, 20, 30), (32, 8): (40, 50, 60), (64, 4): (50, 50, 50), (64, 8): (90, 95, 100)}
"""(D, K) -> score of each seed."""
LONG = (
    "--trainer.callbacks+='" + '{"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": {}}' * 4 + "'"
)
"""What a command may look like: quotes, braces, and more than two hundred characters."""
SECONDS = 1.5
"""How long each made-up job is said to have taken: in truth none takes as much as a hundredth of a second."""


def evaluation(scores):
    """Work that leaves the table of a rollout: (checkpoint, score) in two episodes each."""

    def work(folder, resuming):
        rows = [
            {"actor": actor, "label": actor, "episode": episode, "seed": 0, "return": 1.0, "score": float(score)}
            | {"success": True, "terminated": True, "length": 5, "final_x": 0.0, "final_y": 0.0}
            | {"final_code": 0, "codes": [0]}
            for actor, score in scores.items()
            for episode in range(2)
        ]
        result = RolloutResult(TASK, pd.DataFrame(rows))
        result.save(folder)
        facts = [{"actor": actor, "score": float(score), "success": 0.0} for actor, score in scores.items()]
        return {"episodes": folder / "episodes.parquet", "results": facts, "command": "dds evaluate --skill=s.ckpt"}

    return work


def training(folder, resuming):
    (folder / "last.ckpt").write_text("weights")
    chosen = {"monitor": "rollout/score", "step": 600, "value": 1.0, "evaluations": 4}
    return {"checkpoint": folder / "last.ckpt", "chosen": chosen, "command": f"dds fit {folder.name} {LONG}"}


def made(tmp_path, best=False, left_out=(), **keys):
    """A study's folder with results, the cells at `left_out` missing."""
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "mine.yaml"
    grid = {"skill.model.skill_dim": [32, 64], "skill.model.num_skills": [4, 8]}
    labels = {"skill.model.num_skills": "K", "skill.model.skill_dim": "D"}
    layout = {"rows": ["skill.model.skill_dim"], "columns": ["skill.model.num_skills"], "labels": labels}
    head = {"title": "K and D", "question": "Does K matter?", "tasks": [TASK], "seeds": [0, 1, 2], "budget": 60}
    path.write_text(yaml.safe_dump({**head, "grid": grid, **layout, **keys}, sort_keys=False))
    study = read_study(path)
    cells = plan(study)
    root = tmp_path / NODES
    directory = RunDirectory(root, Console(quiet=True))
    for index, (cell, node) in enumerate(cells.values()):
        score = {str(place): scores for place, scores in SCORES.items()}.get(str(tuple(cell.place.values())), (1, 2, 3))
        score = score[cell.seed]
        work = evaluation({"last": score, **({"best": score + 1} if best else {})})
        for one in in_order([node]).values():
            if one.kind == "evaluate" and index in left_out:
                continue
            directory.do(one.key, one.title, one.settings, [], work if one.kind == "evaluate" else training)
            marker = root / one.key / MARKER
            write_json(marker, {**json.loads(marker.read_text()), "seconds": SECONDS})
            write_json(
                root / one.key / MADE, {"versions": {"torch": "2.13"}, "commit": "abc123", "machine": "x, 2 cores"}
            )
    place = tmp_path / "mine"
    write_json(place / CELLS, _table(study, cells, path, Asked(str(path), tmp_path)))
    return place


def test_a_grid_of_two_axes_is_laid_out_as_table_2_with_the_papers_numbers_beside(tmp_path):
    results = Results.read(made(tmp_path, paper="table2"))
    table = results.table()
    assert list(table.columns) == ["D", "K 4", "K 4 (paper)", "K 8", "K 8 (paper)"]
    assert table.to_numpy().tolist() == [
        ["32", "20.0 ± 10.0", "85.2 ± 0.2", "50.0 ± 10.0", "85.1 ± 1.5"],
        ["64", "50.0 ± 0.0", "79.3 ± 0.5", "95.0 ± 5.0", "88.9 ± 0.3"],
    ]


def test_settings_are_compared_by_intervals_with_the_first(tmp_path):
    table = Results.read(made(tmp_path)).comparison()
    assert list(table["setting"]) == ["D 32, K 4", "D 32, K 8", "D 64, K 4", "D 64, K 8"]
    assert table["IQM"].tolist() == [20, 50, 50, 95]
    assert table.loc[2, ["low", "high"]].tolist() == [50, 50]
    assert (table["low"] <= table["IQM"]).all()
    better = table["P(better than D 32, K 4)"].tolist()
    assert np.isnan(better[0])
    assert better[1:] == [1, 1, 1]


def test_settings_are_compared_on_the_tasks_that_are_finished(tmp_path):
    tasks = [TASK, "pointmaze-medium-diverse"]
    second = [index for index in range(24) if index // 4 % 2]  # four settings on a task, then on the other, by seed
    place = made(tmp_path, tasks=tasks, left_out=second[1:])
    results = Results.read(place)
    assert results.cells["score"].notna().sum() == 13
    assert [list(scores) for scores in results.groups().values()] == [[TASK]] * 4
    report_study(place)
    text = (place / "report" / "report.md").read_text()
    assert f"Compared on {TASK} only: the other tasks are not finished." in text
    whole = made(tmp_path / "whole", tasks=tasks)
    assert [list(scores) for scores in Results.read(whole).groups().values()] == [tasks] * 4
    report_study(whole)
    assert "are not finished" not in (whole / "report" / "report.md").read_text()


def test_each_setting_is_judged_over_all_values_of_the_others(tmp_path):
    table = Results.read(made(tmp_path)).effects()
    assert table["setting"].tolist() == ["D", "D", "K", "K"]
    assert table["value"].tolist() == ["32", "64", "4", "8"]
    assert table["runs"].tolist() == [6, 6, 6, 6]
    # The middle half of 10, 20, 30, 40, 50, 60 and of 50, 50, 50, 90, 95, 100.
    assert table["IQM"].tolist()[:2] == [35, (50 + 50 + 90 + 95) / 4]
    better = table["P(better than the first)"]
    assert better.isna().tolist() == [True, False, True, False]
    assert better[1] == 1.0, "D 64 beats D 32 with every K"
    assert better[3] == 1.0
    assert table["clearly above"].tolist()[0] == ""
    one_axis = made(tmp_path / "one", grid={"skill.model.num_skills": [4, 8]}, columns=[], rows=[], labels={})
    assert Results.read(one_axis).effects().empty


def test_the_page_says_how_every_number_was_made(tmp_path):
    place = made(tmp_path, best=True, paper="table2", watch=4)
    report = report_study(place)
    text, page = (place / "report" / "report.md").read_text(), (place / "report" / "index.html").read_text()
    for told in (
        "Does K matter?",
        "12 of 12 cells done",
        "Stated budget: 1 h 0 min of one core",
        "The paper's numbers are for other data",
        "| 32 | 20.0 ± 10.0 | 85.2 ± 0.2 |",
        "The best checkpoint, apart",
        "21.0 ± 10.0",
        "rollout/score at step 600",
        "torch 2.13; commit abc123; x, 2 cores",
        "dds evaluate --skill=s.ckpt",
        "dds fit skill-",
        f"dds study run {tmp_path / 'mine.yaml'}",
    ):
        assert told in text, told
    assert "Is it real?" in page
    assert page.count("data:image/png;base64,") == text.count("![") == 3
    assert "<script" not in page
    assert 'src="http' not in page
    assert Path(report.data["report"]) == place / "report" / "index.html"
    assert len(pd.read_csv(place / "report" / "cells.csv")) == 12


def test_a_study_that_is_not_finished_has_a_report_of_what_there_is(tmp_path):
    place = made(tmp_path, left_out=range(1, 12))
    report_study(place)
    text = (place / "report" / "report.md").read_text()
    assert "1 of 12 cells done" in text
    results = Results.read(place)
    assert results.table().to_numpy().tolist() == [["32", "10.0"]]
    empty = made(tmp_path / "empty", left_out=range(12))
    report_study(empty)
    assert "No cell is finished yet." in (empty / "report" / "report.md").read_text()


def test_values_that_are_lists_or_null_have_rows_of_their_own(tmp_path):
    grid = {"policy.model.hidden_dims": [[64], [64, 64]], "skill.model.codebook_ema": [None, 0.5]}
    place = made(tmp_path, grid=grid, rows=[], columns=[], labels={"skill.model.codebook_ema": "EMA", "[64]": "narrow"})
    results = Results.read(place)
    assert results.cells["skill.model.codebook_ema"].unique().tolist() == ["null", 0.5]
    assert list(results.groups())[:2] == [f"policy.model.hidden_dims narrow, EMA {value}" for value in ("null", 0.5)]
    assert len(results.groups()) == 4
    report_study(place)
    assert "| narrow | 2.0 ± 1.0 | 2.0 ± 1.0 |" in (place / "report" / "report.md").read_text()


def test_a_failed_cell_is_shown_with_its_reason_and_launches_with_their_wall_time(tmp_path):
    place = made(tmp_path, left_out=(1, 2), seeds=[0])
    keys = list(Results.read(place).cells["key"])
    nodes = {cell["key"]: cell["nodes"] for cell in json.loads((place / CELLS).read_text())["cells"]}
    skill = next(key for key in nodes[keys[1]] if key.startswith("skill-"))
    failed = {skill: "no | memory", keys[1]: "not done, because 'skill' failed", keys[0]: "earlier"}
    write_json(place / STATE, {"wall": 125.0, "failed": failed})
    cells = Results.read(place).cells
    assert cells["state"].tolist() == ["done", "failed", "open", "done"]
    assert cells["reason"].tolist() == ["", "skill: no | memory", "", ""]
    report_study(place)
    text = (place / "report" / "report.md").read_text()
    assert "2 of 4 cells done, 1 failed, in " in text
    assert "(2 min 5 s of wall time in this folder)" in text
    assert "| failed | skill: no \\| memory |" in text


def test_table_1_has_tasks_as_rows_and_the_papers_numbers_of_every_method(tmp_path):
    names = ["dds", "clone", "dd", "dql"]
    layout = {"paper": "table1", "rows": ["task"], "columns": ["method"], "labels": {}, "grid": {}, "seeds": [0]}
    place = made(tmp_path, tasks=["hopper-medium-expert", "antmaze-large-diverse"], methods=names, **layout)
    table = Results.read(place).table().set_index("task")
    assert list(table.index) == ["hopper-medium-expert", "antmaze-large-diverse"]
    assert table.loc["hopper-medium-expert", "Decision Diffuser (paper)"] == "111.8"
    assert table.loc["antmaze-large-diverse", "Diffusion-QL (paper)"] == "56.6"
    assert table.loc["antmaze-large-diverse", "DDS (paper)"] == "82.6 ± 0.6"
    assert table.loc["hopper-medium-expert", "DDS"] == "1.0"


def test_it_is_told_of_which_methods_there_is_no_best_checkpoint(tmp_path):
    place = made(tmp_path, methods=["dds", "clone"], grid={}, rows=["method"], columns=[], labels={}, seeds=[0])
    results = Results.read(place)
    found = results.found.outcomes
    ours = results.cells.set_index("method")["key"]["dds"]
    outcomes = {**found, ours: replace(found[ours], scores={"last": 1.0, "best": 2.0})}
    replace(results.found, outcomes=outcomes).save(place / "known.json")
    (place.parent / NODES / ours / MARKER).unlink()
    report_study(place)
    section = (place / "report" / "report.md").read_text().split("## The best checkpoint, apart")[1].split("##")[0]
    assert "BC: none, because these do not play during training." in section
    assert "| DDS | 2.0 |" in section
    assert "| BC |" not in section


def test_settings_that_are_not_drawn_are_told(tmp_path):
    grid = {"skill.model.num_skills": list(range(4, 18))}
    report_study(made(tmp_path, grid=grid, rows=[], columns=[], labels={}, seeds=[0]))
    text = (tmp_path / "mine" / "report" / "report.md").read_text()
    assert "The first 12 of 14 settings are drawn; all of them are in the table above." in text


def test_the_band_of_figure_5_is_the_standard_deviation_within_0_and_100():
    tables = [pd.DataFrame({"env_steps": [0.0, 10.0], "value": [0.0, value]}) for value in (80.0, 100.0)]
    (band,) = figures.plot_online({"x": tables}).axes[0].collections
    last = band.get_paths()[0].vertices
    last = last[last[:, 0] == 10.0][:, 1]
    assert last.min() == pytest.approx(90 - 200**0.5)  # over 80 and 100, with ddof 1
    assert last.max() == 100.0
    returns = [table.assign(value=-table["value"]) for table in tables]
    (band,) = figures.plot_online({"x": returns}).axes[0].collections
    assert band.get_paths()[0].vertices[:, 1].min() == pytest.approx(-90 - 200**0.5)


@pytest.mark.parametrize(("horizon", "hold"), [(10, None), (20, 5)])
def test_figure_6_knows_the_horizon_and_how_long_a_skill_is_held(tmp_path, horizon, hold):
    settings = {"skill.data.horizon": horizon, **({} if hold is None else {"evaluate.hold": hold})}
    place = made(tmp_path, paper="figure6", settings=settings)
    cells = Results.read(place).cells
    assert set(cells["horizon"]) == {horizon}
    assert set(cells["hold"]) == {hold or horizon}
    report_study(place)
    assert (place / "report" / "horizon.png").stat().st_size > 5_000


@pytest.mark.parametrize(
    "change", [lambda text: text.replace("evaluate-", "../../x"), lambda text: text[:200], lambda _: "[]"]
)
def test_a_damaged_study_is_told_in_a_sentence(tmp_path, change):
    place = made(tmp_path, left_out=range(12))
    file = place / CELLS
    file.write_text(change(file.read_text()))
    with pytest.raises(UserError, match=r"cells\.json"):
        report_study(place)
