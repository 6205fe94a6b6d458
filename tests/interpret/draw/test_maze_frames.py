"""Mazes are drawn where their environments have them, in D4RL's frame and in gymnasium-robotics'."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from dds_lightning.interpret.draw.drawing import draw_walls, extent, goal_outline, zoom
from dds_lightning.interpret.draw.maze import plot_trajectories, plot_value_map
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.tasks import get_task

FRAMES = {  # of one maze: left, right, bottom and top in metres, and whether the map's first row is the lowest
    "antmaze-medium-diverse": ((-6.0, 26.0), (-6.0, 26.0), True),
    "antmaze-medium-diverse@robotics": ((-16.0, 16.0), (-16.0, 16.0), False),
    "antmaze-large-play": ((-6.0, 42.0), (-6.0, 30.0), True),
    "antmaze-large-play@robotics": ((-24.0, 24.0), (-18.0, 18.0), False),
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_maze_is_drawn_in_its_environments_frame_with_y_up(name):
    task, (x, y, down) = get_task(name), FRAMES[name]
    assert extent(task) == (x, y)
    ax = Figure().add_subplot()
    draw_walls(ax, task)
    assert (ax.get_xlim(), ax.get_ylim()) == (x, y)
    (collection,) = [c for c in ax.collections if isinstance(c, PatchCollection)]
    boxes = np.array([path.get_extents().extents for path in collection.get_paths()])
    np.testing.assert_allclose(boxes[:, 2:] - boxes[:, :2], task.cell_size)
    np.testing.assert_allclose((boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)), np.transpose([x, y]))
    drawn = {tuple(cell) for cell in task.xy_to_cell((boxes[:, :2] + boxes[:, 2:]) / 2)}
    assert drawn == {(i, j) for i, row in enumerate(task.maze_map) for j, v in enumerate(row) if v == "1"}
    edge = y[0] + task.cell_size / 2 if down else y[1] - task.cell_size / 2
    assert task.cell_to_xy((0, 3))[1] == edge  # the map's first row


@pytest.mark.parametrize("name", FRAMES)
def test_the_goals_outline_holds_every_goal_and_its_radius(name):
    task = get_task(name)
    ax = Figure().add_subplot()
    draw_walls(ax, task)
    outline = goal_outline(task)
    for polygon in (patch for patch in ax.patches if isinstance(patch, Polygon)):
        np.testing.assert_array_equal(polygon.get_xy()[:-1], outline)
    centre, side = task.cell_to_xy(task.goal_cell), 1.5 if task.physics == "d4rl" else 0.0
    np.testing.assert_allclose(outline.min(axis=0), centre - task.goal_radius, atol=1e-3)
    np.testing.assert_allclose(outline.max(axis=0), centre + side + task.goal_radius, atol=1e-3)
    nearest = np.clip(outline, centre, centre + side)  # the goal that is nearest to a place of the edge
    np.testing.assert_allclose(np.linalg.norm(outline - nearest, axis=1), task.goal_radius)


@pytest.mark.parametrize("name", ["antmaze-medium-diverse", "antmaze-medium-diverse@robotics"])
def test_a_window_stays_inside_the_maze_in_both_frames(name):
    task, (x, y, down) = get_task(name), FRAMES[name]
    ax = Figure().add_subplot()
    zoom(ax, task, task.cell_to_xy((0, 0)), 10.0)
    assert ax.get_xlim() == (x[0], x[0] + 20.0)
    assert ax.get_ylim() == ((y[0], y[0] + 20.0) if down else (y[1] - 20.0, y[1]))
    zoom(ax, task, task.cell_to_xy((4, 3)), 6.0)
    middle = task.cell_to_xy((4, 3))
    np.testing.assert_allclose(np.mean([ax.get_xlim(), ax.get_ylim()], axis=1), middle)


@pytest.mark.parametrize("name", ["antmaze-medium-diverse", "antmaze-medium-diverse@robotics"])
def test_a_value_map_colours_every_place_with_its_own_value(name):
    task = get_task(name)
    asked = []

    def value(observations):
        asked.append(observations)
        return observations[:, 0] + 100.0 * observations[:, 1]

    images = plot_value_map(task, value, resolution=2).axes[0].images
    for image in images:
        left, right, bottom, top = image.get_extent()
        assert image.origin == "lower"
        assert (right - left, top - bottom) == (4.0, 4.0)
        xs, ys = (left + 1.0, left + 3.0), (bottom + 1.0, bottom + 3.0)
        np.testing.assert_allclose(image.get_array(), [[x + 100.0 * y for x in xs] for y in ys])
    centres = [np.mean(np.reshape(image.get_extent(), (2, 2)), axis=1) for image in images]
    assert {tuple(cell) for cell in task.xy_to_cell(centres)} == set(task.free_cells())
    np.testing.assert_array_equal(asked[0][:, 2:], np.tile([0.75, 1.0] + [0.0] * 25, (len(asked[0]), 1)))  # upright


def test_numbers_keep_their_distance_in_cells_whatever_the_size_of_a_cell():
    task = get_task("antmaze-umaze")
    t = np.linspace(0, 2, 61)[:, None]
    path = RolloutPath((task.start_xy() + t * [4.0, 0.0]).astype(np.float32), (np.arange(60) // 10).astype(np.int16))
    row = {"actor": "A", "label": "A", "episode": 0, "success": False, "length": 60}
    result = RolloutResult(task.name, pd.DataFrame([row]), {("A", 0): path})
    texts = plot_trajectories(task, result, "A").axes[0].texts
    assert [text.get_text() for text in texts] == ["2", "4"]  # a code every third of a cell, room every half
    np.testing.assert_allclose([text.xy for text in texts], path.positions[[20, 40]])
