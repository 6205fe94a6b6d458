"""The figure of a data set holds its numbers: every step and every episode is in it once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch

from datamodules.trajectories import Trajectories
from dds_lightning.envs.kitchen import SUBTASKS
from dds_lightning.interpret.draw.dataset import ACTION_BARS, SQUARES, plot_dataset
from dds_lightning.tasks import Task, get_task


def trajectories(task: Task, lengths: list[int], **changes: Any) -> Trajectories:
    """Episodes of given lengths with every observation 0 and actions all over the box."""
    steps, ends = sum(lengths), np.cumsum(lengths) - 1
    last = np.zeros(steps, bool)
    last[ends] = True
    arrays = {
        "observations": np.zeros((steps + len(lengths), task.observation_dim), np.float32),
        "actions": np.random.default_rng(0).uniform(-1, 1, (steps, task.action_dim)).astype(np.float32),
        "rewards": np.ones(steps, np.float32),
        "terminations": last & False,
        "truncations": last,
        "lengths": np.array(lengths),
        "action_low": np.full(task.action_dim, -1, np.float32),
        "action_high": np.full(task.action_dim, 1, np.float32),
    }
    return Trajectories(name="made", **{**arrays, **changes})


def panel(figure: Figure, label: str) -> Axes:
    """The panel with an x label that begins so."""
    (found,) = [ax for ax in figure.axes if ax.get_xlabel().startswith(label)]
    return found


def heights(ax: Axes) -> list[list[float]]:
    """Heights of the bars of each histogram in a panel."""
    return [[bar.get_height() for bar in group] for group in ax.containers if isinstance(group, BarContainer)]


def widths(ax: Axes) -> dict[str, float]:
    """Labels and lengths of horizontal bars."""
    labels = [text.get_text() for text in ax.get_yticklabels()]
    (bars,) = [group for group in ax.containers if isinstance(group, BarContainer)]
    return dict(zip(labels, [bar.get_width() for bar in bars], strict=True))


def test_every_episode_is_counted_by_its_length_and_its_end() -> None:
    task = get_task("hopper-medium")
    lengths = [10, 20, 20, 400, 1000]
    ended = np.zeros(sum(lengths), bool)
    ended[[9, 29]] = True
    data = trajectories(task, lengths, terminations=ended)
    data = trajectories(task, lengths, terminations=ended, truncations=data.truncations & ~ended)
    ax = panel(plot_dataset(data, task), "steps of an episode")
    truncated, terminated = heights(ax)
    assert (sum(truncated), sum(terminated)) == (3, 2)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["truncated", "terminated", "cap of evaluation"]
    (cap,) = [line for line in ax.lines if isinstance(line, Line2D)]
    assert cap.get_xdata()[0] == 1000


def test_returns_have_the_normalised_score_above_them() -> None:
    task = get_task("hopper-medium")
    figure = plot_dataset(trajectories(task, [500, 700, 900]), task)
    ax = panel(figure, "return")
    assert sum(heights(ax)[0]) == 3
    (above,) = ax.child_axes
    assert above.get_xlabel() == "normalised score"
    figure.draw_without_rendering()
    np.testing.assert_allclose(above.get_xlim(), task.normalised_score(ax.get_xlim()))
    without = panel(plot_dataset(trajectories(task, [500, 700])), "return")
    assert without.child_axes == []


def test_equal_episodes_and_a_single_one_can_be_drawn() -> None:
    task = get_task("walker2d-medium")
    for lengths in ([1000] * 4, [1]):
        figure = plot_dataset(trajectories(task, lengths), task)
        assert sum(heights(panel(figure, "steps"))[0]) == len(lengths)
        assert sum(heights(panel(figure, "return"))[0]) == len(lengths)


@pytest.mark.parametrize("name", ["pointmaze-large-diverse", "antmaze-large-play", "antmaze-large-play@robotics"])
def test_visits_lie_in_their_cells_whichever_way_y_grows(name: str) -> None:
    task = get_task(name)
    assert task.start_cell is not None
    cells = [task.start_cell] * 40 + [(1, 4)] * 60  # (1, 4) lies far from every mirror image of itself
    observations = np.zeros((100, task.observation_dim), np.float32)
    observations[:, :2] = task.cell_to_xy(cells) + 0.05 * task.cell_size
    ax = panel(plot_dataset(trajectories(task, [99], observations=observations), task), "x (m)")
    (mesh,) = [one for one in ax.collections if isinstance(one, QuadMesh)]
    corners = mesh.get_coordinates()
    counts = np.ma.getdata(mesh.get_array()).reshape(corners.shape[0] - 1, corners.shape[1] - 1)
    assert counts.sum() == 100
    for cell, count in ((task.start_cell, 40), ((1, 4), 60)):
        i, j = np.argwhere(counts == count)[0]
        middle = (corners[i, j] + corners[i + 1, j + 1]) / 2
        assert np.abs(middle - task.cell_to_xy(cell) - 0.05 * task.cell_size).max() <= task.cell_size / SQUARES / 2
    low, high = np.sort([ax.get_ylim()[0], ax.get_ylim()[1]])
    assert low <= corners[..., 1].min() + 1e-9
    assert high >= corners[..., 1].max() - 1e-9


def test_a_maze_says_how_many_episodes_reach_the_goal() -> None:
    task = get_task("pointmaze-umaze-play")
    rewards = np.zeros(30, np.float32)
    rewards[9] = 1
    figure = plot_dataset(trajectories(task, [10, 10, 10], rewards=rewards), task)
    assert widths(panel(figure, "episodes that reach")) == {"no": 2, "yes": 1}


def test_the_kitchen_counts_subtasks_that_were_ever_done() -> None:
    task = get_task("kitchen-mixed")
    observations = np.zeros((36, 60), np.float32)
    for row, names in ((0, ["kettle"]), (5, ["microwave"]), (7, ["light switch"]), (20, ["microwave"])):
        for name in names:
            columns, values = SUBTASKS[name]
            observations[row, list(columns)] = values
    figure = plot_dataset(trajectories(task, [11, 11, 11], observations=observations), task)
    assert heights(panel(figure, "subtasks completed in an episode"))[0] == [1, 1, 1, 0, 0]
    done = widths(panel(figure, "episodes that complete it"))
    assert done == {"microwave": 2, "kettle": 0, "bottom burner": 0, "light switch": 1}  # row 0: before any step


def test_every_action_has_a_row_and_its_share_of_saturated_steps() -> None:
    task = get_task("antmaze-umaze")
    actions = np.zeros((400, 8), np.float32)
    actions[:, 1] = np.linspace(-0.99, 0.99, 400)
    actions[:100, 2], actions[100:200, 2] = 1.0, -1.0
    ax = panel(plot_dataset(trajectories(task, [400], actions=actions), task), "action")
    names = [text.get_text() for text in ax.get_yticklabels()]
    assert names == ["hip 4", "ankle 4", "hip 1", "ankle 1", "hip 2", "ankle 2", "hip 3", "ankle 3"]
    shares = [text.get_text() for text in ax.texts if text.get_text().endswith("%")]
    assert shares == ["0%", "0%", "50%", *["0%"] * 5]
    rows = [patch for patch in ax.patches if isinstance(patch, StepPatch)]
    assert len(rows) == 8
    values, _, base = rows[0].get_data()
    assert np.flatnonzero(values - base).tolist() == [ACTION_BARS // 2]  # an action of 0 all the time
    values, _, base = rows[1].get_data()
    assert np.ptp(values[1:-1]) < 0.2  # the same everywhere


def test_boxes_of_different_widths_say_their_bounds_in_words() -> None:
    task = get_task("pointmaze-umaze-play")
    ax = panel(plot_dataset(trajectories(task, [9], action_high=np.array([1, 2], np.float32)), task), "action")
    assert [text.get_text() for text in ax.get_xticklabels()] == ["lower bound", "upper bound"]
