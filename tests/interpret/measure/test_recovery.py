"""Codes that mean something are told from behaviour; codes that mean nothing are not."""

import numpy as np
import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.charts import plot_comparison, plot_effects, plot_recovery, plot_round_trip
from dds_lightning.interpret.measure.comparison import cluster_skills, compare_recovery, decoding_error
from dds_lightning.interpret.measure.information import mutual_information
from dds_lightning.interpret.measure.recovery import (
    code_recovery,
    displacements,
    encode_replays,
    round_trip,
    told_by_state,
)
from dds_lightning.interpret.measure.replay import Replays, simulator
from dds_lightning.interpret.measure.states import rest_states
from dds_lightning.tasks import get_task
from tests.interpret.tiny import Compass, Deaf, recorded, tiny_skill

MAZE = get_task("pointmaze-umaze-diverse")


@pytest.fixture(scope="module")
def env():
    with simulator(MAZE) as env:
        yield env


@pytest.fixture(scope="module")
def states():
    return rest_states(MAZE, [(1, 2)] * 6 + [(3, 2)] * 6)


def test_clear_skills_are_all_recovered_and_tell_where_they_lead(env, states):
    found, made = code_recovery(MAZE, Compass(), states, env=env)
    assert found.accuracy == 1.0
    assert found.chance == 0.25
    assert found.error == 0.0
    np.testing.assert_array_equal(found.confusion, np.eye(4))
    assert found.most == 2.0
    assert 1.3 < found.information <= 2.0
    assert 1.3 < found.information_in_state <= 2.0
    assert (found.states, found.steps, len(made.codes)) == (12, 6, 48)
    assert found.effects.shape == (4, 12, 2)
    np.testing.assert_allclose(found.effects.mean(axis=0), 0.0, atol=1e-12)  # less the mean of all from a state
    assert (np.diag(found.effects.mean(axis=1) @ Compass.ways.numpy().T) > 0).all()
    ax = plot_effects(MAZE, found).axes[0]
    assert [text.get_text() for text in ax.texts] == ["0", "1", "2", "3"]
    np.testing.assert_allclose(ax.texts[2].xy, 100 * found.effects[2].mean(axis=0))
    assert f"{found.information_in_state:.1f} bits of 2" in ax.get_title()
    title = plot_recovery(found).axes[0].get_title()
    assert title == "From any state: recovered in 100% (chance 25%)"


def test_skills_that_do_the_same_are_at_chance_and_tell_nothing(env, states):
    found, _ = code_recovery(MAZE, Deaf(), states, env=env)
    assert found.accuracy == 0.25
    np.testing.assert_array_equal(found.confusion, [[1, 0, 0, 0]] * 4)
    assert found.information == pytest.approx(0.0, abs=0.05)
    assert found.information_in_state == pytest.approx(0.0, abs=0.1)


def test_codes_out_of_use_are_left_out_and_chance_is_that_of_the_rest(env, states):
    found, _ = code_recovery(MAZE, Deaf(), states, codes=np.array([1, 3]), env=env)
    assert found.codes.tolist() == [1, 3]
    assert (found.accuracy, found.chance, found.most) == (0.0, 0.5, 1.0)
    np.testing.assert_array_equal(found.confusion, [[0, 0], [0, 0]])  # all are taken for code 0, which is not there


@pytest.mark.parametrize(("decides", "share"), [(1.0, 1.0), (0.0, 0.25)])
def test_how_much_of_its_code_the_first_state_of_a_segment_tells(decides, share):
    rng = np.random.default_rng(0)
    codes, episodes = rng.integers(0, 4, 2000), np.arange(2000) % 10
    states = np.stack([100 * (decides * codes + 0.01 * rng.normal(size=2000)), rng.normal(size=2000)], axis=1)
    assert told_by_state(states, codes, episodes) == pytest.approx(share, abs=0.05)


