"""Rollouts: nobody is over-counted, seeds are paired, workers change nothing, and failures speak."""

import contextlib
import os
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from dds_lightning.envs.pool import EnvPool, EnvPoolError
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Acted, Contestant, RandomActor
from dds_lightning.rollout.play import rollout
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.rollout.schedule import episode_seed, slots_needed
from dds_lightning.tasks import get_task

UMAZE = replace(get_task("pointmaze-umaze-diverse"), max_episode_steps=30)


class CountEnv:
    """One step a unit of x; an episode ends after `1 + seed % 5` steps, or at once when the action is above 1."""

    def reset(self, seed=None):
        self.length, self.x = 1 + seed % 5, 0.0
        return np.array([seed % 97, 0.0], np.float32), {"position": np.zeros(2)}

    def step(self, action):
        self.x += 1.0
        done = self.x >= self.length or action[0] > 1.0
        info = {"position": np.array([self.x, -self.x]), "success": bool(action[0] > 1.0)}
        return np.array([0.0, self.x], np.float32), float(action[0]), done, False, info

    def close(self):
        pass


TOY = SimpleNamespace(
    name="toy",
    observation_dim=2,
    action_dim=1,
    max_episode_steps=6,
    measures_success=True,
    make_env=CountEnv,
    normalised_score=lambda returns: 100.0 * returns,
)


class Constant:
    """Always the same action; notes what it is told."""

    def __init__(self, action):
        self.action, self.calls = action, []

    def reset(self, num_envs, seed=None):
        self.num_envs, self.seed = num_envs, seed

    def act(self, observations, restarted, rows):
        self.calls.append((observations.copy(), restarted.copy(), rows.copy()))
        return np.full((len(rows), 1), self.action, np.float32)


class Coder(Constant):
    """An actor with skills: its code is its row."""

    def act(self, observations, restarted, rows):
        return Acted(super().act(observations, restarted, rows), codes=rows, chosen=restarted)


@pytest.mark.parametrize("slots", [1, 2, 7, 64])
def test_every_episode_is_played_once_whatever_the_slots(slots):
    result = rollout(
        TOY, [Contestant("a", Constant(0.5), 11), Contestant("b", Constant(2.0), 6)], workers=0, slots=slots
    )
    table = result.episodes
    assert list(table["actor"]) == ["a"] * 11 + ["b"] * 6
    assert list(table["episode"]) == [*range(11), *range(6)]
    lengths = [1 + episode_seed(0, i) % 5 for i in range(11)]
    assert list(table["length"][:11]) == lengths  # short episodes are not over-counted
    np.testing.assert_allclose(table["return"][:11], 0.5 * np.array(lengths))
    np.testing.assert_allclose(table["score"][:11], 50.0 * np.array(lengths))
    assert list(table["length"][11:]) == [1] * 6
    assert table["success"].tolist() == [False] * 11 + [True] * 6
    assert table["final_x"].tolist() == table["length"].tolist()
    assert set(table["final_code"]) == {-1}


def test_episodes_of_different_contestants_start_from_the_same_seed():
    table = rollout(TOY, [Contestant(n, Constant(0.5), 5) for n in "ab"], seed=3, workers=0).episodes
    assert table["seed"][:5].tolist() == table["seed"][5:].tolist()
    assert table["seed"].nunique() == 5
    assert episode_seed(0, 1) != episode_seed(1, 0)


def test_finished_rows_leave_the_batch_and_restarts_are_told():
    actor = Constant(0.5)
    rollout(TOY, [Contestant("a", actor, 6)], workers=0, slots=3)
    assert actor.num_envs == 3
    assert actor.calls[0][1].tolist() == [True, True, True]
    total = sum(1 + episode_seed(0, i) % 5 for i in range(6))
    assert sum(len(rows) for _, _, rows in actor.calls) == total  # nothing is acted upon in vain
    assert sum(restarted.sum() for _, restarted, _ in actor.calls) == 6
    for observations, restarted, _ in actor.calls:
        assert (observations[restarted, 1] == 0.0).all()  # the next episode's first state, not the last's end
        assert (observations[~restarted, 1] > 0.0).all()


