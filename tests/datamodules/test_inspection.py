from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.inspection import BLOCK, check_dataset, count_repeats, describe, dimension_table, episode_table, visits
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.cli import main
from dds_lightning.tasks import get_task

Make = Callable[..., dict[str, Any]]
LARGE = "pointmaze-large-diverse"


def test_facts_are_counted_by_hand(make_episode: Make) -> None:
    data = Trajectories.from_episodes("made", [make_episode(n, e, terminated=e == 1) for e, n in enumerate((5, 3, 6))])
    facts, dimensions = describe(data, horizon=3)
    expected = {
        "data set": "made",
        "episodes": 3,
        "steps": 14,
        "shortest episode": 3,
        "median episode": 5,
        "longest episode": 6,
        "terminated episodes": 1,
        "truncated episodes": 2,
        "lowest return": 3,
        "mean return": 9.333,
        "highest return": 15,
        "segments of 3 steps": 8,
        "fingerprint": data.fingerprint(),
    }
    assert {key: facts[key] for key in expected} == expected
    assert dimensions["dimension"].tolist() == ["observation 0", "observation 1", "action 0"]
    assert dimensions["highest"].tolist() == pytest.approx([2, 6, 0.05])
    table = episode_table(data)
    assert table["steps"].tolist() == [5, 3, 6]
    assert table["terminated"].tolist() == [False, True, False]


def test_checking_a_maze_counts_cells_and_goals(minari_set: Callable[..., Path]) -> None:
    facts = check_dataset(f"local:{minari_set()}", LARGE, horizon=10)
    assert facts["segments of 10 steps"] == 2 * 3
    assert facts["episodes that reach the goal"] == 0
    assert facts["free cells visited"].endswith(f"of {len(get_task(LARGE).free_cells())}")


def test_checking_refuses_what_loading_refuses(minari_set: Callable[..., Path]) -> None:
    def spoil(file: Any) -> None:
        file["episode_0/rewards"][3] = np.inf

    folder = minari_set(spoil=spoil)
    with pytest.raises(DataError, match="'set-v0', episode_0, rewards: got inf at step 3"):
        check_dataset(f"local:{folder}", LARGE)
    with pytest.raises(DataError, match="'set-v0', episode_0, rewards: got inf at step 3"):
        check_dataset(f"local:{folder}")


def test_a_horizon_longer_than_every_episode_fails_the_check(minari_set: Callable[..., Path]) -> None:
    with pytest.raises(DataError, match="horizon 13 is longer than every one of the 2 episodes"):
        check_dataset(f"local:{minari_set()}", LARGE, horizon=13)


def test_dimensions_have_the_names_of_the_task_and_the_moments_of_numpy() -> None:
    rng = np.random.default_rng(0)
    task = get_task("hopper-medium")
    observations = rng.normal(1000.0, 0.01, (BLOCK + 3, 11)).astype(np.float32)  # hard: far from zero, narrow
    data = one_episode(observations, rng.uniform(-1, 1, (BLOCK + 2, 3)).astype(np.float32))
    table = dimension_table(data, task)
    assert table["name"].tolist()[:3] == ["z (m)", "pitch (rad)", "thigh (rad)"]
    assert table["name"].tolist()[-3:] == ["thigh", "leg", "foot"]
    exact = observations.astype(np.float64)
    for name, expected in (("lowest", exact.min(0)), ("mean", exact.mean(0)), ("std", exact.std(0))):
        np.testing.assert_allclose(table[name][:11], expected, rtol=1e-6)
    np.testing.assert_allclose(table["highest"][11:], data.actions.max(0))
    assert set(dimension_table(data, get_task("walker2d-medium"))["name"]) == {""}  # other widths, no names


