"""Tables per code, against paths whose numbers are known."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.collections import QuadMesh

from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.charts import plot_matrix, plot_transitions, plot_where
from dds_lightning.interpret.measure.statistics import (
    CodedSegments,
    code_distances,
    code_segments,
    decoder_diversity,
    nearest_codes,
    segment_effects,
    skill_table,
    telling_dimensions,
    transition_matrix,
)
from dds_lightning.tasks import get_task
from tests.interpret.tiny import recorded, tiny_agent, tiny_skill

MAZE = get_task("pointmaze-umaze-diverse")
HOPPER = get_task("hopper-medium")
H = 4


def coded(task, observations, codes, actions=None, rewards=None):
    """One episode of segments of H steps with given codes, as if a model had encoded them."""
    steps = len(observations) - 1
    episode = {
        "observations": observations,
        "actions": np.zeros((steps, task.action_dim)) if actions is None else actions,
        "rewards": np.zeros(steps) if rewards is None else rewards,
        "terminations": np.zeros(steps, bool),
        "truncations": np.arange(steps) == steps - 1,
    }
    data = Trajectories.from_episodes("by hand", [episode])
    made = code_segments(tiny_skill(task, num_skills=3, horizon=H), data)
    assert len(made.codes) == len(codes)
    return replace(made, relabelled=replace(made.relabelled, codes=torch.tensor(codes)))


def path(*moves):
    """Observations of a point that makes moves (dx, dy), each in H equal steps."""
    steps = np.repeat(np.array(moves, float) / H, H, axis=0)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([places, np.zeros_like(places)], axis=1).astype(np.float32)


def test_movement_of_a_point_is_measured_in_metres_and_seconds():
    effects = segment_effects(MAZE, coded(MAZE, path((0.4, 0.0), (0.0, -0.3)), [0, 1]))
    np.testing.assert_allclose(effects[["dx", "dy", "distance"]], [[0.4, 0, 0.4], [0, -0.3, 0.3]], atol=1e-6)
    seconds = H * MAZE.step_seconds
    np.testing.assert_allclose(effects["speed"], [0.4 / seconds, 0.3 / seconds], rtol=1e-5)
    np.testing.assert_allclose(effects["turn"], [0, 0], atol=1e-4)


def test_a_left_turn_is_positive_and_a_body_that_stands_has_none():
    half = path((0.2, 0.0), (0.0, 0.2), (0.0, 0.0))[::2]  # two steps right, two up, then still for two
    corner = np.concatenate([half, half[-1:], half[-1:]])  # and for two more
    effects = segment_effects(MAZE, coded(MAZE, corner.astype(np.float32), [0, 1]))
    assert effects["turn"][0] == pytest.approx(90.0, abs=1e-3)
    assert np.isnan(effects["turn"][1])


def test_an_ant_that_faces_y_and_moves_along_y_moves_ahead():
    ant = get_task("antmaze-umaze")
    seen = np.zeros((H + 1, 29), np.float32)
    seen[:, 1] = 0.1 * np.arange(H + 1)
    seen[:, 3] = seen[:, 6] = np.sqrt(0.5)  # a quarter turn to the left
    effects = segment_effects(ant, coded(ant, seen, [0])).iloc[0]
    np.testing.assert_allclose(effects[["dx", "dy", "ahead", "left"]].astype(float), [0, 0.4, 0.4, 0], atol=1e-6)


def test_a_runner_moves_by_its_velocity_and_turns_by_its_pitch():
    seen = np.zeros((H + 1, 11), np.float32)
    seen[:, 5] = 2.0  # x velocity
    seen[:, 0] = 1.0 + 0.01 * np.arange(H + 1)
    seen[:, 1] = np.radians(np.arange(H + 1))
    effects = segment_effects(HOPPER, coded(HOPPER, seen, [0])).iloc[0]
    assert effects["dx"] == pytest.approx(2.0 * H * 0.008)
    assert effects["speed"] == pytest.approx(2.0)
    assert effects["dz"] == pytest.approx(0.04, abs=1e-6)
    assert effects["turn"] == pytest.approx(H, abs=1e-4)


def test_actions_are_told_in_shares_of_their_box():
    actions = np.zeros((H, 2))
    actions[:, 0] = (1.0, -1.0, 1.0, -1.0)
    effects = segment_effects(MAZE, coded(MAZE, path((0.1, 0)), [0], actions)).iloc[0]
    assert (effects["action"], effects["change"], effects["bound"]) == (0.5, 1.0, 0.5)


def test_a_row_of_the_table_is_the_mean_of_the_codes_segments():
    rewards = np.repeat([1.0, 0.0, 3.0], H)
    segments = coded(MAZE, path((0.4, 0), (0, 0.3), (0.2, 0)), [2, 0, 2], rewards=rewards)
    agent = tiny_agent(MAZE, horizon=H)
    table = skill_table(MAZE, segments, agent.policy)
    assert table["code"].tolist() == [0, 1, 2]
    assert table["segments"].tolist() == [1, 0, 2]
    np.testing.assert_allclose(table["share"], [1 / 3, 0, 2 / 3])
    assert table["reward"][2] == pytest.approx(H * 2.0)  # undiscounted
    assert table["dx"][2] == pytest.approx(0.3, abs=1e-6)
    assert table.loc[1, ["dx", "reward", "value"]].isna().all()
    with torch.no_grad():
        values = agent.policy.v(torch.from_numpy(segments.observations))
    assert table["value"][0] == pytest.approx(float(values[1]), rel=1e-5)
    assert table["chosen"].sum() == pytest.approx(1.0)


def test_of_much_data_some_episodes_are_encoded():
    data = recorded(MAZE, 90, episode_steps=15)
    skill = tiny_skill(MAZE)
    everything, some = code_segments(skill, data), code_segments(skill, data, segments=6)
    assert len(everything.codes) == 18
    assert len(some.codes) == 6
    assert (everything.lengths == 5).all()
    assert everything.share.sum() == pytest.approx(1.0)


def test_a_code_is_followed_by_the_segment_that_begins_where_it_ends():
    segments = coded(MAZE, path(*[(0.1, 0)] * 6), [0, 0, 1, 0, 1, 1])
    matrix = transition_matrix(segments)
    np.testing.assert_allclose(matrix[0], [1 / 3, 2 / 3, 0])
    np.testing.assert_allclose(matrix[1], [1 / 2, 1 / 2, 0])
    assert np.isnan(matrix[2]).all()
    cut = torch.tensor([0, 0, 0, 1, 1, 1])  # a new episode: nothing follows over its start
    segments = replace(segments, relabelled=replace(segments.relabelled, episodes=cut))
    np.testing.assert_allclose(transition_matrix(segments)[:2], [[1 / 3, 2 / 3, 0], [0, 1, 0]])


def test_the_nearest_code_is_another_one():
    skill = tiny_skill(MAZE)
    skill.bottleneck.set_vectors(torch.arange(3), torch.tensor([[0.0, 0, 0, 0], [3, 4, 0, 0], [3, 4, 1, 0]]))
    distances = code_distances(skill)
    np.testing.assert_allclose(distances[0], [0, 5, np.sqrt(26)])
    assert nearest_codes(distances).tolist() == [1, 2, 1]


def test_without_noise_a_decoder_has_no_diversity_and_with_more_it_has_more():
    skill, states = tiny_skill(MAZE, clip_actions=True), np.zeros((3, 4), np.float32)
    quiet, normal = (decoder_diversity(skill, states, 8, scale) for scale in (0.0, 1.0))
    np.testing.assert_allclose(quiet["spread"], 0.0, atol=1e-6)
    assert (normal["spread"] > 0.01).all()
    assert (normal["apart"] > 0).all()


def test_the_telling_dimension_is_the_one_in_which_codes_differ():
    rng = np.random.default_rng(0)
    codes = np.repeat([0, 1], 50)
    seen = rng.normal(size=(100, 3))
    seen[:, 1] += 5.0 * codes
    seen[:, 2] = 7.0
    assert telling_dimensions(seen, codes, 2)[0] == 1
    assert telling_dimensions(seen, codes, 3)[2] == 2  # what never changes tells nothing


@pytest.mark.parametrize("name", ["pointmaze-umaze-diverse", "antmaze-umaze"])
def test_where_a_code_is_used_lies_in_its_cells_whichever_way_y_grows(name):
    task = get_task(name)
    seen = np.zeros((24 * H + 1, task.observation_dim), np.float32)
    first, second = task.cell_to_xy((1, 1)), task.cell_to_xy((3, 1))
    seen[: 12 * H, :2], seen[12 * H :, :2] = first, second
    segments = coded(task, seen, [0] * 12 + [2] * 12)
    figure = plot_where(task, segments)
    panels = figure.axes[:2]  # code 1 has no segment and no panel
    for ax, place in zip(panels, (first, second), strict=True):
        (mesh,) = [c for c in ax.collections if isinstance(c, QuadMesh)]
        corners = mesh.get_coordinates()
        shares = np.ma.filled(mesh.get_array(), 0.0).reshape(corners.shape[0] - 1, corners.shape[1] - 1)
        ((i, j),) = np.argwhere(shares == 100)
        middle = (corners[i, j] + corners[i + 1, j + 1]) / 2
        np.testing.assert_allclose(middle, place, atol=1e-6)
    assert [ax.texts[1].get_text() for ax in panels] == ["50% of the data"] * 2


def test_without_a_maze_states_are_shown_along_the_telling_dimensions():
    seen = np.zeros((8 * H + 1, 11), np.float32)
    seen[4 * H :, 0] = 1.0
    segments = coded(HOPPER, seen + np.linspace(0, 1e-3, len(seen))[:, None].astype(np.float32), [0] * 4 + [1] * 4)
    figure = plot_where(HOPPER, segments)
    assert figure.get_supxlabel() == "z (m)"
    own = [line for line in figure.axes[0].lines if line.get_color() != "#d9dde3"]
    assert len(own[0].get_xdata()) == 4


def test_a_matrix_has_its_numbers_in_per_cent_and_leaves_small_ones_out():
    ax = plot_transitions(np.array([[0.75, 0.25], [0.999, 0.001]])).axes[0]
    assert [text.get_text() for text in ax.texts] == ["75", "25", "100"]
    assert ax.get_xlabel() == "code of the next segment"
    large = plot_matrix(np.eye(30), np.arange(30), "x", "y", "large").axes[0]
    assert not large.texts


def test_a_model_of_another_width_is_refused():
    with pytest.raises(UserError, match="observation_dim"):
        code_segments(tiny_skill(HOPPER), recorded(MAZE, 20))


def test_coded_segments_of_a_short_end_repeat_the_last_step():
    flags = {"terminations": np.arange(6) == 5, "truncations": np.zeros(6, bool)}
    episode = {
        "observations": path((0.4, 0), (0.4, 0))[:7],
        "actions": np.zeros((6, 2)),
        "rewards": np.ones(6),
        **flags,
    }
    made = code_segments(tiny_skill(MAZE, horizon=H), Trajectories.from_episodes("short", [episode]))
    assert isinstance(made, CodedSegments)
    assert made.lengths.tolist() == [4, 2]
    steps, rows = made.steps()
    assert steps[1].tolist() == [4, 5, 5, 5]
    assert rows[1].tolist() == [4, 5, 6, 6, 6]
    effects: pd.DataFrame = segment_effects(MAZE, made)
    assert effects["dx"].tolist() == pytest.approx([0.4, 0.2], abs=1e-6)
    assert effects["reward"].tolist() == [4, 2]
