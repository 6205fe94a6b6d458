from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dds_lightning.tasks import get_task
from tests.minari_recordings import write_minari_set
from tests.refusals import MAZE, PAYLOAD, maze_episodes


@pytest.fixture
def make_episode() -> Callable[..., dict[str, Any]]:
    """An episode whose numbers tell where they come from: observation t is [number, t], action t is t / "
    "100."""

    def make(steps: int, number: int = 0, *, terminated: bool = False) -> dict[str, Any]:
        end = np.arange(steps) == steps - 1
        return {
            "observations": np.stack([np.full(steps + 1, number), np.arange(steps + 1)], axis=1).astype(float),
            "actions": (np.arange(steps, dtype=np.float32) / 100)[:, None],
            "rewards": np.arange(steps, dtype=np.float64),
            "terminations": end & terminated,
            "truncations": end & (not terminated),
        }

    return make


@pytest.fixture
def minari_set(tmp_path: Path) -> Callable[..., Path]:
    """Writes a small data set in Minari's layout and lets a test spoil it."""

    def write(
        *,
        task: str = "pointmaze-large-diverse",
        episodes: int = 2,
        steps: int = 12,
        metadata: dict[str, Any] | None = None,
        spoil: Callable[[h5py.File], None] | None = None,
    ) -> Path:
        folder = tmp_path / "set-v0"
        data = folder / "data"
        data.mkdir(parents=True)
        box = {"type": "Box", "dtype": "float32", "shape": [2], "low": [-1, -1], "high": [1, 1]}
        widths = {"achieved_goal": 2, "desired_goal": 2, "observation": 4}
        seen = {key: {"type": "Box", "dtype": "float64", "shape": [width]} for key, width in widths.items()}
        facts: dict[str, Any] = {
            "dataset_id": "set-v0",
            "total_episodes": episodes,
            "total_steps": episodes * steps,
            "data_format": "hdf5",
            "observation_space": json.dumps({"type": "Dict", "subspaces": seen}),
            "action_space": json.dumps(box),
            "env_spec": json.dumps(
                {"id": get_task(task).env_id, "entry_point": "gymnasium_robotics.envs.maze.point_maze:PointMazeEnv"}
            ),
        }
        facts.update(metadata or {})
        facts = {key: value for key, value in facts.items() if value is not None}
        (data / "metadata.json").write_text(json.dumps(facts))
        rng = np.random.default_rng(0)
        with h5py.File(data / "main_data.hdf5", "w") as file:
            for e in range(episodes):
                group = file.create_group(f"episode_{e}")
                group["observations/observation"] = rng.uniform(-0.3, 0.3, (steps + 1, 4))
                group["observations/desired_goal"] = np.zeros((steps + 1, 2))
                group["actions"] = rng.uniform(-1, 1, (steps, 2)).astype(np.float32)
                group["rewards"] = np.zeros(steps)
                group["terminations"] = np.zeros(steps, bool)
                group["truncations"] = np.arange(steps) == steps - 1
            if spoil is not None:
                spoil(file)
        return folder

    return write


@pytest.fixture
def sentinel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that exists as soon as the stranger's module is imported, which takes nothing but its name."""
    path = tmp_path / "the payload ran"
    module = tmp_path / "code" / f"{PAYLOAD.partition(':')[0]}.py"
    module.parent.mkdir()
    module.write_text(f"open({str(path)!r}, 'w').close()\nfrom gymnasium import Env\n")
    monkeypatch.syspath_prepend(module.parent)
    monkeypatch.delitem(sys.modules, module.stem, raising=False)
    return path


@pytest.fixture
def maze_set(tmp_path: Path) -> Path:
    return write_minari_set(tmp_path / "sets", "set-v0", get_task(MAZE), maze_episodes())
