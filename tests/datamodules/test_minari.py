from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.sources import resolve_task
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task, task_names
from tests.minari_recordings import change_metadata, changed_spec, write_minari_set
from tests.recordings import Episode, record

Write = Callable[..., Path]
LARGE = "pointmaze-large-diverse"
KEYS = ("achieved_goal", "desired_goal", "observation")


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
    with pytest.raises(UserError, match="is not a Minari id"):
        load_trajectories("minari:../set-v0", LARGE)


@pytest.mark.parametrize("spec", ["", "local", "local:", "http://somewhere", "nowhere:x"])
def test_an_unknown_source_lists_those_there_are(spec: str) -> None:
    with pytest.raises(UserError, match=r"data: got .*, expected one of local:DIR .*minari:ID .*arrays:DIR"):
        load_trajectories(spec, LARGE)


def test_a_set_of_another_task_is_refused_naming_both(minari_set: Write) -> None:
    folder = minari_set(task="pointmaze-medium-play")
    with pytest.raises(
        DataError,
        match=r"data 'local:.*set-v0' were recorded in PointMaze_Medium-v3, but task 'pointmaze-large-diverse' needs "
        "PointMaze_Large-v3; choose a task that fits the data, or other data",
    ):
        load_trajectories(f"local:{folder}", LARGE)


def test_lettered_cells_of_the_same_walls_are_accepted(minari_set: Write) -> None:
    walls: list[list[Any]] = [[int(v) for v in row] for row in get_task(LARGE).maze_map or ()]
    walls[7][1], walls[1][10] = "r", "g"
    folder = minari_set()
    change_metadata(folder, {"env_spec": changed_spec(folder, kwargs={"maze_map": walls})})
    assert load_trajectories(f"local:{folder}", LARGE).num_episodes == 2


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
    "not a number": (_nan, "episode_1, observations: got nan at step 4, column 2"),
    "wrong width": (
        _set("episode_1/observations/observation", np.zeros((13, 3))),
        r"episode_1, observations/observation: got shape \(13, 3\), expected \(steps, 4\)",
    ),
    "T observations": (
        _set("episode_0/observations/observation", np.zeros((12, 4))),
        r"episode_0, observations: got 12 rows, expected 13",
    ),
    "no end": (_set("episode_1/truncations", np.zeros(12, bool)), "episode_1: never ends"),
    "outside the box": (
        _set("episode_0/actions", np.full((12, 2), 3.0)),
        "episode_0, actions: got 3 at step 0, column 0, expected -1 to 1",
    ),
    "no rewards": (_delete("episode_1/rewards"), "episode_1: 'rewards' is missing; found actions"),
    "no observation": (
        _delete("episode_1/observations/observation"),
        "episode_1, observations: got the entries desired_goal, expected 'observation'",
    ),
    "an array for an episode": (
        _set("episode_1", np.zeros(3)),
        "episode_1: got an array, expected a group",
    ),
    "a gap": (_delete("episode_0"), "promises 2 episodes, but .* has 1"),
    "another name": (
        lambda file: file.move("episode_1", "episode_7"),
        "main_data.hdf5 has 2 episodes, but no episode_1",
    ),
    "parts of different length": (
        _set("episode_1/observations/observation", np.zeros((12, 4))),
        "episode_1, observations: got 12 rows, expected 13",
    ),
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
    with pytest.raises(DataError, match=r"metadata.json is missing, .* does not exist either"):
        load_trajectories(f"local:{tmp_path / 'nowhere'}", LARGE)
    folder = minari_set()
    (folder / "data" / "main_data.hdf5").unlink()
    with pytest.raises(DataError, match=r"main_data.hdf5 is missing; .* holds metadata.json"):
        load_trajectories(f"local:{folder}", LARGE)
    (folder / "data" / "metadata.json").write_text("[1, 2")
    with pytest.raises(DataError, match=r"metadata.json is damaged"):
        load_trajectories(f"local:{folder}", LARGE)


def test_recorded_rewards_can_be_kept(minari_set: Write) -> None:
    folder = minari_set(spoil=_set("episode_0/rewards", np.ones(12)))
    assert load_trajectories(f"local:{folder}", LARGE, reward="recorded").rewards.sum() == 12
    assert load_trajectories(f"local:{folder}", LARGE).rewards.sum() == 0
    with pytest.raises(UserError, match="reward: got 'dense'"):
        load_trajectories(f"local:{folder}", LARGE, reward="dense")  # type: ignore[arg-type]


def test_saved_arrays_are_a_source_too(minari_set: Write, tmp_path: Path) -> None:
    data = load_trajectories(f"local:{minari_set()}", LARGE)
    data.save(tmp_path / "arrays")
    back = load_trajectories(f"arrays:{tmp_path / 'arrays'}")
    assert back.fingerprint() == data.fingerprint()
    data.select([0]).save(tmp_path / "one")
    narrow = np.zeros((13, 3), np.float32)
    np.save(tmp_path / "one" / "observations.npy", narrow)
    with pytest.raises(DataError, match="do not match their fingerprint"):
        load_trajectories(f"arrays:{tmp_path / 'one'}", LARGE)


