from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from dds_lightning.tasks import get_task


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
        facts: dict[str, Any] = {
            "dataset_id": "set-v0",
            "total_episodes": episodes,
            "total_steps": episodes * steps,
            "data_format": "hdf5",
            "observation_space": json.dumps({"type": "Dict", "subspaces": {}}),
            "action_space": json.dumps(box),
            "env_spec": json.dumps({"id": get_task(task).env_id, "entry_point": "gymnasium_robotics:PointMazeEnv"}),
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