def test_states_of_a_segments_own_episode_tell_nothing():
    """Segments overlap: the next one begins a step later and has nearly always the same code."""
    states, codes = np.arange(12.0)[:, None], np.repeat([0, 1], 6)
    assert told_by_state(states, codes, np.repeat([0, 1], 6)) == 0.0
    assert np.isnan(told_by_state(states, codes, np.zeros(12)))


def test_a_replay_that_ended_early_is_encoded_as_short():
    seen: list[list[int] | None] = []

    class Watching(Compass):
        def encode(self, observations, actions, lengths=None):
            seen.append(None if lengths is None else lengths.tolist())
            assert torch.isfinite(observations).all()
            assert torch.isfinite(actions).all()
            return super().encode(observations, actions, lengths)

    observations = np.zeros((2, 7, 4), np.float32)
    observations[:, :, 1] = -np.arange(7)
    actions, alive = np.zeros((2, 6, 2), np.float32), np.ones((2, 6), bool)
    alive[1, 3:], observations[1, 4:], actions[1, 3:] = False, np.nan, np.nan
    made = Replays(np.array([3, 3]), np.zeros(2, int), observations, actions, actions[..., 0], observations, alive)
    assert encode_replays(Watching(), made).tolist() == [3, 3]
    assert seen == [[6, 3]]
    np.testing.assert_array_equal(displacements(observations, made.lengths)[:, 1], [-6, -3])


