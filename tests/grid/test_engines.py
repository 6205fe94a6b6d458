"""Ray and Slurm (submitit's local executor); they need their extras."""

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from dds_lightning.errors import UserError
from dds_lightning.grid.engines import RayTasks, Slurm, refuse_request
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
    logs = {path.name: path.read_text() for path in (tmp_path / "logs").iterdir()}
    assert "ValueError: cell 2 cannot work" in logs[f"{next(iter(failed))}.txt"]
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


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (("moon", 1, 1, 0, 240), "--engine is moon, expected one of local, ray, slurm"),
        (("local", 0, 1, 0, 240), "--workers is 0, expected at least 1"),
        (("ray", 1, 0, 0, 240), "--cpus is 0, expected a whole number of at least 1"),
        (("ray", 1, 1.5, 0, 240), r"--cpus is 1\.5, expected a whole number"),
        (("ray", 1, 1, -1, 240), "--gpus is -1, expected 0 or more"),
        (("ray", 1, 1, 1.5, 240), r"--gpus is 1\.5, expected a whole number, or with --engine ray less than 1"),
        (("slurm", 1, 1, 0.5, 240), r"--gpus is 0\.5, expected a whole number"),
        (("slurm", 1, 1, 0, 0), "--minutes is 0, expected at least 1"),
    ],
)
def test_what_no_engine_can_be_asked_for_is_refused(asked, message):
    with pytest.raises(UserError, match=message):
        refuse_request(*asked)


@pytest.fixture
def fake_ray(monkeypatch):
    """Ray with one node of 2 CPUs; what it was begun with stands in the list."""
    begun = []
    ray = SimpleNamespace(is_initialized=lambda: False, init=lambda **more: begun.append(more), shutdown=begun.clear)
    ray.nodes = lambda: [{"Alive": True, "Resources": {"CPU": 2.0}}]
    ray.remote = lambda **more: lambda work: (work, more)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return begun


def test_ray_counts_the_cpus_of_all_its_workers(fake_ray):
    RayTasks(3, cpus=2)
    assert fake_ray[0]["num_cpus"] == 6
    RayTasks(None)
    assert fake_ray[1]["num_cpus"] is None


def test_what_ray_can_never_give_is_refused_here_and_told_of_a_cluster(fake_ray, monkeypatch):
    with pytest.raises(UserError, match=r"--cpus is 1 and --gpus is 0\.5, which no node of Ray has .*: 2 and 0"):
        RayTasks(1, gpus=0.5)
    assert not fake_ray, "Ray is ended"
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    with pytest.warns(UserWarning, match="jobs wait until such a node joins the cluster"):
        RayTasks(1, cpus=4)
    assert "num_cpus" not in fake_ray[0]


def test_a_ray_that_does_not_start_is_told_in_a_sentence(fake_ray, monkeypatch):
    def fail(**more):
        raise ConnectionError("Could not find a node\nafter 30 s")

    monkeypatch.setattr(sys.modules["ray"], "init", fail)
    with pytest.raises(UserError, match=r"^--engine is ray, but it does not start here: Could not find a node$"):
        RayTasks(1)
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    with pytest.raises(UserError, match=r"RAY_ADDRESS=head:6379 does not answer: Could not find a node$"):
        RayTasks(1)


def test_where_there_is_no_slurm_it_is_told_in_a_sentence(tmp_path):
    pytest.importorskip("submitit")
    with pytest.raises(UserError, match="--engine is slurm, but submitit finds no Slurm here"):
        Slurm(tmp_path, 1)