# ---------------------------------------------------------------------- real steps of every environment


def _same(data: Trajectories, episodes: Sequence[Episode]) -> None:
    for key in ("observations", "actions", "terminations", "truncations"):
        np.testing.assert_array_equal(getattr(data, key), np.concatenate([episode[key] for episode in episodes]))
    assert data.lengths.tolist() == [len(episode["rewards"]) for episode in episodes]


@pytest.mark.parametrize("name", task_names())
def test_real_steps_of_every_task_come_back_flat(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = get_task(name)
    task = task.variant("robotics") if task.family == "antmaze" else task
    episodes = record(task, 12, episode_steps=8)
    dataset_id = task.data_ids.get("minari", f"{name}-v0")
    write_minari_set(tmp_path, dataset_id, task, episodes)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = load_trajectories(f"minari:{dataset_id}", name, reward="recorded")
    _same(data, episodes)
    np.testing.assert_allclose(data.rewards, np.concatenate([episode["rewards"] for episode in episodes]), rtol=1e-6)
    assert (data.name, data.observation_dim, data.action_dim) == (dataset_id, task.observation_dim, task.action_dim)
    learnt = load_trajectories(f"minari:{dataset_id}", name)
    assert learnt.num_steps == 12
    assert resolve_task(f"minari:{dataset_id}", name).env_id == task.env_id


@pytest.mark.parametrize(
    ("name", "recorded_in", "variant", "stored"),
    [
        ("antmaze-umaze", "dds/AntMazeD4RL_UMaze-v0", "d4rl", (29,)),
        ("antmaze-umaze", "AntMaze_UMaze-v5", "robotics", (105,)),
        ("antmaze-large-diverse", "AntMaze_Large_Diverse_GR-v4", "robotics", (27,)),
        ("hopper-medium-expert", "Hopper-v5", "v5", (11,)),
        ("walker2d-medium", "Walker2d-v5", "v5", (17,)),
        ("pointmaze-medium-diverse", "PointMaze_Medium_Diverse_GDense-v3", "", (4,)),
    ],
)
def test_other_versions_of_an_environment_choose_their_physics(
    name: str, recorded_in: str, variant: str, stored: tuple[int], tmp_path: Path
) -> None:
    task = get_task(name)
    task = replace(task.variant(variant) if variant else task, env_id=recorded_in)
    episodes = record(task, 10)
    folder = write_minari_set(tmp_path, "other-v0", task, episodes)
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        node = file["episode_0/observations"]
        node = node["observation"] if isinstance(node, h5py.Group) else node
        assert node.shape[1:] == stored
    _same(load_trajectories(f"local:{folder}", name), episodes)
    assert resolve_task(f"local:{folder}", name).physics == variant
    loaded = load_trajectories(f"local:{folder}", name)
    assert loaded.task is not None
    assert loaded.task.physics == variant


@pytest.mark.parametrize("name", ["antmaze-umaze@robotics", "kitchen-mixed", "hopper-medium"])
def test_the_sets_of_these_tests_are_minaris_own_format(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import minari

    task = get_task(name)
    episodes = record(task, 6)
    write_minari_set(tmp_path, "theirs-v0", task, episodes)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("theirs-v0")
    seen = dataset[0].observations
    seen = {"observation": seen} if isinstance(seen, np.ndarray) else seen
    raw = [step if isinstance(step, dict) else {"observation": step} for step in episodes[0]["raw_observations"]]
    np.testing.assert_array_equal(seen["observation"], [step["observation"] for step in raw])
    assert (dataset.total_steps, dataset.env_spec.id) == (6, task.env_id)


def test_a_set_that_minari_wrote_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Minari's own writer, with its chunks and its order of entries, of an environment with dictionaries."""
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer

    task = get_task("antmaze-umaze@robotics")
    episodes = record(task, 9, episode_steps=5)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    buffers = [
        EpisodeBuffer(
            id=number,
            observations={key: [step[key] for step in episode["raw_observations"]] for key in KEYS},
            **{key: list(episode[key]) for key in ("actions", "rewards", "terminations", "truncations")},
        )
        for number, episode in enumerate(episodes)
    ]
    env = task.make_env()
    minari.create_dataset_from_buffers("antmaze-v0", buffers, env=env.env.unwrapped.spec)
    env.close()
    _same(load_trajectories("minari:antmaze-v0", "antmaze-umaze"), episodes)


def test_reading_takes_less_than_twice_the_memory_of_the_result(tmp_path: Path) -> None:
    task = replace(get_task("antmaze-umaze@robotics"), env_id="AntMaze_UMaze-v5")
    episode = record(task, 500, episode_steps=500)[0]
    folder = write_minari_set(tmp_path, "long-v0", task, [episode] * 30)
    load_trajectories(f"local:{folder}", "antmaze-umaze", reward="recorded")  # imports are not the result's
    tracemalloc.start()
    data = load_trajectories(f"local:{folder}", "antmaze-umaze", reward="recorded")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = sum(array.nbytes for array in data.arrays().values())
    assert size == pytest.approx(15_030 * 29 * 4 + 15_000 * (8 * 4 + 4 + 2), rel=0.01)
    assert peak < 2 * size
