from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.trajectories import DataError
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

Write = Callable[..., Path]
LARGE = "pointmaze-large-diverse"


def _spec(**entries: Any) -> str:
    return json.dumps({"id": "PointMaze_Large-v3", "entry_point": "gymnasium_robotics:PointMazeEnv", **entries})


def test_a_sound_set_is_read(minari_set: Write) -> None:
    data = load_trajectories(f"local:{minari_set()}", LARGE)
    assert (data.name, data.num_episodes, data.num_steps, data.observation_dim) == ("set-v0", 2, 24, 4)


def test_without_a_task_the_widths_are_the_sets_own(minari_set: Write) -> None:
    data = load_trajectories(f"local:{minari_set(metadata={'env_spec': None})}")
    assert (data.observation_dim, data.action_dim) == (4, 2)


def test_by_id_from_minaris_folder(minari_set: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = minari_set()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder.parent))
    assert load_trajectories("minari:set-v0", LARGE).num_steps == 24
    with pytest.raises(DataError, match=r"data set 'other-v0' is not in .*dds data collect"):
        load_trajectories("minari:other-v0", LARGE)
    with pytest.raises(UserError, match="is no Minari id"):
        load_trajectories("minari:../set-v0", LARGE)


@pytest.mark.parametrize("spec", ["", "local", "local:", "http://somewhere", "nowhere:x"])
def test_an_unknown_source_lists_those_there_are(spec: str) -> None:
    with pytest.raises(UserError, match=r"data: found '.*', expected one of local:..., minari:..., arrays:..."):
        load_trajectories(spec, LARGE)


def test_a_set_of_another_task_is_refused_naming_both(minari_set: Write) -> None:
    folder = minari_set(task="pointmaze-medium-play")
    with pytest.raises(
        DataError,
        match=r"'set-v0' was recorded in PointMaze_Medium-v3, but task 'pointmaze-large-diverse' needs",
    ):
        load_trajectories(f"local:{folder}", LARGE)


def test_other_walls_under_the_right_name_are_refused(minari_set: Write) -> None:
    walls = [[1, 1, 1], [1, "c", 1], [1, 1, 1]]
    folder = minari_set(metadata={"env_spec": _spec(kwargs={"maze_map": walls})})
    with pytest.raises(DataError, match=r"other walls \(111/101/111\) than task 'pointmaze-large-diverse'"):
        load_trajectories(f"local:{folder}", LARGE)


def test_lettered_cells_of_the_same_walls_are_accepted(minari_set: Write) -> None:
    walls: list[list[Any]] = [[int(v) for v in row] for row in get_task(LARGE).maze_map or ()]
    walls[7][1], walls[1][10] = "r", "g"
    folder = minari_set(metadata={"env_spec": _spec(kwargs={"maze_map": walls})})
    assert load_trajectories(f"local:{folder}", LARGE).num_episodes == 2


