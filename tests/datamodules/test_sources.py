"""A new source is one row: everything that reads data then knows it."""

import contextlib

import numpy as np
import pytest

from datamodules.sources import SOURCES, Source, load_trajectories, locate, open_rows, resolve_task, stat_hash
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.cli import main
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

TASK = "pointmaze-umaze-diverse"


def ones(rest, task):
    """As many steps of ones as the name says."""
    steps = int(rest)
    episode = {"observations": np.ones((steps + 1, 4)), "actions": np.ones((steps, 2)), "rewards": np.zeros(steps)}
    last = np.arange(steps) == steps - 1
    return Trajectories.from_episodes("ones", [{**episode, "terminations": ~last & last, "truncations": last}])


class Rows:
    where, width = "data set 'ones'", 4

    def __init__(self, rest):
        self.steps = self.known = np.array([int(rest)])
        self.ended = np.array([False])


@pytest.fixture(autouse=True)
def _registered(monkeypatch, tmp_path):
    def recorded_in(rest):
        return None if rest != "7" else "PointMaze_Large-v3"

    def open_ones(rest, task, rng):
        return contextlib.nullcontext(Rows(rest))

    row = Source(ones, lambda rest: tmp_path / rest, open_ones, recorded_in)
    monkeypatch.setitem(SOURCES, "ones", row)


def test_one_row_loads_locates_hashes_and_opens(tmp_path):
    task = get_task(TASK)
    data = load_trajectories("ones:30", TASK, reward="recorded")
    assert (data.num_steps, data.observations.mean()) == (30, 1.0)
    (tmp_path / "30").write_text("some")
    assert locate("ones:30") == tmp_path / "30"
    before = stat_hash("ones:30")
    (tmp_path / "30").write_text("other")
    assert stat_hash("ones:30") != before
    with open_rows("ones:30", task, np.random.default_rng(0)) as rows:
        assert rows.steps.tolist() == [30]


def test_a_row_that_says_where_it_was_recorded_is_held_against_the_task():
    assert resolve_task("ones:3", TASK) == get_task(TASK)
    with pytest.raises(DataError, match="PointMaze_Large-v3"):
        resolve_task("ones:7", TASK)


def test_the_refusals_list_the_new_source():
    with pytest.raises(UserError, match=r"expected one of local:..., minari:..., arrays:..., d4rl:..., ones:..."):
        load_trajectories("twos:3")
    with pytest.raises(UserError, match=r"data is 'ones:4', but there is nothing at"):
        locate("ones:4")


def test_the_command_line_takes_the_new_source(capsys):
    assert main(["data", "check", "ones:30"]) == 0
    assert "ones:30 is sound" in capsys.readouterr().out
