"""The comparison of reused skills: its table from known curves, and the measurements that the notebook reads."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.reuse_skills import WAYS, plot, summary

MEASURED = Path(__file__).parents[1] / "notebooks" / "figures" / "skills-reused.csv"


def curves(success):
    """Two seeds of each way; the policy begins when the skills are learnt, 10 seconds for 100 steps."""
    rows = []
    for way in WAYS:
        for seed in (0, 1):
            for i, value in enumerate(success[seed]):
                step = way.steps + 100.0 * i
                row = {"seed": seed, "way": way.name, "stage": "policy", "step": step, "seconds": step / 10}
                rows.append({**row, "success": value})
    return pd.DataFrame(rows)


def test_the_table_tells_the_end_and_when_three_quarters_succeed():
    table = summary(curves([(0, 50, 80, 70), (0, 60, 70, 74)])).set_index("skills in Large")
    assert table.loc["reused as they are"].tolist() == ["72 ± 3", "300", "30 ± 0", "1 of 2", "200", "20"]
    assert table.loc["nothing"].tolist() == ["72 ± 3", "1300", "130 ± 0", "1 of 2", "1200", "120"]


def test_the_committed_measurements_are_of_three_seeds_and_can_be_drawn():
    measured = pd.read_csv(MEASURED)
    policy = measured[measured["stage"] == "policy"]
    assert set(policy["way"]) == {way.name for way in WAYS}
    for way in WAYS:
        own = policy[policy["way"] == way.name]
        assert own.groupby("seed").size().tolist() == [9, 9, 9]
        for _, curve in own.groupby("seed"):
            assert curve["step"].iloc[0] == way.steps
            assert (np.diff(curve["step"]) == 500).all()
            assert curve["seconds"].is_monotonic_increasing
            assert curve["success"].between(0, 100).all()
    errors = measured[measured["stage"] == "skill"]["rmse"]
    assert errors.between(0.2, 1.0).all()
    assert len(plot(measured).axes) == 3


@pytest.mark.parametrize("way", [way for way in WAYS if way.trainable], ids=lambda way: way.name)
def test_the_measured_gain_is_the_skill_training_that_is_saved(way):
    """What the notebook says: everything ends alike, and what reusing saves are steps of skill training."""
    policy = pd.read_csv(MEASURED).query("stage == 'policy'")
    last = policy.groupby(["way", "seed"]).last().groupby("way")[["step", "seconds", "success"]].mean()
    assert abs(last.loc[way.name, "success"] - last.loc["nothing", "success"]) < 15
    assert last.loc[way.name, "seconds"] < 0.8 * last.loc["nothing", "seconds"]