HOSTILE = {
    "no observation space": ({"observation_space": None}, "has no observation_space; Minari would run"),
    "no action space": ({"action_space": None}, "has no action_space; Minari would run"),
    "damaged space": ({"action_space": "{"}, "action_space in metadata.json is damaged"),
    "unbounded actions": (
        {"action_space": json.dumps({"type": "Box", "shape": [2], "low": [-1, -1], "high": [1, float("inf")]})},
        "expected a bounded Box",
    ),
    "discrete actions": (
        {"action_space": json.dumps({"type": "Discrete", "n": 3})},
        "expected a bounded Box",
    ),
    "foreign code": ({"env_spec": _spec(entry_point="os:system")}, "names the code 'os:system'"),
    "look-alike package": (
        {"env_spec": _spec(entry_point="gymnasium_evil:Env")},
        "names the code 'gymnasium_evil",
    ),
    "foreign wrapper": (
        {"env_spec": _spec(additional_wrappers=[{"name": "w", "entry_point": "shutil:rmtree", "kwargs": {}}])},
        "names the code 'shutil:rmtree'",
    ),
    "unknown environment": ({"env_spec": _spec(id="Evil-v0")}, "recorded in 'Evil-v0', which no task uses"),
    "damaged environment": ({"env_spec": "[]"}, "env_spec in metadata.json is damaged"),
    "no environment": (
        {"env_spec": None},
        "has no env_spec, so nothing says that it was recorded in PointMaze_",
    ),
    "other format": ({"data_format": "arrow"}, "data_format is 'arrow', expected 'hdf5'"),
    "episodes hidden": ({"total_episodes": 1}, "promises 1 episodes, but .* holds 2"),
    "episodes invented": ({"total_episodes": 10**12}, "promises 1000000000000 episodes, but .* holds 2"),
    "steps invented": ({"total_steps": 25}, "promises 25 steps, but .* holds 24"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_metadata_are_not_trusted(case: str, minari_set: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    import gymnasium

    monkeypatch.setattr(gymnasium, "make", lambda *a, **k: pytest.fail("an environment was built from a data set"))
    metadata, message = HOSTILE[case]
    with pytest.raises(DataError, match=message):
        load_trajectories(f"local:{minari_set(metadata=metadata)}", LARGE)


def _set(name: str, value: Any) -> Callable[[h5py.File], None]:
    def spoil(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return spoil


def _delete(name: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(name)


def _nan(file: h5py.File) -> None:
    file["episode_1/observations/observation"][4, 2] = np.nan


SPOILT: dict[str, tuple[Callable[[h5py.File], None], str]] = {
    "not a number": (_nan, "episode_1, observations: found nan at step 4, column 2"),
    "wrong width": (
        _set("episode_1/observations/observation", np.zeros((13, 3))),
        r"episode_1, observations: found shape \(13, 3\), expected \(steps, 4\)",
    ),
    "T observations": (
        _set("episode_0/observations/observation", np.zeros((12, 4))),
        r"episode_0, observations: found 12 rows, expected 13",
    ),
    "no end": (_set("episode_1/truncations", np.zeros(12, bool)), "episode_1: never ends"),
    "outside the box": (
        _set("episode_0/actions", np.full((12, 2), 3.0)),
        "episode_0, actions: found 3 at step 0, column 0, expected -1 to 1",
    ),
    "no rewards": (_delete("episode_1/rewards"), "episode_1: 'rewards' is missing; found actions"),
    "no observation": (
        _delete("episode_1/observations/observation"),
        "episode_1, observations: found the entries desired_goal, expected 'observation'",
    ),
    "an array for an episode": (
        _set("episode_1", np.zeros(3)),
        "episode_1: found an array, expected a group",
    ),
    "a gap": (_delete("episode_0"), "promises 2 episodes, but .* holds 1"),
    "a link": (
        _set("episode_1/rewards", h5py.ExternalLink("elsewhere.hdf5", "/x")),
        "episode_1: 'rewards' is a link to elsewhere",
    ),
    "a strange name": (_set("episode_1", h5py.SoftLink("/episode_0")), "'episode_1' is a link to elsewhere"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_spoilt_episodes_are_refused_naming_set_episode_and_field(case: str, minari_set: Write) -> None:
    spoil, message = SPOILT[case]
    with pytest.raises(DataError, match=r"data set 'set-v0'.*" + message):
        load_trajectories(f"local:{minari_set(spoil=spoil)}", LARGE)


def test_an_empty_set_is_refused(minari_set: Write) -> None:
    with pytest.raises(DataError, match="data set 'set-v0' is empty"):
        load_trajectories(f"local:{minari_set(episodes=0)}", LARGE)


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.99])
def test_a_truncated_file_is_refused_by_name(minari_set: Write, keep: float) -> None:
    path = minari_set() / "data" / "main_data.hdf5"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep if keep > 1 else keep * len(whole))])
    with pytest.raises(DataError, match=r"main_data.hdf5 is truncated or damaged"):
        load_trajectories(f"local:{path.parent.parent}", LARGE)


def test_missing_files_are_named_with_what_is_there(minari_set: Write, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"metadata.json is missing, .* found no such folder"):
        load_trajectories(f"local:{tmp_path / 'nowhere'}", LARGE)
    folder = minari_set()
    (folder / "data" / "main_data.hdf5").unlink()
    with pytest.raises(DataError, match=r"main_data.hdf5 is missing; found metadata.json"):
        load_trajectories(f"local:{folder}", LARGE)
    (folder / "data" / "metadata.json").write_text("[1, 2")
    with pytest.raises(DataError, match=r"metadata.json is damaged"):
        load_trajectories(f"local:{folder}", LARGE)


def test_recorded_rewards_can_be_kept(minari_set: Write) -> None:
    folder = minari_set(spoil=_set("episode_0/rewards", np.ones(12)))
    assert load_trajectories(f"local:{folder}", LARGE, reward="recorded").rewards.sum() == 12
    assert load_trajectories(f"local:{folder}", LARGE).rewards.sum() == 0
    with pytest.raises(UserError, match="reward: found 'dense'"):
        load_trajectories(f"local:{folder}", LARGE, reward="dense")  # type: ignore[arg-type]


def test_saved_arrays_are_a_source_too(minari_set: Write, tmp_path: Path) -> None:
    data = load_trajectories(f"local:{minari_set()}", LARGE)
    data.save(tmp_path / "arrays")
    back = load_trajectories(f"arrays:{tmp_path / 'arrays'}", LARGE)
    assert back.fingerprint() == data.fingerprint()
    data.select([0]).save(tmp_path / "one")
    narrow = np.zeros((13, 3), np.float32)
    np.save(tmp_path / "one" / "observations.npy", narrow)
    with pytest.raises(DataError, match="do not match their fingerprint"):
        load_trajectories(f"arrays:{tmp_path / 'one'}", LARGE)