def test_each_label_keeps_its_rows_and_its_seeds():
    labels = [f"skill {k}" for k in range(3)] * 4
    table = rollout(TOY, [Contestant("s", Coder(0.5), 12, labels)], workers=0, slots=6, record=True).episodes
    assert [int(label[-1]) for label in table["label"]] == [code % 3 for code in table["final_code"]]
    assert sorted(table["final_code"].unique()) == [0, 1, 2, 3, 4, 5]
    for _, part in table.groupby("label"):
        assert part["seed"].tolist() == [episode_seed(0, i) for i in range(4)]
    assert all(codes == [code] for codes, code in zip(table["codes"], table["final_code"], strict=True))


def test_paths_hold_every_position_and_code():
    result = rollout(
        TOY,
        [Contestant("c", Coder(0.5), 5)],
        workers=0,
        slots=2,
        record=True,
        record_observations=True,
    )
    for row in result.episodes.itertuples():
        path = result.paths["c", row.episode]
        steps = np.arange(row.length + 1, dtype=np.float32)
        np.testing.assert_array_equal(path.positions, np.stack([steps, -steps], axis=1))
        np.testing.assert_array_equal(path["codes"], np.full(row.length, row.final_code))
        np.testing.assert_array_equal(path.observations[1:, 1], steps[1:])
        assert path.observations[0].tolist() == [row.seed % 97, 0.0]


def test_results_survive_the_disk(tmp_path):
    result = rollout(TOY, [Contestant("c", Coder(0.5), 5)], workers=0, slots=2, record=True)
    result.save(tmp_path / "r")
    again = RolloutResult.load(tmp_path / "r")
    pd.testing.assert_frame_equal(again.episodes, result.episodes, check_dtype=False)
    assert again.task == "toy"
    assert again.paths.keys() == result.paths.keys()
    for key, path in result.paths.items():
        np.testing.assert_array_equal(again.paths[key].positions, path.positions)
        np.testing.assert_array_equal(again.paths[key].codes, path.codes)
    assert {entry.name for entry in (tmp_path / "r").iterdir()} == {"episodes.parquet", "paths.npz"}
    with pytest.raises(UserError, match=r"nowhere.*does not exist"):
        RolloutResult.load(tmp_path / "nowhere")


def test_summary_counts_by_hand():
    table = pd.DataFrame(
        {
            "actor": ["b", "b", "a"],
            "label": ["x", "y", "a"],
            "success": [True, False, True],
            "score": [100.0, 0.0, 50.0],
            "return": [1.0, 0.0, 0.5],
            "length": [10, 30, 20],
        }
    )
    summary = RolloutResult("toy", table).summary()
    assert summary["actor"].tolist() == ["b", "a"]
    assert summary["success"].tolist() == [50.0, 100.0]
    assert summary["score"].tolist() == [50.0, 50.0]
    assert summary["score_error"][0] == pytest.approx(50.0)
    assert summary["length_success"].tolist() == [10.0, 20.0]
    assert RolloutResult("toy", table).summary("label")["label"].tolist() == ["x", "y", "a"]


RUNNER = SimpleNamespace(**{**vars(TOY), "name": "hopper-medium", "measures_success": False})


def test_a_task_that_measures_no_success_has_none_on_disk_and_in_its_summary(tmp_path):
    result = rollout(RUNNER, [Contestant("c", Constant(2.0), 5)], workers=0)
    assert str(result.episodes["success"].dtype) == "boolean"
    result.save(tmp_path)
    again = RolloutResult.load(tmp_path)
    assert again.episodes["success"].isna().all()
    for table in (result, again):
        row = table.summary().iloc[0]
        assert np.isnan([row["success"], row["length_success"]]).all()
        assert (row["score"], row["score_error"], row["return"], row["length"]) == (200.0, 0.0, 2.0, 1.0)


def test_a_table_of_plain_bools_is_read_as_ever(tmp_path):
    """What earlier versions wrote."""
    result = rollout(TOY, [Contestant("c", Constant(2.0), 2)], workers=0)
    assert result.episodes["success"].dtype == bool
    result.save(tmp_path)
    assert RolloutResult.load(tmp_path).summary()["success"].tolist() == [100.0]


