"""What a refusal of hostile data must be: one sentence, nothing of theirs run, nothing written."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from datamodules import load_trajectories
from datamodules.trajectories import DataError
from dds_lightning.tasks import get_task
from tests.recordings import Episode, record

MAZE = "pointmaze-large-diverse"
PAYLOAD = "payload_of_a_stranger:Env"
STEPS = 20
PART = re.compile(
    r"(metadata|main_data)\.(json|hdf5)|episode_\d|(action|observation)[ _]space"
    r"|env_spec|data_format|dataset_id|recorded (in|with|for)"
)
"""What a reader is sent to: a file, an episode, or an entry of the metadata."""


@cache
def maze_episodes() -> list[Episode]:
    """Two episodes of `STEPS` steps in `MAZE`."""
    return record(get_task(MAZE), 2 * STEPS, episode_steps=STEPS)


def refuse(folder: Path, task: str, message: str, sentinel: Path) -> None:
    """Loading must fail with one sentence that names the data set and its part, and leave the world as it was."""
    before = _world(folder)
    with pytest.raises(DataError) as refused:
        load_trajectories(f"local:{folder}", task)
    sentence = str(refused.value)
    assert re.search(message, sentence), sentence
    assert folder.name in sentence
    assert PART.search(sentence), f"it names no file, episode or entry: {sentence}"
    assert len(sentence) < 1200
    assert sentence.isprintable()
    assert not re.search(r"[.!?] [A-Z]", sentence), "more than one sentence"
    assert not sentinel.exists()
    assert _world(folder) == before


def _world(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (*folder.rglob("*"), *Path.cwd().rglob("*"))}
