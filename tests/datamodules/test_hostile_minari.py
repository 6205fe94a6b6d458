"""What a hostile metadata.json may say; arrays are in `test_hostile_minari_arrays`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datamodules import load_trajectories
from datamodules.sources.metadata import MAX_BYTES
from datamodules.trajectories import DataError
from dds_lightning.errors import UserError
from tests.minari_recordings import change_metadata, changed_spec
from tests.refusals import MAZE, PAYLOAD, STEPS, refuse

Change = Callable[[Path], None]


def test_the_payload_is_real(maze_set: Path, sentinel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the refusals below are for: Minari's own loader runs what such a set names."""
    import minari

    spec = changed_spec(maze_set, id="Stranger-v0", entry_point=PAYLOAD)
    change_metadata(maze_set, {"env_spec": spec, "observation_space": None})
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(maze_set.parent))
    with pytest.raises(TypeError, match="no arguments"):
        minari.load_dataset("set-v0")
    assert sentinel.exists()


# ---------------------------------------------------------------------- metadata.json


def _spec(**entries: Any) -> Change:
    return lambda folder: change_metadata(folder, {"env_spec": changed_spec(folder, **entries)})


def _evaluation(**entries: Any) -> Change:
    return lambda folder: change_metadata(folder, {"eval_env_spec": changed_spec(folder, **entries)})


def _entries(**entries: Any) -> Change:
    return lambda folder: change_metadata(folder, entries)


def _space(key: str, **space: Any) -> Change:
    return _entries(**{key: json.dumps(space)})


def _text(content: str | bytes) -> Change:
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / "data" / "metadata.json").write_bytes(raw) and None


def _wrapper(entry_point: Any) -> list[dict[str, Any]]:
    return [{"name": "w", "entry_point": entry_point, "kwargs": {}}]


def _without_a_space(folder: Path) -> None:
    _spec(entry_point=PAYLOAD)(folder)
    change_metadata(folder, {"observation_space": None})


