"""What every source offers, and that a new one is one record and one entry of the table."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import DataError, Trajectories, load_trajectories
from datamodules.sources import SOURCES, resolve_task
from datamodules.sources.arrays import ARRAYS
from datamodules.sources.rows import open_recording
from datamodules.sources.source import Source
from datamodules.sources.stat_hash import locate, stat_hash
from dds_lightning.cli.arguments import data_spec
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

TASK = "pointmaze-umaze-play"


def toy_trajectories() -> Trajectories:
    observations = np.arange(24.0).reshape(6, 4) / 100
    observations[:, :2] += get_task(TASK).cell_to_xy([(1, 1)])
    episode = {
        "observations": observations,
        "actions": np.full((5, 2), 0.5),
        "rewards": np.arange(5.0),
        "terminations": np.zeros(5, bool),
        "truncations": np.arange(5) == 4,
    }
    return Trajectories.from_episodes("toy", [episode])


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A source whose data sets are folders of arrays, recorded in one environment."""
    folder = toy_trajectories().save(tmp_path / "toys" / "one")
    source = Source(
        rest="NUMBER",
        about="a toy",
        load=lambda rest, task: ARRAYS.load(str(folder.parent / rest), task),
        locate=lambda rest: folder.parent / rest,
        recorded_in=lambda rest: "PointMaze_UMaze-v3",
    )
    monkeypatch.setitem(SOURCES, "toy", source)
    return "toy:one"


def test_a_new_source_is_one_record(toy: str, tmp_path: Path) -> None:
    task = get_task(TASK)
    loaded = load_trajectories(toy)
    assert loaded.fingerprint() == toy_trajectories().fingerprint()
    assert resolve_task(toy, TASK) == task
    with pytest.raises(UserError, match=r"recorded in PointMaze_UMaze-v3.*needs PointMaze_Large-v3"):
        resolve_task(toy, "pointmaze-large-play")
    assert locate(toy) == tmp_path / "toys" / "one"
    assert stat_hash(toy) == stat_hash(f"arrays:{tmp_path}/toys/one")
    with open_recording(toy, task, np.random.default_rng(0)) as recording:
        assert recording.states(0, 2, 4).tolist() == toy_trajectories().observations[2:4].tolist()
        actions, rewards = recording.taken(0, 3, 5)
    assert actions.tolist() == [[0.5, 0.5]] * 2
    assert rewards.tolist() == [3, 4]


@pytest.mark.parametrize("spec", ["ftp:there", "toy:", "one"])
def test_the_error_for_an_unknown_source_lists_the_known_ones(toy: str, spec: str) -> None:
    def opened() -> contextlib.AbstractContextManager[Any]:
        return open_recording(spec, get_task(TASK), np.random.default_rng(0))

    for call in (lambda: load_trajectories(spec), lambda: stat_hash(spec), lambda: resolve_task(spec, TASK), opened):
        with pytest.raises(UserError, match=rf"got '{spec}', expected one of local:DIR .*toy:NUMBER \(a toy\)"):
            call()


def test_a_path_that_no_source_claims_lists_them_and_a_file_is_not_called_missing(toy: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no folder or .hdf5 file 'nowhere'.*toy:NUMBER"):
        data_spec("nowhere")
    (tmp_path / "table.csv").write_text("episode,reward\n")
    with pytest.raises(UserError, match=r"table.csv' is a file that does not end in .hdf5.*toy:NUMBER"):
        data_spec(str(tmp_path / "table.csv"))


def test_a_hash_changes_with_names_sizes_and_times(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    file = tmp_path / "set" / "data.hdf5"
    file.parent.mkdir()
    file.write_bytes(b"abc")
    (tmp_path / "d4rl").mkdir()
    (tmp_path / "d4rl" / "one.hdf5").write_bytes(b"abc")
    specs = [f"local:{tmp_path}/set", "minari:set", f"d4rl:{file}", "d4rl:one.hdf5", f"arrays:{tmp_path}/set"]
    before = {spec: stat_hash(spec) for spec in specs}
    assert before == {spec: stat_hash(spec) for spec in specs}
    assert before["local:" + str(tmp_path / "set")] == before["minari:set"]
    os.utime(file, ns=(1, 1))
    changed = [spec for spec in specs if stat_hash(spec) != before[spec]]
    assert changed == [spec for spec in specs if spec != "d4rl:one.hdf5"]
    assert locate("d4rl:one.hdf5") == tmp_path / "d4rl" / "one.hdf5"


@pytest.mark.parametrize(
    "spec", ["local:nowhere", "minari:nowhere", "d4rl:no/where.hdf5", "ftp:there", "local:", "d4rl:"]
)
def test_what_is_not_there_is_said_in_one_sentence(spec):
    with pytest.raises(UserError, match=r"nothing at|missing|not in|expected one of"):
        stat_hash(spec)
    assert list(Path().iterdir()) == []


def _no_states(folder):
    (folder / "observations.npy").unlink()


@pytest.mark.parametrize(
    ("spoil", "task", "remedy"),
    [
        (None, "hopper-medium", "; choose a task that fits the data (`dds tasks`), or other data"),
        (_no_states, None, "; write the folder again with `Trajectories.save`"),
    ],
)
def test_a_refusal_of_data_says_what_helps_and_only_once(tmp_path, spoil, task, remedy):
    last = np.arange(3) == 2
    flags = {"terminations": last & False, "truncations": last}
    fields = {"observations": np.zeros((4, 4)), "actions": np.zeros((3, 2)), "rewards": np.zeros(3), **flags}
    folder = Trajectories.from_episodes("mine", [fields]).save(tmp_path / "mine")
    if spoil is not None:
        spoil(folder)
    with pytest.raises(DataError) as refused:
        load_trajectories(f"arrays:{folder}", task)
    assert str(refused.value).endswith(remedy)
    assert str(refused.value).count("; ") == 1


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (
            {"actions": np.full((3, 2), 2.0)},
            "for another box give action_low and action_high, to from_episodes or in the",
        ),
        ({"observations": np.zeros((3, 4))}, "append it, or leave out the last step"),
        ({"observations": [{"observation": np.zeros(4)}] * 4}, "put their entries end to end"),
        ({"truncations": [False] * 3}, "set truncations there if only the recording ended"),
        ({"rewards": [0.0, np.nan, 0.0]}, "leave that step out"),
    ],
)
def test_so_does_a_refusal_of_arrays(change, remedy):
    last = np.arange(3) == 2
    flags = {"terminations": last & False, "truncations": last}
    fields = {"observations": np.zeros((4, 4)), "actions": np.zeros((3, 2)), "rewards": np.zeros(3), **flags}
    with pytest.raises(DataError) as refused:
        Trajectories.from_episodes("mine", [{**fields, **change}])
    assert remedy in str(refused.value)
