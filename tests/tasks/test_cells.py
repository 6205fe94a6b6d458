"""Another goal or start cell in a task's name or file: what it changes, what it leaves, what is refused."""

import numpy as np
import pytest

from datamodules.sources import load_trajectories
from datamodules.sources.goal import relabel_to_goal
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import facts_to_keep, get_task, is_own, restore_task, task_for_env
from dds_lightning.tasks.facts import draw_maze, task_facts

MAZES = ["antmaze-large-diverse", "antmaze-large-diverse@robotics", "pointmaze-large-diverse"]


@pytest.mark.parametrize("name", MAZES)
def test_episodes_start_in_the_one_cell_and_end_in_the_other(name):
    plain, task = get_task(name), get_task(f"{name}?start=3,1&goal=5,10")
    assert (task.start_cell, task.goal_cell, task.paper_score) == ((3, 1), (5, 10), None)
    np.testing.assert_array_equal(task.cell_to_xy([(0, 0), (4, 7)]), plain.cell_to_xy([(0, 0), (4, 7)]))
    env = task.make_env()
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        assert tuple(task.xy_to_cell(observation[:2])) == tuple(task.xy_to_cell(info["position"])) == (3, 1)
        goal = np.asarray(env.unwrapped.goal)
        assert tuple(task.xy_to_cell(goal)) == (5, 10)
        assert np.abs(goal - task.goal_xy()).max() <= task.goal_noise
    env.close()
    assert draw_maze(task)[3][2:4] == "S "
    assert task_facts(task)["goal"]["cell"] == (5, 10)


@pytest.mark.parametrize("name", MAZES)
def test_it_is_known_by_its_name_wherever_that_is_stored(name):
    task = get_task(f"{name}?goal=7,1&start=1,1")
    assert not is_own(task)
    assert restore_task(facts_to_keep(task), "agent") == get_task(task.name) == task
    assert (task.base_name, task.file_name.count("?")) == (name.partition("@")[0], 0)
    for physics in task.variants:
        other = task.variant(physics)
        assert (other.physics, other.goal_cell, other.data_reward) == (physics, (7, 1), "goal")
        assert get_task(other.name) == other


def test_recordings_choose_the_physics_as_for_any_task():
    found = task_for_env(get_task("antmaze-large-play?goal=7,1"), "AntMaze_Large-v4")
    assert found == get_task("antmaze-large-play@robotics?goal=7,1")


def test_what_changes_nothing_is_the_task_itself_and_order_does_not_matter():
    assert get_task("pointmaze-large-diverse?goal=1,10&start=7,1") is get_task("pointmaze-large-diverse")
    assert get_task("pointmaze-large-diverse?goal=7,10&start=7,1").name == "pointmaze-large-diverse?goal=7,10"
    one, two = "antmaze-umaze?goal=1,3&start=3,3", "antmaze-umaze?start=3,3&goal=1,3"
    assert get_task(one) == get_task(two)


def test_a_file_says_the_same(tmp_path):
    path = tmp_path / "corner.yaml"
    path.write_text("task: antmaze-large-diverse\ngoal: [7, 1]\n")
    assert get_task(str(path)) == get_task("antmaze-large-diverse?goal=7,1")
    assert get_task(f"{path}?") == get_task(str(path))
    for text, message in (
        ("task: hopper-medium\nscore_max: 3\n", "sets task and score_max; beside a task it may set start and goal"),
        ("task: antmaze-umaze\ngoal: 7\n", r"sets goal to 7, expected a cell, \[row, column\]"),
        ("task: antmaze-umase\n", "there is no task 'antmaze-umase'; did you mean antmaze-umaze"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            get_task(str(path))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "antmaze-umaze?goal=0,0",
            r"goal is \(0, 0\), a wall or outside .*expected row,column of a free cell; `dds tasks",
        ),
        ("antmaze-umaze?start=9,9", r"start is \(9, 9\), a wall or outside"),
        ("antmaze-umaze?start=3,1", r"start and goal of 'antmaze-umaze' are both \(3, 1\), expected two cells"),
        ("antmaze-umaze?gaol=1,3", r"'gaol=1,3' follows the \?.*, expected goal=ROW,COLUMN, start=ROW,COLUMN or both"),
        ("antmaze-umaze?goal=1", "'goal=1' follows"),
        ("antmaze-umaze?goal=1,3&goal=3,3", "'goal=3,3' follows"),
        ("hopper-medium?goal=1,1", "'hopper-medium' has no maze"),
    ],
)
def test_what_names_no_other_cell_is_refused(name, message):
    with pytest.raises(UserError, match=message):
        get_task(name)


@pytest.mark.parametrize("name", ["pointmaze-large-diverse?goal=5,6", "antmaze-large-diverse?goal=5,9"])
def test_rewards_of_the_data_are_those_of_the_new_goal(name):
    task = get_task(name)
    line = np.linspace(task.goal_xy() - (3.0, 0.0), task.goal_xy(), 31)  # (31, 2) up to the mean of the goals
    states = np.zeros((31, task.observation_dim))
    states[:, :2] = line
    last = np.arange(30) == 29
    fields = {"actions": np.zeros((30, task.action_dim)), "terminations": last & False, "truncations": last}
    walk = {"observations": states, "rewards": np.ones(30), **fields}
    data = relabel_to_goal(Trajectories.from_episodes("walks", [walk] * 200), task, drawn=task.goal_noise > 0)
    assert set(data.rewards.tolist()) <= {0.0, 1.0}
    reached = data.terminations.sum() / 200
    ends = data.observations[data.observation_offsets[1:] - 1][data.terminations[data.step_offsets[1:] - 1]]
    away = np.linalg.norm(ends[:, :2] - task.goal_xy(), axis=1)
    if task.goal_noise:  # every episode has its own goal, as in the evaluation
        assert 0.5 < reached < 0.95
        assert away.std() > 0.1
    else:
        assert reached == 1.0
        assert away.max() <= task.goal_radius


def test_data_that_never_reach_the_goal_say_so(tmp_path):
    last = np.arange(3) == 2
    flags = {"terminations": last & False, "truncations": last}
    states = np.tile([*get_task("pointmaze-umaze-play").start_xy(), 0, 0], (4, 1))
    fields = {"observations": states, "actions": np.zeros((3, 2)), "rewards": np.ones(3), **flags}
    folder = Trajectories.from_episodes("still", [fields]).save(tmp_path / "still")
    with pytest.warns(UserWarning, match=r"no episode reaches the goal of pointmaze-umaze-play\?goal=1,3"):
        data = load_trajectories(f"arrays:{folder}", "pointmaze-umaze-play?goal=1,3")
    assert data.rewards.sum() == 0
