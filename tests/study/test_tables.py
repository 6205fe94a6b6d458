"""The arithmetic of the report's tables, against numbers worked out by hand."""

import math

import numpy as np
import pandas as pd
import pytest

from dds_lightning.console.reports import plain
from dds_lightning.study.tables import (
    ends,
    failures_table,
    markdown,
    readable,
    skills_table,
    summary_table,
    wilson,
)
from dds_lightning.tasks import get_task

LARGE, HOPPER, KITCHEN = (get_task(name) for name in ("pointmaze-large-diverse", "hopper-medium", "kitchen-partial"))


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [
        (0, 10, 0.0, 0.277533),  # z^2 / (n + z^2) = 3.841459 / 13.841459
        (10, 10, 0.722467, 1.0),
        (5, 10, 0.236593, 0.763407),  # 0.5 -+ z / (2 sqrt(n + z^2)) = 0.5 -+ 1.959964 / 7.440823
        (97, 100, 0.915481, 0.989745),
        (100, 100, 0.963007, 1.0),  # n / (n + z^2)
    ],
)
def test_wilson_interval_against_hand_computed_bounds(successes, episodes, low, high):
    assert wilson(successes, episodes) == pytest.approx((low, high), abs=1e-6)


def test_wilson_interval_solves_its_defining_equation():
    low, high = wilson(37, 120, confidence=0.9)
    z, rate = 1.6448536, 37 / 120
    for bound in (low, high):
        assert abs(rate - bound) == pytest.approx(z * math.sqrt(bound * (1 - bound) / 120), abs=1e-7)


def test_wilson_interval_without_episodes_is_unknown():
    assert all(math.isnan(bound) for bound in wilson(0, 0))


def episodes() -> pd.DataFrame:
    """A policy (3 of 4), two skills of two episodes each, and a clone that fails four times."""
    away = LARGE.cell_to_xy((5, 2))
    home = LARGE.goal_xy()
    rows = []
    for actor, label, success, length, code, score in [
        ("policy", "policy", True, 300, 1, 100.0),
        ("policy", "policy", True, 500, 1, 100.0),
        ("policy", "policy", False, 800, 3, 0.0),
        ("policy", "policy", True, 340, 2, 100.0),
        ("single skill", "skill 0", False, 800, 0, 0.0),
        ("single skill", "skill 1", True, 400, 1, 100.0),
        ("single skill", "skill 0", False, 800, 0, 0.0),
        ("single skill", "skill 1", False, 800, 1, 0.0),
        *[("clone", "clone", False, 800, -1, 0.0)] * 4,
    ]:
        x, y = home if success else away
        rows.append(
            {
                "actor": actor,
                "label": label,
                "success": success,
                "length": length,
                "score": score,
                "return": score / 100,
                "final_x": x,
                "final_y": y,
                "final_code": code,
            }
        )
    return pd.DataFrame(rows)


def test_summary_has_contestants_in_order_with_the_best_part_and_every_part():
    table = summary_table(episodes())
    assert table["contestant"].tolist() == [
        "policy",
        "single skill, all 2 together",
        "best single skill (skill 1)",
        "skill 0 alone",
        "skill 1 alone",
        "clone",
    ]
    assert table["kind"].tolist() == ["contestant", "contestant", "best", "skill", "skill", "contestant"]
    assert table["episodes"].tolist() == [4, 4, 2, 2, 2, 4]
    assert table["success"].tolist() == [75.0, 25.0, 50.0, 0.0, 50.0, 0.0]


def test_summary_numbers_of_one_contestant():
    row = summary_table(episodes()).iloc[0]
    assert row["length"] == 340.0  # the median of 300, 340, 500: failures do not count
    assert row["score"] == 75.0
    assert row["score_error"] == pytest.approx(25.0)  # 50 / sqrt(4)
    assert (row["success_low"], row["success_high"]) == pytest.approx((30.0642, 95.4413), abs=1e-3)
    assert (row["return"], row["steps"]) == (0.75, 485.0)  # of all episodes, failures too


def runs() -> pd.DataFrame:
    """A runner's episodes, whose task measures no success: a policy, and two skills of two episodes each."""
    table = pd.DataFrame(
        [("policy", "policy", 90.0, 2900.0, 990, 1), ("policy", "policy", 70.0, 2300.0, 800, 2)]
        + [
            ("single skill", f"skill {k % 2}", score, 30 * score, 500, k % 2)
            for k, score in enumerate((10.0, 50.0, 20.0, 30.0))
        ],
        columns=["actor", "label", "score", "return", "length", "final_code"],
    )
    return table.assign(success=pd.array([None] * 6, dtype="boolean"), final_x=np.nan, final_y=np.nan)


def test_without_success_the_score_ranks_and_success_stays_unknown():
    table = summary_table(runs())
    assert table["contestant"][2] == "best single skill (skill 1)"
    assert table.loc[2, "score"] == 40.0
    assert table[["success", "success_low", "success_high", "length"]].isna().all(axis=None)
    assert table.loc[0, ["score", "score_error", "return", "steps"]].tolist() == [80.0, 10.0, 2600.0, 895.0]


