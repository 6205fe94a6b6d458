"""How a policy strings skills together, and what it thinks of every cell."""

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.interpret.draw.stitching import best_episodes, draw_timeline, plot_stitching, runs_of
from dds_lightning.interpret.draw.values import plot_policy_map, plot_value_map, value_and_codes, value_table
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.tasks import get_task
from tests.interpret.tiny import tiny_agent

TASK = get_task("pointmaze-umaze-diverse")
HOPPER = get_task("hopper-medium")


def result(task, successes=(True, False, True), lengths=(40, 20, 30)):
    """Episodes of one actor that walk straight on; code 0 for ten steps, then code 2."""
    rows, paths = [], {}
    for episode, (success, length) in enumerate(zip(successes, lengths, strict=True)):
        line = (
            np.linspace(task.start_xy(), task.goal_xy(), length + 1)
            if task.maze_map
            else np.full((length + 1, 2), np.nan)
        )
        codes = np.where(np.arange(length) < 10, 0, 2).astype(np.int16)
        paths["policy", episode] = RolloutPath(line.astype(np.float32), codes)
        row = {"actor": "policy", "label": "policy", "episode": episode, "success": success, "length": length}
        rows.append({**row, "score": float(length), "final_x": 0.0, "final_y": 0.0, "final_code": 2})
    table = pd.DataFrame(rows)
    if not task.measures_success:
        table["success"] = pd.array([None] * len(table), dtype="boolean")
    return RolloutResult(task.name, table, paths)


def test_pieces_of_one_code_are_found():
    assert runs_of(np.array([3, 3, 1, 1, 1, 3])) == [(0, 2, 3), (2, 3, 1), (5, 1, 3)]
    assert runs_of(np.array([7])) == [(0, 1, 7)]


def test_successes_come_first_the_shortest_in_front_and_runners_by_score():
    assert best_episodes(result(TASK), "policy", 5) == [2, 0]
    assert best_episodes(result(TASK, successes=(False, False, False)), "policy", 1) == [0]
    assert best_episodes(result(HOPPER), "policy", 2) == [0, 2]
    with pytest.raises(UserError, match="no paths of 'nobody'"):
        best_episodes(result(TASK), "nobody", 1)


def test_a_timeline_has_every_piece_in_its_colour_with_its_number():
    ax = Figure().add_subplot()
    draw_timeline(ax, [np.array([0] * 10 + [5] * 20), np.array([5, -1, -1])], ["a", "b"])
    bars = [(bar.get_x(), bar.get_width(), bar.get_facecolor()) for bar in ax.patches]
    assert bars[:2] == [(0, 10, to_rgba(skill_colour(0))), (10, 20, to_rgba(skill_colour(5)))]
    assert [bar[:2] for bar in bars[2:]] == [(0, 1), (1, 2)]
    assert [(text.get_text(), text.get_position()) for text in ax.texts] == [
        ("0", (5, 0)),
        ("5", (20, 0)),
        ("5", (0.5, 1)),
    ]
    assert ax.get_ylim() == (1.5, -0.5)  # the first on top


def test_stitching_shows_the_way_of_two_episodes_and_the_timeline_of_all():
    figure = plot_stitching(TASK, result(TASK), "policy")
    *ways, timeline = figure.axes
    assert [ax.get_title() for ax in ways] == ["episode 2: 30 steps", "episode 0: 40 steps"]
    lines = [c for c in ways[0].collections if isinstance(c, LineCollection)]
    assert tuple(lines[0].get_colors()[0]) == to_rgba(skill_colour(0))
    assert [label.get_text() for label in timeline.get_yticklabels()] == ["episode 2\nsucceeds", "episode 0\nsucceeds"]
    assert sum(bar.get_width() for bar in timeline.patches) == 70


def test_a_runner_has_a_timeline_alone_with_its_scores():
    (timeline,) = plot_stitching(HOPPER, result(HOPPER), "policy", episodes=2).axes
    assert [label.get_text() for label in timeline.get_yticklabels()] == ["episode 0\nscore 40", "episode 2\nscore 30"]


@pytest.fixture(scope="module")
def agent():
    return tiny_agent(TASK)


def test_every_free_cell_has_a_value_a_code_and_where_it_leads(agent):
    table = value_table(TASK, agent, steps=8)
    assert list(zip(table["row"], table["column"], strict=True)) == list(TASK.free_cells())
    np.testing.assert_allclose(table[["x", "y"]], TASK.cell_to_xy(list(TASK.free_cells())))
    value, codes = value_and_codes(agent.policy)
    seen = np.zeros((len(table), 4), np.float32)
    seen[:, :2] = table[["x", "y"]]
    np.testing.assert_allclose(table["value"], value(seen))
    np.testing.assert_array_equal(table["code"], codes(seen))
    assert table["probability"].between(1 / 3, 1).all()
    assert (np.hypot(table["dx"], table["dy"]) > 0).any()


def test_no_value_is_drawn_beyond_what_rewards_and_discounts_allow():
    policy = tiny_agent(TASK).policy
    rows = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    free = value_and_codes(policy)[0](rows)  # nothing is known about the rewards
    middle = float(np.median(free))
    policy.value_range.copy_(torch.tensor([middle - 0.01, middle]))
    np.testing.assert_array_equal(value_and_codes(policy)[0](rows), np.clip(free, *policy.value_range.numpy()))
    assert (free > middle).any()


def test_arrows_point_where_the_code_led_from_that_cell():
    arrows = np.zeros((len(TASK.free_cells()), 2))
    arrows[1] = 0.0, 0.5
    ax = plot_value_map(TASK, lambda o: o[:, 0], lambda o: np.zeros(len(o), int), arrows=arrows).axes[0]
    drawn = [text for text in ax.texts if text.arrow_patch is not None]
    assert len(drawn) == 1  # from the others it leads nowhere
    x, y = TASK.cell_to_xy(TASK.free_cells()[1])
    np.testing.assert_allclose(drawn[0].xy, (x, y + 0.48))
    assert "from there" in ax.get_title()


def test_a_map_of_an_agent_has_a_number_in_every_cell(agent):
    figure = plot_policy_map(TASK, agent, steps=4)
    numbers = [text for text in figure.axes[0].texts if text.get_text()]
    assert len(numbers) == len(TASK.free_cells())
    with pytest.raises(UserError, match="no policy"):
        value_table(TASK, type(agent)(agent.skill, None, "random"))
