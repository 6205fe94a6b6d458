"""Ray and Slurm (submitit's local executor); they need their extras."""

import os
import signal
import time
from pathlib import Path

import pytest

from dds_lightning.errors import UserError
from dds_lightning.grid.engines import RayTasks, Slurm
from dds_lightning.grid.loop import Progress, run_nodes
from dds_lightning.grid.nodes import in_order
from tests.grid.toy import counted, toy_node

REPOSITORY = str(Path(__file__).parents[2])


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    """Let the processes of an engine find the packages and the toy work, as an installed package is found."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([REPOSITORY, os.environ.get("PYTHONPATH", "")]))


def run(engine, nodes, root):
    try:
        return run_nodes(nodes, str(root), engine, Progress(len(nodes), 2), print)
    finally:
        engine.close()


def nodes_of(root, last):
    """Two cells that read the same data; the second is `last`'s."""
    data = toy_node(0, root / "count")
    return in_order([toy_node(1, root / "count", reads=[data]), toy_node(2, root / "count", reads=[data], **last)])


@pytest.mark.slow
def test_ray_replaces_a_worker_that_was_killed_and_the_job_goes_on(tmp_path):
    pytest.importorskip("ray")
    failed = run(RayTasks(2), nodes_of(tmp_path, {"seconds": 0.3, "dies": True}), tmp_path)
    assert not failed
    assert sorted(counted(tmp_path / "count")) == [0, 1, 2]
    assert "2 3" in (tmp_path / "count").read_text(), "it went on after the three tenths that it had counted"


@pytest.mark.slow
def test_an_error_on_ray_is_told_and_not_tried_again(tmp_path):
    pytest.importorskip("ray")
    failed = run(RayTasks(2), nodes_of(tmp_path, {"fails": True}), tmp_path)
    assert list(failed.values()) == ["ValueError: cell 2 cannot work"]
    assert sorted(counted(tmp_path / "count")) == [0, 1]


@pytest.mark.slow
def test_a_preempted_job_of_slurm_is_queued_again_and_goes_on(tmp_path):
    pytest.importorskip("submitit")
    engine = Slurm(tmp_path / "slurm", 2, cluster="local")
    node = toy_node(3, tmp_path / "count", seconds=4.0)
    future = engine.submit(node.job(str(tmp_path)))
    state, until = tmp_path / "nodes" / node.key / "state.txt", time.monotonic() + 120
    while not state.exists() and time.monotonic() < until:
        time.sleep(0.05)
    for process in Path("/proc").glob("[0-9]*/cmdline"):  # submitit's own helper signals the wrong process
        words = process.read_bytes() if process.exists() else b""
        if b"submitit.core._submit" in words and str(tmp_path).encode() in words:
            os.kill(int(process.parent.name), signal.SIGUSR2)
    assert future.result(240)["error"] is None
    engine.close()
    index, begun = (tmp_path / "count").read_text().split()
    assert index == "3"
    assert int(begun) > 0, "it went on after what it had counted"


@pytest.mark.slow
def test_an_error_on_slurm_is_told(tmp_path):
    pytest.importorskip("submitit")
    failed = run(Slurm(tmp_path / "slurm", 2, cluster="local"), nodes_of(tmp_path, {"fails": True}), tmp_path)
    assert list(failed.values()) == ["ValueError: cell 2 cannot work"]


@pytest.mark.parametrize(("engine", "package", "extra"), [(RayTasks, "ray", "ray"), (Slurm, "submitit", "slurm")])
def test_without_the_extra_one_sentence_says_what_to_install(engine, package, extra, monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(UserError, match=rf"--engine={extra} needs .*: run `pip install -e '\.\[{extra}\]'"):
        engine(*([tmp_path, 1] if engine is Slurm else [1]))


def test_where_there_is_no_slurm_it_is_told_in_a_sentence(tmp_path):
    pytest.importorskip("submitit")
    with pytest.raises(UserError, match="--engine is slurm, and submitit finds no Slurm here"):
        Slurm(tmp_path, 1)
