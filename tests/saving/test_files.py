"""Files and folders take their names when they are whole; what was there comes back after any stop."""

import contextlib
import os
import shutil
import time

import numpy as np
import pytest

from datamodules import collect_pointmaze, load_trajectories
from datamodules.storage import refuse_existing
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.saving import checkpoint as checkpointing
from dds_lightning.saving.checkpoint import AtomicCheckpointIO, load_ckpt
from dds_lightning.saving.files import STALE_AFTER, folder_written_whole, mend_folder, written_whole


def tree(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def write(folder, text):
    with folder_written_whole(folder) as part:
        (part / "inner").mkdir()
        (part / "inner" / "a.txt").write_text(text)
        (part / text).write_text("")


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    write(tmp_path / "deep" / "set", "one")
    assert tree(tmp_path) == {"deep/set/inner/a.txt": "one", "deep/set/one": ""}
    write(tmp_path / "deep" / "set", "two")
    assert tree(tmp_path) == {"deep/set/inner/a.txt": "two", "deep/set/two": ""}


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_fails_on_the_way_leaves_the_previous_folder_and_nothing_else(tmp_path, error):
    write(tmp_path / "set", "one")

    def stop(part):
        (part / "half").write_text("")
        raise error

    for name in ("set", "new"):
        with pytest.raises(error), folder_written_whole(tmp_path / name) as part:
            stop(part)
    assert tree(tmp_path) == {"set/inner/a.txt": "one", "set/one": ""}
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize("failing", [1, 2])
def test_a_rename_that_fails_brings_the_previous_folder_back(tmp_path, monkeypatch, failing):
    write(tmp_path / "set", "one")
    rename, calls = os.rename, []

    def fail(source, target):
        calls.append(target)
        if len(calls) == failing:
            raise OSError(5, "Input/output error")
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", fail)
        with pytest.raises(OSError, match="set could not be written"):
            write(tmp_path / "set", "two")
    assert tree(tmp_path) == {"set/inner/a.txt": "one", "set/one": ""}


def test_a_kill_between_the_renames_is_mended_by_whoever_looks_next(tmp_path):
    write(tmp_path / "set", "one")
    shutil.copytree(tmp_path / "set", tmp_path / ".set.previous")
    mend_folder(tmp_path / "set")  # killed after both: the new one stays
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    os.rename(tmp_path / "set", tmp_path / ".set.previous")
    with pytest.raises(UserError, match="set exists already"):
        refuse_existing(tmp_path / "set", overwrite=False)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_data_sets_are_mended_when_they_are_read(tmp_path):
    arrays = {"observations": np.zeros((3, 2)), "actions": np.zeros((2, 1)), "rewards": np.zeros(2)}
    ends = {"terminations": np.zeros(2, bool), "truncations": np.array([False, True])}
    mine = Trajectories.from_episodes("mine", [{**arrays, **ends}]).save(tmp_path / "mine")
    maze = collect_pointmaze("pointmaze-umaze-diverse", 40, 0, tmp_path, workers=1, progress=False)
    for folder in (mine, maze):
        os.rename(folder, folder.with_name(f".{folder.name}.previous"))
    assert Trajectories.load(mine).num_steps == 2
    assert load_trajectories(f"local:{maze}", "pointmaze-umaze-diverse").num_steps > 30


def test_unfinished_folders_go_when_nothing_in_them_was_touched_for_an_hour(tmp_path):
    old = time.time() - STALE_AFTER - 60
    for name in ("00000000", "11111111"):
        part = tmp_path / f".set.{name}.part"
        (part / "data").mkdir(parents=True)
        (part / "data" / "episodes").write_text("some")
        for path in (part / "data" / "episodes", part / "data", part):
            os.utime(path, (old, old))
    os.utime(tmp_path / ".set.11111111.part" / "data" / "episodes")  # somebody still records there
    write(tmp_path / "set", "one")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".set.11111111.part", "set"]


def test_an_error_of_the_disk_names_the_file_and_keeps_its_kind(tmp_path):
    def write_with(error):
        with written_whole(tmp_path / "a.txt"):
            raise error

    with pytest.raises(PermissionError, match=r"a\.txt could not be written \(no\); what was there") as caught:
        write_with(OSError(13, "no"))
    assert caught.value.errno == 13
    with pytest.raises(OSError, match=r"could not be written \(9 requested and 5 written\)"):
        write_with(OSError("9 requested and 5 written"))
    with pytest.raises(FileNotFoundError, match=r"^\[Errno 2\] other: 'x'$"):
        write_with(FileNotFoundError(2, "other", "x"))
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_that_reads_back_differently_does_not_replace_the_previous_one(tmp_path, monkeypatch):
    io, path = AtomicCheckpointIO(), tmp_path / "last.ckpt"
    io.save_checkpoint({"state_dict": {}, "epoch": 1, "note": "x" * 1000}, path)
    real = checkpointing._write

    def bad_disk(checkpoint, part):
        real(checkpoint, part)
        data = bytearray(part.read_bytes())
        data[data.index(b"x" * 100) + 50] ^= 1
        part.write_bytes(data)

    monkeypatch.setattr(checkpointing, "_write", bad_disk)
    with pytest.raises(OSError, match=r"last\.ckpt could not be written \(it reads back differently: .*data\.pkl"):
        io.save_checkpoint({"state_dict": {}, "epoch": 2, "note": "x" * 1000}, path)
    assert load_ckpt(path)["epoch"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["last.ckpt"]


def test_a_leftover_of_a_kill_does_not_keep_anybody_from_writing(tmp_path):
    with contextlib.suppress(KeyboardInterrupt), written_whole(tmp_path / "a.txt") as part:
        shutil.copy(__file__, tmp_path / ".a.txt.22222222.part")
        raise KeyboardInterrupt
    with written_whole(tmp_path / "a.txt") as part:
        part.write_text("whole")
    assert (tmp_path / "a.txt").read_text() == "whole"
