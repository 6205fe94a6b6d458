"""Task files: what they may say, what is read from the environment, and what a stranger's definition may not do."""

import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dds_lightning.errors import UserError
from dds_lightning.tasks import facts_to_keep, get_task, is_own, known_task, restore_task
from dds_lightning.tasks.bodies import BODIES, Body, has_state, observation_names, state_layout
from dds_lightning.tasks.facts import task_lines
from dds_lightning.tasks.own import build_task, definition

PENDULUM = {"env_id": "InvertedPendulum-v5", "max_episode_steps": 60, "score_min": 5, "score_max": 60}


def file(path, **changes):
    values = {name: value for name, value in {**PENDULUM, **changes}.items() if value is not None}
    path.write_text("".join(f"{name}: {value}\n" for name, value in values.items()))
    return str(path)


def test_widths_box_and_seconds_are_read_from_the_environment(tmp_path):
    task = get_task(file(tmp_path / "pole.yaml"))
    assert (task.name, task.family, task.observation_dim, task.action_dim) == ("pole", "default", 4, 1)
    assert (task.action_low, task.action_high, task.step_seconds) == (-3.0, 3.0, 0.04)
    assert (task.measures_success, task.normalised_score(32.5)) == (False, 50.0)
    assert is_own(task)
    assert not is_own(get_task("hopper-medium@v5"))


def test_the_bounds_of_actions_may_be_a_list_with_one_for_every_entry(tmp_path):
    limits = {"action_low": [-2, -1, -0.5], "action_high": 1}
    task = get_task(file(tmp_path / "leap.yaml", env_id="Hopper-v5", **limits))
    assert (task.action_low, task.action_high) == ((-2.0, -1.0, -0.5), 1.0)
    low, high = task.action_box()
    assert (low.tolist(), high.tolist(), low.dtype) == ([-2.0, -1.0, -0.5], [1.0, 1.0, 1.0], np.float32)
    assert dict(task_lines(task))["action"].startswith("3 numbers from (-2, -1, -0.5) to 1: ")
    kept = facts_to_keep(task)
    assert kept["task_definition"]["action_low"] == [-2.0, -1.0, -0.5]
    assert restore_task(kept, "agent") == task


def test_once_read_it_is_known_by_its_name_and_its_environment_plays(tmp_path):
    task = get_task(file(tmp_path / "pole-two.yaml"))
    assert get_task("pole-two") is task
    assert get_task(task) is task
    env = task.make_env()
    observation, _ = env.reset(seed=0)
    assert observation.shape == (4,)
    env.close()


@pytest.mark.parametrize(("keys", "width"), [(["observation"], 10), (["observation", "desired_goal"], 13)])
def test_a_dictionary_is_flattened_with_the_goal_or_without(tmp_path, keys, width):
    task = get_task(file(tmp_path / "reach.yaml", env_id="FetchReach-v4", observation_keys=keys, measures_success=True))
    assert (task.observation_dim, task.observation_keys) == (width, tuple(keys))
    assert build_task(definition(task), "here", trusted=False) == task
    env, plain = task.make_env(), gym.make("FetchReach-v4")
    seen, info = env.reset(seed=3)
    expected = plain.reset(seed=3)[0]
    np.testing.assert_allclose(seen, np.concatenate([expected[key] for key in keys]), rtol=1e-6)
    assert info["success"] is False
    assert env.step(env.action_space.sample())[4]["success"] is False
    check_env(env, skip_render_check=True)
    env.unwrapped.goal[:] = expected["achieved_goal"]
    assert env.step(np.zeros(4))[4]["success"] is True


def test_its_definition_makes_it_again_and_is_kept_with_agents(tmp_path):
    task = get_task(file(tmp_path / "pole.yaml", positions=[0, 1], velocities=[2, 3]))
    assert build_task(definition(task), "here") == task
    kept = facts_to_keep(task)
    assert restore_task(kept, "agent") == task
    assert facts_to_keep(get_task("hopper-medium")) == {"task": "hopper-medium"}
    assert restore_task({}, "agent") is None


