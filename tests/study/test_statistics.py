"""Statistics, against numbers worked out by hand, numbers that were published, and SciPy."""

import numpy as np
import pytest
from scipy import stats

from dds_lightning.study.paper import TABLE1
from dds_lightning.study.statistics import (
    evaluation_curve,
    interval,
    iqm,
    mean_std,
    performance_profile,
    probability_of_improvement,
    resampled,
)


@pytest.mark.parametrize(
    ("scores", "text"),
    [([80.0, 82.0, 84.0], "82.0 ± 2.0"), ([97.5], "97.5"), ([], "-"), ([0.0, 0.0], "0.0 ± 0.0")],
)
def test_a_cell_is_printed_as_the_paper_prints_it(scores, text):
    assert mean_std(scores) == text


@pytest.mark.parametrize(
    ("method", "family", "printed"),
    [
        ("DDS", "halfcheetah hopper walker2d", 79.3),
        ("IQL", "halfcheetah hopper walker2d", 77.0),
        ("DDS", "antmaze", 88.7),
        ("IQL", "antmaze", 63.0),
        ("DQL", "antmaze", 69.6),
        ("DDS", "kitchen", 66.3),
    ],
)
def test_the_papers_averages_follow_from_its_rows(method, family, printed):
    rows = [row[method] for task, row in TABLE1.items() if task.split("-")[0] in family.split()]
    assert mean_std(np.mean([score for score, _ in rows])) == str(printed)


def test_the_interquartile_mean_is_the_mean_of_the_middle_half():
    scores = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0], [6.0, 1000.0]])  # the middle four of eight: 2, 3, 4, 5
    assert iqm(scores) == 3.5
    assert iqm(np.stack([scores, scores + 1])).tolist() == [3.5, 4.5]


def test_a_bootstrap_sample_draws_every_task_from_itself():
    scores = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    drawn = resampled(scores, 500)
    assert drawn.shape == (500, 3, 2)
    assert set(drawn[..., 0].ravel()) == {1, 2, 3}
    assert set(drawn[..., 1].ravel()) == {10, 20, 30}
    assert drawn.mean(axis=(0, 1)) == pytest.approx([2, 20], rel=0.03)
    assert (drawn[..., 0] * 10 != drawn[..., 1]).any(), "tasks are drawn independently of one another"


def test_the_interval_is_scipys_where_there_is_one_task():
    scores = np.random.default_rng(0).normal(70, 10, size=(20, 1))
    for statistic, theirs in ((iqm, lambda x, axis: stats.trim_mean(x, 0.25, axis=axis)), (None, np.mean)):
        ours = interval(scores, statistic or (lambda x: x.mean(axis=(-2, -1))), count=20_000)
        found = stats.bootstrap((scores[:, 0],), theirs, method="percentile", n_resamples=20_000, rng=1)
        assert ours.low == pytest.approx(found.confidence_interval.low, abs=0.25)
        assert ours.high == pytest.approx(found.confidence_interval.high, abs=0.25)
        assert ours.low < ours.value < ours.high


def test_an_interval_is_the_same_every_time_and_a_point_where_nothing_varies():
    scores = np.random.default_rng(1).normal(size=(5, 3))
    assert interval(scores) == interval(scores)
    assert interval(np.full((4, 2), 7.0)) == (7.0, 7.0, 7.0)


def test_the_probability_of_improvement_is_that_of_mann_whitney():
    random = np.random.default_rng(2)
    x, y = random.integers(0, 10, (6, 1)).astype(float), random.integers(0, 8, (9, 1)).astype(float)
    expected = stats.mannwhitneyu(x[:, 0], y[:, 0]).statistic / (6 * 9)
    found = probability_of_improvement(x, y)
    assert found.value == pytest.approx(expected)
    assert found.low < found.value < found.high
    by_hand = probability_of_improvement([[1.0, 5.0], [3.0, 5.0]], [[2.0, 5.0], [2.0, 9.0]])
    assert by_hand.value == pytest.approx((2 / 4 + (0.5 + 0.5) / 4) / 2)  # task 1: 2 of 4; task 2: two ties of 4


def test_a_performance_profile_counts_the_runs_above():
    assert performance_profile([[10.0, 50.0], [50.0, 90.0]], [0, 10, 49, 50, 90]).tolist() == [1, 0.75, 0.75, 0.25, 0]


def test_more_evaluations_find_the_better_policy():
    random = np.random.default_rng(3)
    means = np.array([20.0, 40.0, 60.0, 80.0])
    curve = evaluation_curve(means[:, None] + random.normal(0, 15, (4, 200)), 80, repeats=150)
    assert curve[0] == pytest.approx(50, abs=6)  # one episode: any of the four
    assert curve[-1] > 78
    assert curve[3] > curve[0]  # each has been seen once
    noiseless = evaluation_curve(np.repeat(means[:, None], 3, axis=1), 6, repeats=50)
    assert noiseless[3:].tolist() == [80, 80, 80]


def test_a_bandit_over_one_policy_has_nothing_to_choose():
    assert evaluation_curve([[1.0, 3.0]], 5).tolist() == [2.0] * 5