MAZE_SPACE = {"achieved_goal": {"type": "Box", "shape": [2]}, "desired_goal": {"type": "Box", "shape": [2]}}
METADATA: dict[str, tuple[Change, str]] = {
    # code
    "entry point": (_spec(entry_point=PAYLOAD), f"env_spec names the code '{PAYLOAD}', expected gymnasium_robotics"),
    "a command": (_spec(entry_point="os:system"), "env_spec names the code 'os:system'"),
    "look-alike package": (_spec(entry_point="gymnasium_evil:Env"), "names the code 'gymnasium_evil:Env'"),
    "another callable of a good package": (
        _spec(entry_point="gymnasium.utils.play:play"),
        "names the code 'gymnasium.utils.play:play', expected gymnasium_robotics.envs.maze.point_maze:PointMazeEnv",
    ),
    "another environment's code": (
        _spec(entry_point="gymnasium.envs.mujoco.hopper_v5:HopperEnv"),
        "names the code 'gymnasium.envs.mujoco.hopper_v5:HopperEnv'",
    ),
    "entry point that is no text": (_spec(entry_point={"py/object": PAYLOAD}), "names the code {'py/object'"),
    "vector entry point": (_spec(vector_entry_point=PAYLOAD), f"env_spec names the code '{PAYLOAD}', expected none"),
    "wrapper": (
        _spec(additional_wrappers=_wrapper(PAYLOAD)),
        f"env_spec names the code '{PAYLOAD}', expected only wrapp",
    ),
    "wrapper that changes rewards": (
        _spec(additional_wrappers=_wrapper("gymnasium.wrappers.transform_reward:ClipReward")),
        "names the code 'gymnasium.wrappers.transform_reward:ClipReward'",
    ),
    "wrapper that is not an object": (_spec(additional_wrappers=["w"]), "names the code 'w'"),
    "wrappers that are no list": (_spec(additional_wrappers={"a": 1}), "env_spec in metadata.json is damaged"),
    "entry point for evaluation": (_evaluation(entry_point=PAYLOAD), f"eval_env_spec names the code '{PAYLOAD}'"),
    "wrapper for evaluation": (
        _evaluation(additional_wrappers=_wrapper(PAYLOAD)),
        f"eval_env_spec names the code '{PAYLOAD}'",
    ),
    "unknown environment for evaluation": (_evaluation(id="Evil-v0"), "recorded in 'Evil-v0', which no task uses"),
    # environment
    "unknown environment": (_spec(id="Evil-v0"), "recorded in 'Evil-v0', which no task uses"),
    "environment by module": (_spec(id="payload_of_a_stranger:Evil-v0"), "which no task uses; see `dds tasks`"),
    "no id": (_spec(id=None), "recorded in None, which no task uses"),
    "an environment that is not installed": (
        _spec(id="PointMaze_UMaze_Diverse_G-v3"),
        "PointMaze_UMaze_Diverse_G-v3, which is not among the installed environments",
    ),
    "another task's environment": (
        _spec(id="AntMaze_Large-v4", entry_point=None, kwargs={}),
        f"recorded in AntMaze_Large-v4, but task '{MAZE}' needs PointMaze_Large-v3",
    ),
    "no environment": (_entries(env_spec=None), "has no env_spec, so nothing says that it was recorded in PointMaze"),
    "damaged environment": (
        _entries(env_spec="[]"),
        r"env_spec in metadata.json is damaged: expected a JSON object, got \[\]",
    ),
    "other model": (
        _spec(kwargs={"xml_file": "/home/somebody/point.xml"}),
        "recorded with the argument xml_file = '/home/somebody/point.xml', so with other physics",
    ),
    "other time step": (_spec(kwargs={"frame_skip": 10}), "recorded with the argument frame_skip = 10"),
    "arguments that are not an object": (_spec(kwargs=[1]), "expected an object for kwargs"),
    "other walls": (
        _spec(kwargs={"maze_map": [[1, 1, 1], [1, "c", 1], [1, 1, 1]]}),
        rf"other walls \('?111/101/111'?\) than task '{MAZE}'",
    ),
    "walls that are none": (_spec(kwargs={"maze_map": {"rows": None}}), "other walls"),
    # spaces
    "no observation space": (_without_a_space, "has no observation_space; Minari would run"),
    "no action space": (_entries(action_space=None), "has no action_space; Minari would run"),
    "damaged space": (_entries(action_space="{"), "action_space in metadata.json is damaged"),
    "deep space": (_entries(observation_space="[" * 100_000), "observation_space in metadata.json is damaged"),
    "another family's observations": (
        _space("observation_space", type="Box", shape=[11], low=[], high=[]),
        rf"observation space is a Box \(11,\), but task '{MAZE}' needs a Dict of observation \(4,\)",
    ),
    "another maze's observations": (
        _space(
            "observation_space", type="Dict", subspaces={**MAZE_SPACE, "observation": {"type": "Box", "shape": [27]}}
        ),
        r"is a Dict of .*observation \(27,\), but",
    ),
    "a negative width": (
        _space("observation_space", type="Dict", subspaces={"observation": {"type": "Box", "shape": [-4]}}),
        r"is a Dict of observation \[-4\], but",
    ),
    "a space that needs code": (
        _space("observation_space", type=PAYLOAD, subspaces={}),
        f"observation space is a {PAYLOAD}, but",
    ),
    "another body's actions": (
        _space("action_space", type="Box", shape=[8], low=[-1] * 8, high=[1] * 8),
        r"action space is a Box \(8,\) from -1 to 1, but task .* needs a Box \(2,\) from -1 to 1",
    ),
    "another box": (_space("action_space", type="Box", shape=[2], low=[-9, -9], high=[9, 9]), "from -9 to 9, but task"),
    "unbounded actions": (
        _space("action_space", type="Box", shape=[2], low=[-1, -1], high=[1, float("inf")]),
        "expected a bounded Box",
    ),
    "discrete actions": (_space("action_space", type="Discrete", n=3), "expected a bounded Box"),
    # the file
    "no JSON": (_text("env_spec: os.system"), "metadata.json is damaged: it is not a JSON object"),
    "a list": (_text("[1, 2]"), r"metadata.json is damaged: expected a JSON object, got \[1, 2\]"),
    "deep JSON": (_text('{"a":' * 100_000), "metadata.json is damaged"),
    "huge JSON": (
        _text("[" + "0," * MAX_BYTES + "0]"),
        r"metadata.json has 2,097,155 bytes, expected at most 1,048,576",
    ),
    "no text": (_text(b"\x89HDF\r\n\x1a\n\xff"), "metadata.json is damaged"),
    "a number of a million digits": (_text('{"total_steps": ' + "9" * 1_000_000 + "}"), "metadata.json is damaged"),
    "other format": (_entries(data_format="arrow"), "data_format is 'arrow', expected 'hdf5'"),
    "episodes hidden": (_entries(total_episodes=1), "promises 1 episodes, but .* has 2"),
    "episodes invented": (_entries(total_episodes=10**12), "promises 1000000000000 episodes, but .* has 2"),
    "steps invented": (_entries(total_steps=41), "promises 41 steps, but .* has 40"),
    "negative episodes": (_entries(total_episodes=-2), "total_episodes in metadata.json is -2, expected a count"),
    "steps in words": (_entries(total_steps="many"), "total_steps in metadata.json is 'many', expected a count"),
    "orders to the terminal": (_entries(data_format="\x1b[2J\nhdf5" * 100), "data_format is '.x1b.*, expected 'hdf5'"),
}


@pytest.mark.parametrize("case", METADATA)
def test_metadata_are_not_trusted(case: str, maze_set: Path, sentinel: Path) -> None:
    change, message = METADATA[case]
    change(maze_set)
    refuse(maze_set, MAZE, message, sentinel)


@pytest.mark.parametrize("argument", ["frame_skip", "xml_file", "maze_height"])
def test_what_changes_the_physics_is_refused_without_a_task_too(argument: str, maze_set: Path) -> None:
    _spec(kwargs={argument: 1})(maze_set)
    with pytest.raises(DataError, match=rf"argument {argument} = 1, .* has no argument '{argument}'"):
        load_trajectories(f"local:{maze_set}")


def test_harmless_wrappers_and_arguments_pass(maze_set: Path) -> None:
    watching = _wrapper("gymnasium.wrappers.common:RecordEpisodeStatistics")
    kwargs = {"continuing_task": True, "reset_target": True, "reward_type": "dense", "render_mode": "rgb_array"}
    _spec(kwargs=kwargs, additional_wrappers=watching, max_episode_steps=1_000_000)(maze_set)
    assert load_trajectories(f"local:{maze_set}", MAZE).num_steps == 2 * STEPS


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a\nb", "", 7, "x" * 10_000])
def test_a_name_that_is_a_path_names_nothing(name: Any, maze_set: Path) -> None:
    _entries(dataset_id=name)(maze_set)
    assert load_trajectories(f"local:{maze_set}", MAZE).name == "set-v0"


@pytest.mark.parametrize("name", ["../sets/set-v0", "..", "/etc", "a/../set-v0", "set-v0/", "set v0", "set-v0\n"])
def test_an_id_that_is_a_path_is_refused(name: str, maze_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(maze_set.parent))
    with pytest.raises(UserError, match="is not a Minari id"):
        load_trajectories(f"minari:{name}", MAZE)
