from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.inspection import check_dataset, describe, episode_table, find_datasets
from datamodules.trajectories import DataError, Trajectories
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
    with pytest.raises(DataError, match="'set-v0', episode_0, rewards: found inf at step 3"):
        check_dataset(f"local:{folder}", LARGE)
    with pytest.raises(DataError, match="'set-v0', episode_0, rewards: found inf at step 3"):
        check_dataset(f"local:{folder}")


def test_a_horizon_longer_than_every_episode_fails_the_check(minari_set: Callable[..., Path]) -> None:
    with pytest.raises(DataError, match="horizon 13 is longer than every one of the 2 episodes"):
        check_dataset(f"local:{minari_set()}", LARGE, horizon=13)


def test_sets_are_found_with_their_problems(
    minari_set: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = minari_set()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "nothing"))
    for name, text in (("broken-v0", "{"), (".half-written", "{")):
        (tmp_path / name / "data").mkdir(parents=True)
        (tmp_path / name / "data" / "metadata.json").write_text(text)
    found = find_datasets([tmp_path]).set_index("data set")
    assert sorted(found.index) == ["broken-v0", "set-v0"]
    assert found.loc["set-v0", "environment"] == "PointMaze_Large-v3"
    assert found.loc["set-v0", "steps"] == 24
    assert found.loc["set-v0", "data"] == f"local:{folder}"
    assert found.loc["set-v0", "problem"] == ""
    assert "damaged" in found.loc["broken-v0", "problem"]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert len(find_datasets([tmp_path])) == 2  # each once
    assert find_datasets([tmp_path / "nothing"]).shape == (2, 6)
