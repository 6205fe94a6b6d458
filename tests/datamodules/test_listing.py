"""Data sets are found in every format, with the tasks they fit, and half-written or broken ones do no harm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules.listing import find_datasets, fitting_tasks
from datamodules.trajectories import Trajectories
from dds_lightning.tasks import get_task
from tests.recordings import record, write_d4rl_file

Make = Callable[..., dict[str, Any]]


@pytest.fixture(autouse=True)
def _no_folders_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "no-minari"))
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "no-d4rl"))


def test_minari_sets_are_found_with_their_problems(
    minari_set: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = minari_set()
    for name, text in (("broken-v0", "{"), (".half-written", "{")):
        (tmp_path / name / "data").mkdir(parents=True)
        (tmp_path / name / "data" / "metadata.json").write_text(text)
    found = find_datasets([tmp_path]).set_index("data set")
    assert sorted(found.index) == ["broken-v0", "set-v0"]
    assert found.loc["set-v0", "environment"] == "PointMaze_Large-v3"
    assert found.loc["set-v0", "tasks"] == ("pointmaze-large-play", "pointmaze-large-diverse")
    assert found.loc["set-v0", "steps"] == 24
    assert found.loc["set-v0", "data"] == f"local:{folder}"
    assert found.loc["set-v0", "problem"] == ""
    assert "damaged" in found.loc["broken-v0", "problem"]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert len(find_datasets([tmp_path])) == 2  # each once
    assert len(find_datasets([tmp_path / "nothing"])) == 2


def test_d4rl_files_are_counted_and_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitchen, hopper = get_task("kitchen-mixed"), get_task("hopper-medium-expert")
    episodes = record(hopper, 60, episode_steps=20)
    write_d4rl_file(tmp_path / "hopper_medium_expert-v2.hdf5", hopper, episodes)
    write_d4rl_file(tmp_path / "mine.hdf5", hopper, episodes)
    write_d4rl_file(tmp_path / "cooking.hdf5", kitchen, record(kitchen, 12, episode_steps=6))
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path))
    found = find_datasets().set_index("data set")
    assert found.loc["hopper_medium_expert-v2.hdf5", "tasks"] == ("hopper-medium-expert",)
    assert found.loc["mine.hdf5", "tasks"] == ("hopper-medium", "hopper-medium-replay", "hopper-medium-expert")
    assert found.loc["cooking.hdf5", "tasks"] == ("kitchen-mixed",)  # its goal columns say so
    assert found.loc["mine.hdf5", "data"] == f"d4rl:{tmp_path / 'mine.hdf5'}"
    assert tuple(found.loc["mine.hdf5", ["episodes", "steps"]]) == (len(episodes), 60)
    assert tuple(found.loc["cooking.hdf5", ["episodes", "steps"]]) == (2, 12)
    assert not found["problem"].any()


def test_broken_d4rl_files_are_listed_with_their_problem(tmp_path: Path) -> None:
    (tmp_path / "text.hdf5").write_text("no HDF5")
    with h5py.File(tmp_path / "lacking.hdf5", "w") as file:
        file["observations"] = np.zeros((5, 11), np.float32)
    with h5py.File(tmp_path / "uneven.hdf5", "w") as file:
        file["observations"], file["actions"] = np.zeros((5, 11), np.float32), np.zeros((5, 3), np.float32)
        file["terminals"], file["timeouts"] = np.zeros(5, bool), np.zeros(4, bool)
    with h5py.File(tmp_path / "linked.hdf5", "w") as file:
        file["observations"] = h5py.ExternalLink("lacking.hdf5", "observations")
        file["actions"], file["terminals"] = np.zeros((5, 3), np.float32), np.zeros(5, bool)
    problems = find_datasets([tmp_path]).set_index("data set")["problem"]
    assert "not an HDF5 file" in problems["text.hdf5"]
    assert "'actions' is missing" in problems["lacking.hdf5"]
    assert "got 4 rows, but terminals has 5" in problems["uneven.hdf5"]
    assert "link" in problems["linked.hdf5"]


def test_folders_of_arrays_are_found(make_episode: Make, tmp_path: Path) -> None:
    Trajectories.from_episodes("mine", [make_episode(5), make_episode(3)]).save(tmp_path / "sub" / "mine")
    (tmp_path / "spoilt").mkdir()
    (tmp_path / "spoilt" / "trajectories.json").write_text("[]")
    found = find_datasets([tmp_path]).set_index("data set")
    assert tuple(found.loc["sub/mine", ["data", "episodes", "steps"]]) == (f"arrays:{tmp_path}/sub/mine", 2, 8)
    assert found.loc["sub/mine", "tasks"] == ()  # no body has two observations and one action
    assert "damaged" in found.loc["spoilt", "problem"]


def test_a_name_decides_only_between_tasks_that_fit() -> None:
    assert fitting_tasks("hopper_medium-v2.hdf5", widths=(11, 3)) == ("hopper-medium",)
    assert fitting_tasks("hopper_medium-v2.hdf5", widths=(17, 6))[0] == "halfcheetah-medium"
    assert fitting_tasks("kitchen-partial-v0", "FrankaKitchen-v1") == ("kitchen-partial",)
    assert fitting_tasks("anything", "AntMaze_UMaze-v5") == ("antmaze-umaze", "antmaze-umaze-diverse")
    assert fitting_tasks("hopper-medium-v0") == ()
