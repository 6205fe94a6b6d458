"""Machines that are not ours: shares without locks, containers without a home, projects with names like ours."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dds_lightning.errors import UserError
from dds_lightning.saving import files, run_directory
from tests.fits import call, told

ROOT = Path(__file__).parents[1]


def run(code, *, cwd=".", **environment):
    """Run code in a new process of this Python, with only these variables beside the usual ones."""
    usual = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *code], cwd=cwd, env={**usual, **environment}, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOSYS, errno.ENOTSUP])
def test_a_share_that_cannot_flush_a_folder_is_no_error(monkeypatch, number):
    def fsync(handle):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(files.os, "fsync", fsync)
    with files.written_whole(Path("here.txt")) as part:
        part.write_text("whole")
    assert Path("here.txt").read_text() == "whole"
    with files.folder_written_whole(Path("folder")) as part:
        (part / "one").write_text("1")
    assert [path.name for path in Path("folder").iterdir()] == ["one"]


def test_a_disk_that_fails_while_flushing_still_is_one(monkeypatch):
    def fsync(handle):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(files.os, "fsync", fsync)
    with pytest.raises(OSError, match=r"here.txt could not be written"), files.written_whole(Path("here.txt")) as part:
        part.write_text("whole")


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_where_there_are_no_locks_a_run_works_and_is_told(monkeypatch, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with (
        pytest.warns(UserWarning, match=r"run cannot be locked .*do not start a second"),
        run_directory.locked(Path("run")),
    ):
        Path("run/made").touch()
    assert Path("run/made").exists()


def test_without_fcntl_a_run_works_and_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with pytest.warns(UserWarning, match="do not start a second"), run_directory.locked(Path("run")):
        Path("run/made").touch()


def test_a_directory_that_is_locked_is_refused():
    second = run_directory.locked(Path("run"))
    with run_directory.locked(Path("run")), pytest.raises(UserError, match="another run or study"), second:
        pass


@pytest.fixture
def _homeless(monkeypatch):
    for name in ("HOME", "D4RL_DATASET_DIR", "MINARI_DATASETS_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def getpwuid(number):
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.setattr("pwd.getpwuid", getpwuid)


@pytest.mark.usefixtures("_homeless")
@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["tasks"], 0),
        (["tasks", "antmaze-medium-play"], 0),
        (["data", "list"], 0),
        (["data", "check", "minari:D4RL/none-v0"], 2),
        (["data", "check", "d4rl:antmaze-medium-play"], 2),
        (["data", "collect", "pointmaze-umaze-diverse", "--steps=300", "--workers=1", "--out=here"], 0),
        (["evaluate", "~/agent"], 2),
        (["run", "pointmaze-umaze-diverse", "--out=~/run"], 2),
        (["checkpoints", "list"], 0),
    ],
)
def test_commands_work_without_a_home(words, status, capfd):
    assert call(*words) == status
    if status == 2:
        assert told(capfd.readouterr().err)


@pytest.mark.parametrize("words", [["--out=~/data"], ["--out", "~/data"]], ids=" ".join)
def test_a_tilde_is_the_home_wherever_a_path_is_given(words):
    collect = ["data", "collect", "pointmaze-umaze-diverse", "--steps=300", "--workers=1"]
    assert call(*collect, *words) == 0
    assert not Path("~").exists()
    assert (Path.home() / "data" / "pointmaze-umaze-diverse-v0").is_dir()
    assert call("data", "check", "local:~/data/pointmaze-umaze-diverse-v0") == 0
    __import__("shutil").rmtree(Path.home() / "data")


def test_a_tilde_in_a_file_of_settings_is_the_home():
    from dds_lightning.training.stage_cli import StageCLI

    Path("mine.yaml").write_text(
        "data: {data: 'local:~/data', task: pointmaze-umaze-diverse}\n"
        "checkpoint: {dirpath: ~/out}\ntrainer: {default_root_dir: ~/logs}\n"
    )
    settings = StageCLI("skill", ["fit", "--config=mine.yaml"], parse_only=True).settings
    assert settings.checkpoint.dirpath == str(Path.home() / "out")
    assert settings.trainer.default_root_dir == str(Path.home() / "logs")


@pytest.mark.parametrize("value", ["nonsense", "egl"])
def test_what_draws_nothing_needs_no_graphics(value):
    code = (
        "from dds_lightning.tasks import get_task; e = get_task('pointmaze-umaze-diverse').make_env(); e.reset(seed=0)"
    )
    ran = run(["-c", code + "; print(e.step(e.action_space.sample())[0].shape)"], MUJOCO_GL=value)
    assert ran.stdout == "(4,)\n", ran.stderr


@pytest.fixture
def theirs():
    """A project with a package called `datamodules`, as Lightning's templates have."""
    folder = Path("theirs/datamodules")
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('theirs was imported')\n")
    (folder / "mnist.py").write_text("SIZE = 28\n")
    return folder.parent


def test_a_foreign_package_of_the_same_name_is_not_taken_for_ours(theirs):
    ran = run(["-m", "dds_lightning", "data", "list", "--root=[.]"], cwd=theirs)
    assert ran.returncode == 0, ran.stderr
    both = "import dds_lightning, datamodules.segments, datamodules.mnist as m; print(m.SIZE, datamodules.__file__)"
    assert run(["-c", both], cwd=theirs).stdout == f"28 {ROOT / 'datamodules' / '__init__.py'}\n"


def test_a_foreign_package_that_was_imported_first_is_named_in_one_sentence(theirs):
    (theirs / "datamodules" / "__init__.py").write_text("")
    ran = run(["-c", "import datamodules, dds_lightning"], cwd=theirs)
    last = ran.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: ")
    assert "is another package called datamodules" in last
    assert "import dds_lightning before it" in last