def _maze_table(workers, slots=30):
    contestants = [Contestant("random", RandomActor(2), 23), Contestant("other", RandomActor(2), 9)]
    return rollout(UMAZE, contestants, seed=1, workers=workers, slots=slots).episodes


def test_workers_do_not_change_the_table():
    alone = _maze_table(0)
    assert len(alone) == 32
    for workers in (1, 2):
        pd.testing.assert_frame_equal(_maze_table(workers), alone)
    pd.testing.assert_frame_equal(_maze_table(0), alone)


def test_a_pool_builds_the_same_physics_as_the_task(tmp_path):
    env = UMAZE.make_env()
    seen, info = env.reset(seed=5)
    with EnvPool(UMAZE, 1, workers=0) as pool:
        start = pool.start([[5]])
        np.testing.assert_array_equal(start["observation"][0], seen)
        np.testing.assert_array_equal(start["position"][0], info["position"])
        rng = np.random.default_rng(0)
        for _ in range(25):
            action = rng.uniform(-1, 1, 2).astype(np.float32)
            seen, reward, _, _, info = env.step(action)
            record = pool.step(action[None])[0]
            np.testing.assert_array_equal(record["observation"], seen)
            assert record["reward"] == reward
    env.close()


def test_a_pool_is_reused_and_a_rollout_in_progress_is_abandoned():
    with EnvPool(UMAZE, 4, workers=2) as pool:
        pool.start([[1, 2], [3], [], [4]])
        assert pool.alive.tolist() == [0, 1, 3]
        pool.step(np.zeros((3, 2), np.float32))
        first = rollout(UMAZE, [Contestant("r", RandomActor(2), 6)], pool=pool, slots=3).episodes
        again = rollout(UMAZE, [Contestant("r", RandomActor(2), 6)], pool=pool, slots=3).episodes
    pd.testing.assert_frame_equal(first, again)
    pd.testing.assert_frame_equal(
        first, rollout(UMAZE, [Contestant("r", RandomActor(2), 6)], workers=0, slots=3).episodes
    )
    with pytest.raises(EnvPoolError, match="closed"):
        pool.start([[1]])


@pytest.mark.parametrize(
    ("contestants", "message"),
    [
        ([], "contestants is empty"),
        ([Contestant("a", Constant(0), 0)], "'a': episodes is 0"),
        ([Contestant("a", Constant(0), 2, ["x"])], "1 labels for 2"),
        ([Contestant("a", Constant(0), 1), Contestant("a", Constant(0), 1)], "'a' appears 2 times"),
        ([Contestant("a", Constant(np.nan), 1)], "'a' gave an action that is not finite"),
        ([Contestant("a", RandomActor(3), 1)], r"shape \(1, 3\), expected \(1, 1\)"),
    ],
)
def test_bad_contestants_are_refused_by_name(contestants, message):
    with pytest.raises(UserError, match=message):
        rollout(TOY, contestants, workers=0)


def test_a_pool_that_is_too_small_is_used_in_turns_or_refused():
    players = [Contestant("a", Constant(0.5), 6), Contestant("b", Constant(0.5), 6, ["x", "y"] * 3)]
    assert slots_needed(players, 8) == 7
    assert slots_needed(players, 1) == 3
    with EnvPool(TOY, 4, workers=0) as pool:
        assert len(rollout(TOY, players, pool=pool, slots=8).episodes) == 12
    with EnvPool(TOY, 2, workers=0) as pool, pytest.raises(UserError, match=r"has 2 environments.*need at least 3"):
        rollout(TOY, players, pool=pool)


def test_one_actor_cannot_play_twice():
    actor = Constant(0.0)
    with pytest.raises(UserError, match="share one actor"):
        rollout(TOY, [Contestant("a", actor, 1), Contestant("b", actor, 1)], workers=0)


BROKEN = """
import os, numpy as np
class Env:
    def reset(self, seed=None):
        print("noise on standard output")
        return np.zeros(1, np.float32), {}
    def step(self, action):
        if action[0] > 1: os._exit(7)
        raise ArithmeticError("the wheel came off")
    def close(self): pass
class Task:
    name, observation_dim, action_dim, max_episode_steps = "broken", 1, 1, 5
    def make_env(self): return Env()
"""


