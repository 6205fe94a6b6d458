"""Jobs on processes of this machine: order, sharing, failures, kills."""

import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from pathlib import Path

import pytest

from dds_lightning.grid.engines import Local
from dds_lightning.grid.job import NODES, do
from dds_lightning.grid.loop import Progress, run_nodes
from dds_lightning.grid.nodes import in_order, needed
from dds_lightning.saving.run_directory import finished
from tests.grid.toy import counted, toy_node


class Here:
    """An engine in this process, one job after the other."""

    slots = 2

    def __init__(self):
        self.order = []

    def submit(self, job):
        self.order.append(job["title"])
        future = Future()
        future.set_result(do(job))
        return future


def chain(count):
    """data -> two skills -> an evaluation each."""
    data = toy_node(0, count, kind="data")
    skills = [toy_node(index, count, reads=[data], kind="skill") for index in (1, 2)]
    return in_order(toy_node(10 + i, count, reads=[skill]) for i, skill in enumerate(skills))


def run(nodes, root, engine=None):
    done = {key for key in nodes if finished(root / NODES / key)}
    todo, lines = needed(nodes, done), []
    failed = run_nodes(todo, str(root), engine or Here(), Progress(len(todo), 2), lines.append)
    return failed, lines


def test_what_is_read_comes_first_and_nothing_is_done_twice(tmp_path):
    nodes, engine = chain(tmp_path / "count"), Here()
    failed, lines = run(nodes, tmp_path, engine)
    assert not failed
    assert engine.order.index("data 0") < engine.order.index("skill 1") < engine.order.index("toy 10")
    assert sorted(counted(tmp_path / "count")) == [0, 1, 2, 10, 11]
    assert lines[-1].startswith("[5/5]")
    again = Here()
    assert run(nodes, tmp_path, again) == ({}, [])
    assert again.order == []


def test_the_key_of_a_node_is_that_of_all_that_it_depends_on(tmp_path):
    first, second = (toy_node(1, tmp_path, reads=[toy_node(seed, tmp_path)]) for seed in (5, 6))
    assert first.key != second.key
    assert first.key == toy_node(1, "another place", reads=[toy_node(5, "elsewhere")]).key


def test_a_failure_is_told_with_its_reason_and_keeps_back_only_what_reads_it(tmp_path):
    data = toy_node(0, tmp_path / "count")
    bad, good = (toy_node(index, tmp_path / "count", reads=[data], fails=index == 1) for index in (1, 2))
    nodes = in_order([toy_node(3, tmp_path / "count", reads=[bad]), toy_node(4, tmp_path / "count", reads=[good])])
    failed, lines = run(nodes, tmp_path)
    reasons = {nodes[key].title: why for key, why in failed.items()}
    assert reasons == {
        "toy 1": "ValueError: cell 1 cannot work",
        "toy 3": "not done because 'toy 1' failed",
    }
    assert sorted(counted(tmp_path / "count")) == [0, 2, 4]
    assert any("toy 1: failed: ValueError: cell 1 cannot work" in line for line in lines)


def test_what_a_job_prints_is_in_its_own_log(tmp_path):
    nodes = {node.key: node for node in (toy_node(index, tmp_path / "count", fails=True) for index in (1, 2))}
    engine = Local(1)
    try:
        run(nodes, tmp_path, engine)
    finally:
        engine.close()
    for key, node in nodes.items():
        text = (tmp_path / "logs" / f"{key}.txt").read_text()
        assert f"ValueError: cell {node.settings['index']} cannot work" in text
        assert text.count("ValueError: cell") == 1


def test_what_only_finished_work_reads_is_not_needed_again(tmp_path):
    nodes = chain(tmp_path / "count")
    by_title = {node.title: key for key, node in nodes.items()}
    done = {by_title["toy 10"], by_title["skill 2"]}
    assert {nodes[key].title for key in needed(nodes, done)} == {"toy 11"}


def test_the_time_that_is_left_follows_from_jobs_of_the_same_kind(tmp_path):
    nodes = {index: toy_node(index, tmp_path) for index in range(6)}
    progress = Progress(6, 2)
    assert progress.left(nodes) is None
    progress.past["toy"] += [10.0, 20.0]
    assert progress.left(nodes) == 6 * 15 / 2


def test_a_job_whose_process_dies_goes_on_in_another(tmp_path):
    engine = Local(1)
    try:
        node = toy_node(7, tmp_path / "count", seconds=0.2, dies=True)
        failed, _ = run({node.key: node}, tmp_path, engine)
    finally:
        engine.close()
    assert not failed
    assert (tmp_path / "count").read_text() == "7 2\n"  # it went on after the two tenths that it had counted


SCRIPT = """
import sys
from pathlib import Path
from tests.grid.test_loop import Local, NODES, finished, needed, run_nodes, Progress, toy_node
root, cells = Path(sys.argv[1]), int(sys.argv[2])
nodes = {node.key: node for node in (toy_node(i, root / "count", seconds=0.3) for i in range(cells))}
done = {key for key in nodes if finished(root / NODES / key)}
engine = Local(2)
run_nodes(needed(nodes, done), str(root), engine, Progress(cells, 2), print)
engine.close()
"""


@pytest.mark.slow
def test_killed_at_random_ten_times_no_finished_cell_is_lost_and_none_repeated(tmp_path):
    cells, random_times = 20, random.Random(0)
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    words, environment = [sys.executable, "-c", SCRIPT, str(tmp_path), str(cells)], {**os.environ, "PYTHONPATH": path}
    sealed: dict[int, int] = {}  # cell -> how often it had been done when it was found finished
    for _ in range(10):
        driver = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        before, until = len(counted(tmp_path / "count")), time.monotonic() + 120
        # It starts slowly on a busy machine: wait until something was done, then for a random time.
        while len(counted(tmp_path / "count")) == before and driver.poll() is None and time.monotonic() < until:
            time.sleep(0.02)
        time.sleep(random_times.uniform(0.0, 0.3))
        driver.send_signal(signal.SIGKILL)
        driver.wait()
        found = [finished(path) for path in (tmp_path / NODES).iterdir()]
        done = {one.facts["index"] for one in found if one}
        assert sealed.keys() <= done, "a finished cell was lost"
        sealed = {index: sealed.get(index, counted(tmp_path / "count").count(index)) for index in done}
    subprocess.run(words, env=environment, check=True, stdout=subprocess.DEVNULL)
    times = counted(tmp_path / "count")
    assert set(times) == set(range(cells))
    # One that was killed between its last line and its marker is not finished, and is done again.
    assert {index: times.count(index) for index in sealed} == sealed, "a finished cell was repeated"