def test_nothing_fails_where_success_is_not_measured():
    assert len(failures_table(runs(), HOPPER)) == 0


def test_each_family_is_printed_by_the_numbers_it_is_judged_by():
    runner = readable(summary_table(runs()), HOPPER)
    assert runner.columns.tolist() == ["contestant", "episodes", "score", "return", "steps (mean)"]
    assert runner.iloc[0].tolist() == ["policy", 2, "80.0 ± 10.0", "2600.0", "895"]
    kitchen = episodes().assign(**{"return": [4.0, 4.0, 2.0, 4.0, *[0.0, 1.0] * 2, *[1.0] * 4]})
    shown = readable(summary_table(kitchen), KITCHEN)
    expected = ["contestant", "episodes", "score", "subtasks done, of 4", "all 4, %", "95 % interval"]
    assert shown.columns.tolist() == [*expected, "steps (median, successes)"]
    assert shown.iloc[0].tolist()[2:5] == ["75.0 ± 25.0", "3.50", "75.0"]


def test_tables_read_back_from_json_are_printed_alike():
    """A marker holds None for what is missing, where the table has NaN."""
    for task, played in ((LARGE, episodes()), (HOPPER, runs())):
        summary = summary_table(played)
        again = pd.DataFrame(plain(summary))
        pd.testing.assert_frame_equal(readable(again, task), readable(summary, task), check_dtype=False)


def test_no_best_part_where_all_are_alike():
    table = episodes()
    table.loc[table["actor"] == "single skill", ["success", "score", "length"]] = [False, 0.0, 800]
    assert summary_table(table)["contestant"][2] == "best single skill (all alike)"


def test_failures_are_counted_by_cell_and_skill():
    table = failures_table(episodes(), LARGE)
    assert table.to_dict("list") == {
        "contestant": ["policy", "single skill", "single skill", "clone"],
        "row": [5, 5, 5, 5],
        "column": [2, 2, 2, 2],
        "skill": [3, 0, 1, -1],
        "episodes": [1, 2, 1, 4],
        "share": [1.0, 2 / 3, 1 / 3, 1.0],
    }
    shown = ends(table)
    assert shown["end cell (row, column)"][0] == "(5, 2)"
    assert shown["skill in use"].tolist() == ["3", "0", "1", "-"]


def test_failures_without_a_position_are_counted_by_skill():
    table = episodes()
    table[["final_x", "final_y"]] = np.nan
    counted = failures_table(table, LARGE)
    assert counted["row"].isna().all()
    assert counted["episodes"].tolist() == [1, 2, 1, 4]
    assert ends(counted)["end cell (row, column)"].tolist() == ["-"] * 4


def test_no_failures_make_an_empty_table_that_still_prints():
    table = failures_table(episodes().iloc[:2], LARGE)
    assert len(table) == 0
    assert len(ends(table)) == 0


def test_skills_table_joins_data_choices_and_replays():
    data = pd.DataFrame(
        {"code": [0, 1, 2], "share": [0.5, 0.5, 0.0], "dx": [1.0, -1.0, np.nan], "dy": 0.0, "distance": 1.0}
    )
    played = episodes()
    table = skills_table([[0, 1], [1, 1]], data, played[played["actor"] == "single skill"])
    assert table["in data"].tolist() == [50.0, 50.0, 0.0]
    assert table["chosen"].tolist() == [25.0, 75.0, 0.0]
    assert table["alone"].tolist()[:2] == [0.0, 50.0]
    assert math.isnan(table["alone"][2])


def test_skills_table_of_a_runner_tells_rewards_and_scores():
    data = pd.DataFrame({"code": [0, 1], "share": [0.5, 0.5], "reward": [0.3, 3.1], "dx": 0.0})
    table = skills_table([[1]], data, runs()[2:], effects=("reward",))
    assert table.columns.tolist() == ["skill", "in data", "chosen", "reward", "alone"]
    assert table["alone"].tolist() == [15.0, 40.0]


def test_skills_table_without_data_or_replays():
    table = skills_table([[], [2]], None, None)
    assert table.columns.tolist() == ["skill", "chosen"]
    assert table["chosen"].tolist() == [0.0, 0.0, 100.0]
    assert len(skills_table([[]], None, None)) == 0


def test_printed_table_and_its_markdown():
    shown = readable(summary_table(episodes()), LARGE)
    assert shown.iloc[0].tolist() == ["policy", 4, "75.0", "30.1 to 95.4", "75.0 ± 25.0", "340"]
    assert shown.iloc[5]["steps (median, successes)"] == "-"
    text = markdown(pd.DataFrame({"a|b": ["x|y"], "n": [1.25]}), {"n": ".1f"})
    assert text == "| a|b | n |\n| --- | --: |\n| x\\|y | 1.2 |"