@pytest.fixture
def broken(tmp_path, monkeypatch):
    (tmp_path / "broken_task.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(tmp_path)
    import broken_task

    yield broken_task.Task()
    del sys.modules["broken_task"]


def test_a_worker_that_raises_tells_its_caller_why(broken):
    with EnvPool(broken, 3, workers=2) as pool:
        pool.start([[0], [1], [2]])
        with pytest.raises(EnvPoolError, match=r"(?s)worker 0 of 2 \(broken\) failed.*wheel came off"):
            pool.step(np.zeros((3, 1), np.float32))
        assert pool.closed


def test_a_worker_that_dies_is_noticed(broken):
    with EnvPool(broken, 1, workers=1) as pool:
        pool.start([[0]])
        with pytest.raises(EnvPoolError, match="exit status 7"):
            pool.step(np.full((1, 1), 2.0, np.float32))


def test_a_worker_that_the_machine_kills_is_one_sentence_about_memory(broken):
    with EnvPool(broken, 1, workers=1) as pool:
        pool.start([[0]])
        pool._parts[0].process.kill()
        with pytest.raises(UserError, match=r"worker 0 of 1 \(broken\) was killed.*memory.*--workers"):
            pool.step(np.zeros((1, 1), np.float32))


def _children_gone(pids):
    for _ in range(100):
        alive = []
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, 0)
                alive.append(pid)
        if not alive:
            return True
        time.sleep(0.1)
    return False


SCRIPT = """
import os, signal, sys
from dds_lightning.envs.pool import EnvPool
from dds_lightning.tasks import get_task
pool = EnvPool(get_task("pointmaze-umaze-diverse"), 3, workers=2)
print(*[part.process.pid for part in pool._parts], "torch" in sys.modules, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals as on Unix")
def test_workers_end_when_their_caller_is_killed_and_an_unguarded_script_works(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": path}
    )
    *pids, torch_there = done.stdout.split()
    assert len(pids) == 2, done.stderr
    assert torch_there == "False"
    assert _children_gone([int(pid) for pid in pids])


def test_closing_twice_and_bad_sizes():
    pool = EnvPool(UMAZE, 1, workers=1)
    pool.close()
    pool.close()
    with pytest.raises(UserError, match="slots is 0"):
        EnvPool(UMAZE, 0)
    with pytest.raises(UserError, match="workers is -1"):
        EnvPool(UMAZE, 1, workers=-1)


def test_an_interrupt_while_acting_ends_the_workers(monkeypatch):
    pids = []

    class Interrupted(RandomActor):
        def act(self, observations, restarted, rows):
            raise KeyboardInterrupt

    from dds_lightning.rollout import play as module

    class Pool(module.EnvPool):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            pids.extend(part.process.pid for part in self._parts)

    monkeypatch.setattr(module, "EnvPool", Pool)
    with pytest.raises(KeyboardInterrupt):
        rollout(UMAZE, [Contestant("i", Interrupted(2), 8)], workers=2)
    assert len(pids) == 2
    assert _children_gone(pids)


def test_progress_tells_the_score_where_success_is_not_measured(monkeypatch, capsys):
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda self: True))
    rollout(RUNNER, [Contestant("a", Constant(0.5), 1), Contestant("b", Constant(1.5), 1)], workers=0)
    said = capsys.readouterr().err
    assert "score " in said
    assert "success" not in said


@pytest.mark.parametrize(("terminal", "wanted"), [(True, True), (True, False), (False, True)])
def test_progress_shows_on_a_terminal_only_and_never_on_standard_output(monkeypatch, capsys, terminal, wanted):
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda self: terminal))
    rollout(TOY, [Contestant("a", Constant(2.0), 4)], workers=0, progress=wanted)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert ("success 100 %" in captured.err) == (terminal and wanted)


def test_torch_threads_are_put_back():
    import torch

    class Counter(Constant):
        def act(self, observations, restarted, rows):
            seen.append(torch.get_num_threads())
            return super().act(observations, restarted, rows)

    seen, before = [], torch.get_num_threads()
    rollout(TOY, [Contestant("a", Counter(2.0), 1)], workers=0, threads=2)
    assert seen == [2]
    assert torch.get_num_threads() == before
