from __future__ import annotations

from itertools import pairwise

import pytest

from datamodules.collect.planner import MazePlanner
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

#   columns 01234
RING = ("11111", "10001", "10101", "10001", "11111")


def test_distances_round_a_ring_counted_by_hand() -> None:
    distances = MazePlanner(RING).distances_to((1, 1))
    assert distances.tolist() == [
        [-1, -1, -1, -1, -1],
        [-1, 0, 1, 2, -1],
        [-1, 1, -1, 3, -1],
        [-1, 2, 3, 4, -1],
        [-1, -1, -1, -1, -1],
    ]


def test_paths_are_shortest_and_stay_in_free_cells() -> None:
    task = get_task("pointmaze-large-diverse")
    assert task.maze_map is not None
    planner = MazePlanner(task.maze_map)
    free = set(task.free_cells())
    for goal in free:
        for start in free:
            path = planner.path(start, goal)
            assert path[0] == start
            assert path[-1] == goal
            assert set(path) <= free
            assert all(abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 for a, b in pairwise(path))
            assert len(path) - 1 == planner.distances_to(goal)[start] == planner.distances_to(start)[goal]


def test_a_body_over_a_wall_is_sent_to_the_nearest_free_cell() -> None:
    planner = MazePlanner(RING)
    goal, wall = planner.index((3, 3)), planner.index((0, 2))
    assert planner.next_cell[goal, wall] == planner.index((1, 2))


def test_no_way_and_no_maze_are_errors() -> None:
    with pytest.raises(UserError, match=r"no path from cell \(1, 1\) to cell \(1, 3\)"):
        MazePlanner(("11111", "10101", "11111")).path((1, 1), (1, 3))
    with pytest.raises(UserError, match="equally long rows of 0 and 1"):
        MazePlanner(("111", "1g1", "11"))
