"""A run directory: what is done is skipped, what was interrupted goes on, what changed is done again."""

import json
import os
import shutil

import pytest
from rich.console import Console

from dds_lightning.errors import UserError
from dds_lightning.saving.run_directory import RunDirectory, duration, locked, write_json


class Script:
    """Two stages, `first` -> `second`, that count how often they work."""

    def __init__(self, root):
        self.root, self.calls, self.fail = root, [], False

    def run(self, fresh=False, width=1, depth=1):
        stages = RunDirectory(self.root, Console(quiet=True), fresh)

        def first(folder, resuming):
            self.calls.append(("first", resuming))
            (folder / "out.txt").write_text(f"width {width}")
            return {"file": folder / "out.txt", "lines": 1}

        def second(folder, resuming):
            self.calls.append(("second", resuming))
            (folder / "partial.txt").write_text("half")
            if self.fail:
                raise RuntimeError("the power went")
            return {"file": folder / "partial.txt"}

        one = stages.do("first", "first", {"width": width}, [], first)
        stages.do("second", "second", {"depth": depth}, [one], second)
        return stages.done


@pytest.fixture
def script(tmp_path):
    return Script(tmp_path / "run")


def test_a_second_call_does_nothing_and_knows_what_was_made(script):
    made = script.run()
    again = script.run()
    assert script.calls == [("first", False), ("second", False)]
    assert [stage.skipped for stage in again] == [True, True]
    assert again[0].outputs == made[0].outputs
    assert again[0].digest == made[0].digest
    assert again[0].facts == {"lines": 1}


def test_a_changed_setting_redoes_its_stage_and_what_depends_on_it_and_keeps_the_previous_result(script):
    script.run()
    script.run(width=2)
    assert script.calls[2:] == [("first", False), ("second", False)]
    assert (script.root / "first" / "out.txt").read_text() == "width 2"
    assert (script.root / "previous" / "first" / "out.txt").read_text() == "width 1"


def test_a_changed_setting_of_the_last_stage_leaves_the_first_alone(script):
    script.run()
    script.run(depth=2)
    assert script.calls[2:] == [("second", False)]


def test_the_reason_for_doing_a_stage_again_is_told(script):
    script.run()
    script_console = Console(record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    stages = RunDirectory(script.root, script_console)
    stages.do("first", "first", {"width": 5}, [], lambda folder, resuming: {})
    assert "width 1 -> 5" in script_console.export_text()


def test_an_interrupted_stage_is_resumed_with_its_files(script):
    script.fail = True
    with pytest.raises(RuntimeError):
        script.run()
    assert json.loads((script.root / "second" / "stage.json").read_text())["state"] == "started"
    script.fail = False
    script.run()
    assert script.calls == [("first", False), ("second", False), ("second", True)]


def test_an_interrupted_stage_with_other_settings_starts_anew(script):
    script.fail = True
    with pytest.raises(RuntimeError):
        script.run()
    script.fail = False
    script.run(depth=3)
    assert script.calls[-1] == ("second", False)


def test_a_lost_or_changed_output_is_made_again(script):
    script.run()
    (script.root / "first" / "out.txt").write_text("edited by hand")
    script.run()
    # The first stage makes the same bytes again, so the second has nothing to do.
    assert script.calls[2:] == [("first", False)]
    (script.root / "second" / "partial.txt").unlink()
    script.run()
    assert script.calls[3:] == [("second", False)]


def test_a_damaged_marker_counts_as_not_done(script):
    script.run()
    (script.root / "second" / "stage.json").write_text('{"state": "fini')
    script.run()
    assert script.calls[2:] == [("second", False)]


def test_fresh_does_everything_again(script):
    script.run()
    script.run(fresh=True)
    assert script.calls[2:] == [("first", False), ("second", False)]


def test_two_runs_cannot_share_a_directory(tmp_path):
    second = locked(tmp_path / "run")
    with locked(tmp_path / "run"), pytest.raises(UserError, match="another run or study works"):
        second.__enter__()


def test_a_run_that_fails_before_its_first_stage_leaves_no_directory(tmp_path):
    with pytest.raises(UserError), locked(tmp_path / "run"):
        raise UserError("no")
    assert not (tmp_path / "run").exists()


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    write_json(tmp_path / "a.json", {"x": 1})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": 1}


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.25, "0.2 s"), (59.4, "59 s"), (83, "1 min 23 s"), (7260, "2 h 1 min")]
)
def test_durations_read_like_speech(seconds, text):
    assert duration(seconds) == text


# ---------------------------------------------------------------- links of a stranger's run directory


@pytest.fixture
def precious(tmp_path):
    """A folder of the user's that a stranger's link points to."""
    folder = tmp_path / "precious"
    folder.mkdir()
    for name in ("thesis", "first", "second"):
        (folder / name).mkdir()
        (folder / name / "text").write_text("years of work")
    (folder / "file").write_text("years of work")
    return folder


def contents(folder):
    return {path.relative_to(folder): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("link", "target"),
    [
        ("run.lock", "file"),
        ("run.lock", "new"),
        ("previous", "."),
        ("first", "thesis"),
        ("second/logs", "thesis"),
        ("second/stage.json", "file"),
        ("report", "thesis"),
    ],
)
def test_a_link_out_of_a_run_directory_is_refused_and_its_target_stays_as_it_is(script, precious, link, target):
    script.run()
    before = contents(precious)
    place = script.root / link
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.symlink_to(precious / target)
    with (
        pytest.raises(UserError, match=f"{link} is a link to .*expected the file or folder itself"),
        locked(script.root),
    ):
        script.run(fresh=True)
    assert contents(precious) == before


def test_the_run_directory_itself_may_be_a_link_of_the_users(script, tmp_path):
    script.run()
    (tmp_path / "link").symlink_to(script.root)
    with locked(tmp_path / "link"):
        script.run(width=2)
    assert (tmp_path / "link" / "previous" / "first" / "out.txt").read_text() == "width 1"


def test_a_previous_folder_that_is_a_link_is_not_followed_even_without_the_lock(script, precious):
    script.run()
    (script.root / "previous").symlink_to(precious)
    before = contents(precious)
    with pytest.raises(UserError, match="was not deleted: there is a link on the way"):
        script.run(width=2)
    assert contents(precious) == before


def test_a_lock_is_opened_without_being_emptied(tmp_path):
    (tmp_path / "run.lock").write_text("mine")
    with locked(tmp_path):
        pass
    assert (tmp_path / "run.lock").read_text() == "mine"


def test_a_lock_that_is_a_pipe_does_not_wait(tmp_path):
    os.mkfifo(tmp_path / "run.lock")
    with pytest.raises(UserError, match=r"run\.lock is a pipe or a device.*delete it"), locked(tmp_path):
        pass
