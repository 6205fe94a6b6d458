"""Scores as bars: one for each row, in the table's order, and no name over another."""

import itertools

import pandas as pd

from dds_lightning.interpret.draw.bars import plot_scores


def test_every_row_has_a_bar_of_its_score_and_its_name_beside_it():
    names = [
        "AWR policy, sampled",
        "a contestant with so long a name that it takes three lines of the figure's side " * 2,
    ]
    summary = pd.DataFrame(
        {
            "contestant": [*names, "skill 0 alone"],
            "kind": ["contestant", "contestant", "skill"],
            "score": [90.0, -5.0, 40.0],
            "score_error": [1.5, 2.0, float("nan")],
        }
    )
    figure = plot_scores(summary)
    ax = figure.axes[0]
    bars = sorted(ax.patches, key=lambda bar: -bar.get_y())
    assert [bar.get_width() for bar in bars] == [90.0, -5.0, 40.0]
    assert bars[0].get_facecolor() == bars[1].get_facecolor() != bars[2].get_facecolor()
    assert [text.get_text() for text in ax.texts] == ["40.0", "-5.0", "90.0"]
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in ax.get_yticklabels()]
    assert all(below.y1 <= above.y0 for below, above in itertools.pairwise(boxes))


def test_every_seed_is_a_point():
    scores = [[80.0, 100.0], [10.0, 20.0]]
    rows = {"contestant": ["a", "b"], "kind": "contestant", "score": [90.0, 15.0], "score_error": [14.1, 7.1]}
    figure = plot_scores(pd.DataFrame({**rows, "scores": scores}), "standard deviation")
    points = [list(line.get_xdata()) for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert points == scores[::-1]  # bars are drawn from the bottom
    assert figure.axes[0].get_xlabel().endswith("± standard deviation")