def test_the_state_in_an_observation_may_be_said(tmp_path):
    task = get_task(file(tmp_path / "poles.yaml", positions=[0, 1], velocities=[2, 3]))
    layout = state_layout(task, 4)
    assert (layout.positions, layout.velocities, layout.degrees, layout.hidden) == ((0, 1), (2, 3), 2, 0)
    plain = get_task(file(tmp_path / "mast.yaml"))
    assert not has_state(plain)
    with pytest.raises(UserError, match="nothing says which observations are the simulator's positions"):
        state_layout(plain, 4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_steps": 3}, r"sets max_steps, which is not known; did you mean max_episode_steps\?"),
        ({"env_id": None}, "lacks env_id"),
        ({"env_id": "Nowhere-v9"}, "sets env_id to Nowhere-v9: "),
        (
            {"env_id": "FetchReach-v4"},
            r"a dictionary of achieved_goal \(3,\), desired_goal \(3,\), observation \(10,\): set observation_keys to "
            r"those that are put end to end, for example \[observation\] or, with the goal, \[observation, desired",
        ),
        (
            {"env_id": "FetchReach-v4", "observation_keys": ["observation", "goal"]},
            r"; it is \['observation', 'goal'\]",
        ),
        ({"observation_keys": ["observation"]}, r"one array, .*: leave out observation_keys, which is \['observation'"),
        ({"observation_keys": ["a", "a"]}, "sets observation_keys to .*, expected names of entries, each once"),
        ({"max_episode_steps": "many"}, "sets max_episode_steps to 'many', expected a whole number"),
        ({"score_max": 1}, "sets score_max to 1.0, expected more than score_min=5.0"),
        ({"observation_dim": 7}, "sets observation_dim to 7, but InvertedPendulum-v5 has 4"),
        ({"positions": [0, 9], "velocities": [2]}, r"sets positions to \[0, 9\], expected a list of columns of 0 to 3"),
        ({"name": "a/b"}, "sets name to 'a/b', expected letters"),
        ({"reward_scale": 0}, "sets reward_scale to 0.0, expected a positive number"),
        ({"action_low": [-1, -1]}, r"sets action_low to \[-1.0, -1.0\], expected one number, or 1, one for each entry"),
        ({"action_high": "[a]"}, r"sets action_high to \['a'\], expected a number, or a list with one for each entry"),
        ({"action_high": [True]}, r"sets action_high to \[True\], expected a number, or a list"),
        ({"action_low": 5}, "action_low is 5 and action_high 3 in entry 0 of an action, expected finite numbers, the"),
        ({"action_high": ".inf"}, "action_low is -3 and action_high inf in entry 0"),
        ({"score_min": [1]}, r"sets score_min to \[1\], expected a number"),
    ],
)
def test_what_cannot_work_is_refused_with_field_value_and_expectation(tmp_path, changes, message):
    with pytest.raises(UserError, match=message):
        get_task(file(tmp_path / "pole.yaml", **changes))


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    (tmp_path / "broken.yaml").write_text("a: [1\n")
    (tmp_path / "long.yaml").write_text("a: " + "x" * 200_000)
    for name, message in (("list", "is not a mapping"), ("broken", "is not valid YAML"), ("long", "at most 100000")):
        with pytest.raises(UserError, match=message):
            get_task(str(tmp_path / f"{name}.yaml"))
    with pytest.raises(UserError, match="there is no file"):
        get_task("nowhere.yaml")


def test_a_name_of_the_table_is_not_taken(tmp_path):
    with pytest.raises(UserError, match="name is hopper-medium, which is already in the table"):
        get_task(file(tmp_path / "hopper-medium.yaml"))


def test_a_task_may_stand_in_a_module(tmp_path, monkeypatch):
    (tmp_path / "my_tasks.py").write_text(
        "from dds_lightning.tasks.own import build_task\n"
        f"POLE = build_task({ {**PENDULUM, 'name': 'pole-in-python'}!r}, 'my_tasks')\nOTHER = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert get_task("my_tasks:POLE").name == "pole-in-python"
    with pytest.raises(UserError, match=r"'my_tasks:OTHER' is a int, expected a dds_lightning.tasks.Task"):
        get_task("my_tasks:OTHER")
    with pytest.raises(UserError, match="'no_such_module:TASK' cannot be imported"):
        get_task("no_such_module:TASK")


def test_what_an_agent_names_is_neither_opened_nor_run(tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text("raise SystemExit('run')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for facts in ({"task": "evil:TASK"}, {"task": str(tmp_path / "pole.yaml")}):
        with pytest.raises(UserError, match="there is no task"):
            restore_task(facts, "agent")
    with pytest.raises(UserError, match="there is no task"):
        known_task("evil:TASK")
    kept = {**definition(get_task(file(tmp_path / "pole.yaml"))), "name": "stranger"}
    for changes, message in (
        ({"env_id": "evil:Pole-v0"}, "sets env_id to 'evil:Pole-v0'"),
        ({"env_options": {"xml_file": "/etc/passwd"}}, "expected numbers, true or false"),
        ({"name": "../up"}, "sets name to '../up'"),
    ):
        with pytest.raises(UserError, match=message):
            restore_task({"task_definition": {**kept, **changes}}, "agent")
    assert "evil" not in sys.modules


def test_a_new_robot_is_a_row_that_gives_its_columns_names(tmp_path, monkeypatch):
    task = get_task(file(tmp_path / "rod.yaml"))
    assert observation_names(task)[:2] == ("observation 0", "observation 1")
    names = ("x (m)", "angle (rad)", "x velocity (m/s)", "spin (rad/s)")
    monkeypatch.setitem(BODIES, "rod", Body(observations=names, actions=("push",)))
    assert observation_names(task) == names
