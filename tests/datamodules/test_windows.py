from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from datamodules.trajectories import DataError, Trajectories

Make = Callable[..., dict[str, Any]]


@pytest.fixture
def mixed(make_episode: Make) -> Trajectories:
    """Lengths 5 (timed out), 3 (terminated), 4 (terminated), 2 (timed out)."""
    episodes = [make_episode(n, e, terminated=e in (1, 2)) for e, n in enumerate((5, 3, 4, 2))]
    return Trajectories.from_episodes("mixed", episodes)


@pytest.mark.filterwarnings("ignore:.*shorter than horizon")
@pytest.mark.parametrize("horizon", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("stride", [1, 2, 3, 5])
@pytest.mark.parametrize("tail", ["full", "terminated"])
def test_windows_are_those_counted_by_hand(mixed: Trajectories, horizon: int, stride: int, tail: Any) -> None:
    expected = []
    for e, length in enumerate((5, 3, 4, 2)):
        for t in range(0, length, stride):
            h = min(horizon, length - t)
            if h == horizon or (tail == "terminated" and e in (1, 2)):
                expected.append((mixed.step_offsets[e] + t, mixed.observation_offsets[e] + t, h, e))
    found = mixed.windows(horizon, stride, tail)
    assert list(zip(found.starts, found.observation_starts, found.lengths, found.episodes, strict=True)) == expected
    assert len(found) == len(expected)


@pytest.mark.filterwarnings("ignore:.*shorter than horizon")
def test_a_window_never_crosses_an_episode(mixed: Trajectories) -> None:
    found = mixed.windows(3, tail="terminated")
    for start, row, length in zip(found.starts, found.observation_starts, found.lengths, strict=True):
        seen = mixed.observations[row : row + length + 1]
        assert len(set(seen[:, 0])) == 1  # column 0 is the episode
        np.testing.assert_array_equal(np.diff(seen[:, 1]), 1)  # column 1 the time
        np.testing.assert_allclose(mixed.actions[start : start + length, 0] * 100, seen[:-1, 1], rtol=1e-6)


@pytest.mark.filterwarnings("ignore:.*shorter than horizon")
def test_short_windows_end_in_a_termination_never_in_a_time_out(mixed: Trajectories) -> None:
    found = mixed.windows(4, tail="terminated")
    short = found.lengths < 4
    last = found.starts[short] + found.lengths[short] - 1
    assert mixed.terminations[last].all()
    assert not mixed.truncations[last].any()
    np.testing.assert_array_equal(found.lengths, [4, 4, 3, 2, 1, 4, 3, 2, 1])
    assert (mixed.windows(4).lengths == 4).all()


def test_short_episodes_are_counted_in_one_warning(mixed: Trajectories) -> None:
    with pytest.warns(UserWarning, match=r"2 of 4 episodes are shorter than horizon 4 .* \(5 of 14 steps\)") as seen:
        mixed.windows(4)
    assert len(seen) == 1


def test_a_horizon_longer_than_every_episode_is_an_error(mixed: Trajectories) -> None:
    with pytest.raises(DataError, match=r"horizon 6 is longer than every one of the 4 .* longest has 5 steps"):
        mixed.windows(6)


@pytest.mark.parametrize(("horizon", "stride"), [(0, 1), (1, 0)])
def test_settings_out_of_range_are_refused(mixed: Trajectories, horizon: int, stride: int) -> None:
    with pytest.raises(DataError, match="expected at least 1"):
        mixed.windows(horizon, stride)
    with pytest.raises(DataError, match="tail: got 'half'"):
        mixed.windows(1, tail="half")  # type: ignore[arg-type]
