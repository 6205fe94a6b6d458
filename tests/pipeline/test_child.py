"""Work in a process of its own: its result, its messages, its errors, and who ends when."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dds_lightning.console.interrupts import Interrupted
from dds_lightning.errors import ToldAlreadyError, UserError
from dds_lightning.pipeline.child import Children

HERE = "tests.pipeline.child_work"


def test_a_process_returns_what_its_function_returns_and_its_messages_carry_its_name(capfd):
    with Children(1) as children:
        assert children.run("doubling", f"{HERE}:double", 21) == 42
    assert "doubling | working\n" in capfd.readouterr().err


def test_a_process_has_one_thread(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS")
    with Children(1) as children:
        assert children.run("counting", f"{HERE}:variable", "OMP_NUM_THREADS") == "1"


@pytest.mark.parametrize("error", [UserError("seed is -1"), ToldAlreadyError("told")])
def test_what_a_process_refuses_is_refused_here(error):
    with Children(1) as children, pytest.raises(type(error), match=str(error)):
        children.run("refusing", f"{HERE}:refuse", error)


def test_an_error_that_nobody_meant_is_shown_where_it_happened(capfd):
    with Children(1) as children, pytest.raises(RuntimeError, match="failing ended"):
        children.run("failing", f"{HERE}:refuse", ZeroDivisionError("1/0"))
    assert "failing | ZeroDivisionError: 1/0" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("signum", "error"), [(signal.SIGTERM, Interrupted), (signal.SIGINT, Interrupted), (signal.SIGKILL, UserError)]
)
def test_how_a_process_was_ended_is_passed_on(signum, error):
    with Children(1) as children, pytest.raises(error) as told:
        children.run("ending", f"{HERE}:stop_here", signum)
    assert getattr(told.value, "signum", signal.SIGKILL) == signum


def test_what_stops_the_caller_stops_the_process_too(tmp_path):
    started, children = time.monotonic(), Children(1)
    future = children.submit(children.run, "sleeping", f"{HERE}:sleep", tmp_path / "pid")
    _wait_for(tmp_path / "pid")
    children.__exit__(Interrupted, Interrupted(signal.SIGTERM), None)
    assert isinstance(future.exception(), Interrupted)
    assert time.monotonic() - started < 50


def test_a_process_ends_with_a_caller_that_was_killed(tmp_path):
    """Else it would go on writing into a run that a second `dds run` has taken over."""
    program = f"from dds_lightning.pipeline.child import Child; Child('x', '{HERE}:sleep', {str(tmp_path / 'pid')!r})"
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    with subprocess.Popen(
        [sys.executable, "-c", f"{program}.result()"], env={**os.environ, "PYTHONPATH": path}
    ) as caller:
        _wait_for(tmp_path / "pid")
        pid = int((tmp_path / "pid").read_text())
        os.kill(pid, 0)
        caller.kill()
    for _ in range(200):
        state = Path(f"/proc/{pid}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the process goes on without its caller")


def _wait_for(path):
    for _ in range(1200):
        if path.exists() and path.read_text():
            return
        time.sleep(0.05)
    pytest.fail(f"{path} did not appear")