@pytest.mark.parametrize("name", ["pointmaze-large-diverse", "antmaze-large-play", "antmaze-large-play@robotics"])
@pytest.mark.parametrize("resolution", [1, 4])
def test_visits_are_counted_where_the_task_puts_them(name: str, resolution: int) -> None:
    task = get_task(name)
    rows, columns = len(task.maze_map or ()), len((task.maze_map or ("",))[0])
    cells = np.random.default_rng(0).uniform((-1.0, -1.0), (rows, columns), (500, 2))  # some lie outside
    observations = np.zeros((500, task.observation_dim), np.float32)
    observations[:, :2] = task.cell_to_xy(cells)
    counts = visits(one_episode(observations, np.zeros((499, task.action_dim), np.float32)), task, resolution)
    expected = np.zeros((rows * resolution, columns * resolution), int)
    for i, j in np.floor((cells + 0.5) * resolution).astype(int):
        if 0 <= i < len(expected) and 0 <= j < len(expected[0]):
            expected[i, j] += 1
    assert expected.sum() < 500
    np.testing.assert_array_equal(counts, expected)


def one_episode(observations: np.ndarray, actions: np.ndarray) -> Trajectories:
    end = np.arange(len(actions)) == len(actions) - 1
    width = np.ones(actions.shape[1], np.float32)
    return Trajectories(
        name="made",
        observations=observations,
        actions=actions,
        rewards=np.zeros(len(actions), np.float32),
        terminations=end & False,
        truncations=end,
        lengths=np.array([len(actions)]),
        action_low=-width,
        action_high=width,
    )


def test_identical_episodes_are_counted_and_said(make_episode: Make, tmp_path: Path, capsys: Any) -> None:
    one, other = make_episode(5, 0), make_episode(5, 1)
    assert count_repeats(Trajectories.from_episodes("made", [one, other])) == 0
    data = Trajectories.from_episodes("made", [one, other, one, one])
    assert count_repeats(data) == describe(data)[0]["repeated episodes"] == 2
    nearly = {**one, "actions": np.nextafter(np.asarray(one["actions"], np.float32), np.float32(0))}
    assert count_repeats(Trajectories.from_episodes("made", [one, nearly])) == 1 - int(np.any(one["actions"]))
    data.save(tmp_path / "data")
    assert main(["data", "check", f"arrays:{tmp_path / 'data'}"]) == 0
    assert "2 of the 4 episodes repeat an earlier one to the bit" in " ".join(capsys.readouterr().out.split())


def test_what_is_allowed_and_seldom_meant_is_said(make_episode: Make, tmp_path: Path, capsys: Any) -> None:
    episodes = [make_episode(5, number) for number in range(2)]
    for episode in episodes:
        episode |= {"observations": np.insert(episode["observations"], 1, 7.0, axis=1), "rewards": np.zeros(5)}
    data = Trajectories.from_episodes("made", episodes)
    facts = describe(data)[0]
    assert (facts["constant observation columns"], facts["every reward"]) == ("1", 0.0)
    data.save(tmp_path / "data")
    assert main(["data", "check", f"arrays:{tmp_path / 'data'}"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "observation columns that never change: 1; fine for a goal" in said
    assert "every step pays 0.0: a critic learns nothing from that" in said
    plain = describe(Trajectories.from_episodes("made", [make_episode(5, 0)]))[0]
    assert not {"every reward", "steps left out"} & set(plain)


def test_steps_that_a_file_does_not_say_the_end_of_are_counted(tmp_path: Path) -> None:
    import h5py

    rows, ends = np.linspace(0.0, 1.0, 20), np.arange(20) % 10 == 9
    arrays = {"observations": rows[:, None], "actions": rows[:, None] / 2, "rewards": rows, "terminals": rows < 0}
    with h5py.File(tmp_path / "cut.hdf5", "w") as file:
        for name, values in {**arrays, "timeouts": ends}.items():
            file[name] = values
    assert check_dataset(f"d4rl:{tmp_path / 'cut.hdf5'}")["steps left out"] == 2
    with h5py.File(tmp_path / "cut.hdf5", "a") as file:
        file["next_observations"] = np.append(rows[1:], 1.1)[:, None]
    assert "steps left out" not in check_dataset(f"d4rl:{tmp_path / 'cut.hdf5'}")