def test_information_is_measured_in_bits_and_chance_is_taken_off():
    rng = np.random.default_rng(0)
    codes = np.repeat(np.arange(4), 500)
    corners = np.array([[0, 0], [0, 9], [9, 0], [9, 9]])[codes]
    assert mutual_information(codes, corners + 0.1 * rng.normal(size=(2000, 2)), bins=4) == pytest.approx(2.0, abs=0.02)
    assert mutual_information(codes, rng.normal(size=(2000, 2))) < 0.02
    assert mutual_information(codes[:40:10], rng.normal(size=(4, 2))) == pytest.approx(0.0, abs=0.3)  # few samples
    assert mutual_information(codes // 2, codes) == pytest.approx(1.0, abs=0.01)  # one coordinate
    missing = np.where(rng.random((2000, 1)) < 0.1, np.nan, corners)
    assert mutual_information(codes, missing, bins=4) == pytest.approx(2.0, abs=0.02)


@pytest.fixture(scope="module")
def data():
    return recorded(MAZE, 60, episode_steps=30)


def test_a_clear_skill_is_found_again_and_another_one_is_not_taken_for_it(env, data):
    found = round_trip(MAZE, Compass(), data, segments=5, env=env)
    size = len(found.codes)
    assert size >= 2
    assert found.control < 0.8 < found.accuracy  # a moving point does not turn round at once
    assert found.chance == 1 / size
    np.testing.assert_allclose(found.by_code, np.diag(found.confusion))
    assert found.by_code.mean() == pytest.approx(found.accuracy)
    title = plot_round_trip(found).axes[0].get_title()
    assert f"chance {found.chance:.0%}, another code held {found.control:.0%}" in title


def test_where_the_state_alone_gives_the_code_away_the_control_says_so(env, data):
    class Fatal(Deaf):
        """The code is the half of the maze that the segment begins in."""

        def encode(self, observations, actions, lengths=None):
            return (observations[:, 0, 0] > data.observations[:, 0].mean()).long()

    found = round_trip(MAZE, Fatal(), data, segments=4, env=env)
    assert found.codes.tolist() == [0, 1]
    assert (found.accuracy, found.control) == (1.0, 1.0)


def test_a_code_of_too_few_segments_makes_no_round_trip(env, data):
    class Lonely(Deaf):
        def encode(self, observations, actions, lengths=None):
            return torch.zeros(len(observations), dtype=torch.int64)

    found = round_trip(MAZE, Lonely(), data, segments=4, env=env)
    assert found.codes.tolist() == [0]
    assert (found.accuracy, found.chance) == (1.0, 1.0)
    assert np.isnan(found.control)
    assert found.segments == 4


def test_continuous_skills_get_codes_by_the_nearest_centre(data):
    skill = tiny_skill(MAZE, bottleneck="gaussian")
    skills = cluster_skills(skill, data, 4)
    assert (skills.num_skills, skills.horizon, skills.centres.shape) == (4, 5, (4, 4))
    observations, actions = torch.randn(9, 5, 4), torch.zeros(9, 5, 2)
    codes = skills.encode(observations, actions)
    with torch.no_grad():
        means = skill.encode_segments(observations, actions).vectors
    np.testing.assert_array_equal(codes, torch.cdist(means, skills.centres).argmin(dim=1))
    stream = [torch.Generator().manual_seed(0) for _ in range(2)]
    with torch.no_grad():
        direct = skill.decode(observations[:, 0], skills.centres[codes], None, stream[0])
        torch.testing.assert_close(skills.decode(observations[:, 0], codes, None, stream[1]), direct)


def test_what_cannot_be_clustered_is_refused(data):
    with pytest.raises(UserError, match="already discrete"):
        cluster_skills(tiny_skill(MAZE), data, 4)
    with pytest.raises(UserError, match=r"clusters is 60, but the data have only \d+ segments"):
        cluster_skills(tiny_skill(MAZE, bottleneck="gaussian"), data, 60)


def test_seeds_of_both_kinds_are_compared_on_the_same_states(data):
    models = [("discrete", tiny_skill(MAZE, seed=seed)) for seed in (0, 1)]
    models.append(("continuous", tiny_skill(MAZE, bottleneck="gaussian")))
    told: list[str] = []
    table = compare_recovery(MAZE, data, models, states=4, report=told.append)
    assert told == ["discrete", "discrete", "continuous"]
    assert table[["model", "seed", "kind", "codes"]].to_numpy().tolist() == [
        ["discrete", 0, "discrete", 3],
        ["discrete", 1, "discrete", 3],
        ["continuous", 0, "continuous", 3],
    ]
    assert table["accuracy"].between(0, 1).all()
    assert (table["states"] == 4).all()
    figure = plot_comparison(table)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["discrete", "continuous"]
    dots = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    np.testing.assert_allclose(dots[0].get_xdata(), 100 * table["own_accuracy"][:2])
    assert len(figure.axes) == 4
    assert (table["decoded"] > 0).all()
    assert table["decoded_own"].notna().tolist() == [False, False, True]
    with pytest.raises(UserError, match="clusters is missing"):
        compare_recovery(MAZE, data, models[2:])


def test_the_decoding_error_is_that_of_the_actions_drawn_under_what_was_found(data):
    class Exact:
        """Decodes what the data did at x, of which the code says nothing."""

        horizon, num_skills, discrete, device = 5, 3, True, torch.device("cpu")

        def __init__(self, off):
            self.off = off
            self.hparams = {"observation_dim": 4, "action_dim": 2}
            self.known = {row.tobytes(): a for row, a in zip(data.observations[rows], data.actions, strict=True)}

        def eval(self):
            return self

        def encode(self, observations, actions):
            return torch.zeros(len(observations), dtype=torch.int64)

        def decode(self, observations, codes, noise_scale=None, generator=None):
            assert noise_scale == 1.0
            return torch.from_numpy(np.stack([self.known[row.tobytes()] for row in observations.numpy()])) + self.off

    steps = np.arange(data.num_steps)
    rows = steps + data.episode_of(steps)
    assert decoding_error(Exact(0.0), data) == 0.0
    assert decoding_error(Exact(0.3), data) == pytest.approx(0.3, rel=1e-5)


def test_a_continuous_model_is_decoded_under_its_own_vectors_or_under_centres(data):
    skill = tiny_skill(MAZE, bottleneck="gaussian", noise_scale=1.0)
    one, many = (decoding_error(cluster_skills(skill, data, k), data) for k in (1, 40))
    own = decoding_error(skill, data)
    assert 0 < own < 2
    assert abs(many - own) < abs(one - own) + 0.05
    assert decoding_error(skill, data) == own  # the same draws
