from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datamodules.sources.goal import cut_at_arrivals, relabel_to_goal
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.tasks import get_task

TASK = get_task("pointmaze-large-diverse")


def _walk(places: str, *, terminated: bool = False) -> dict[str, Any]:
    """An episode that is on the goal where `places` says I and off it where it says O; column 2 counts the "
    "recorded states."""
    states = np.zeros((len(places), 4))
    states[:, 0] = [TASK.goal_xy()[0] - (0.44 if place == "I" else 0.46) for place in places]
    states[:, 1] = TASK.goal_xy()[1]
    states[:, 2] = np.arange(len(places))
    steps = len(places) - 1
    end = np.arange(steps) == steps - 1
    return {
        "observations": states,
        "actions": np.arange(steps)[:, None] / np.array([[10.0, -10.0]]),
        "rewards": np.full(steps, 0.5),  # of some other goal
        "terminations": end & terminated,
        "truncations": end & (not terminated),
    }


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ("OOOO", [(0, 3, False)]),  # never there
        ("OOI", [(0, 2, True)]),  # ends on arrival
        ("OOIIOOO", [(0, 2, True), (4, 6, False)]),  # stays a while, leaves, ends elsewhere
        ("OIOI", [(0, 1, True), (2, 3, True)]),  # leaves and comes back
        ("OIIII", [(0, 1, True)]),  # stays for ever
        ("IIOO", [(2, 3, False)]),  # starts on it
        ("OOIO", [(0, 2, True)]),  # one last state outside holds no step
        ("OIIOOIOO", [(0, 1, True), (3, 5, True), (6, 7, False)]),
    ],
)
def test_episodes_are_cut_where_the_goal_is_reached(places: str, expected: list[tuple[int, int, bool]]) -> None:
    data = relabel_to_goal(Trajectories.from_episodes("walk", [_walk(places)]), TASK)
    found = []
    for e in range(data.num_episodes):
        episode = data.episode(e)
        states = episode["observations"][:, 2].astype(int)
        np.testing.assert_array_equal(np.diff(states), 1)
        np.testing.assert_allclose(episode["actions"][:, 0], states[:-1] / 10, rtol=1e-6)
        reached = bool(episode["terminations"][-1])
        assert bool(episode["truncations"][-1]) is not reached
        np.testing.assert_array_equal(episode["rewards"], (np.arange(len(states) - 1) == len(states) - 2) & reached)
        found.append((states[0], states[-1], reached))
    assert found == expected


def test_the_end_of_another_goal_is_no_end_for_this_one() -> None:
    data = relabel_to_goal(Trajectories.from_episodes("walk", [_walk("OOO", terminated=True)]), TASK)
    assert not data.terminations.any()
    np.testing.assert_array_equal(data.truncations, [False, True])


def test_relabelling_twice_changes_nothing() -> None:
    data = Trajectories.from_episodes("walk", [_walk("OOIIOOIOO"), _walk("OOOO")])
    once = relabel_to_goal(data, TASK)
    assert relabel_to_goal(once, TASK).fingerprint() == once.fingerprint()


def test_nothing_but_goal_is_an_error() -> None:
    with pytest.raises(DataError, match="every recorded state lies on the goal"):
        relabel_to_goal(Trajectories.from_episodes("walk", [_walk("IIII")]), TASK)


def _paid(places: str) -> dict[str, Any]:
    """The same walk, rewarded by the recording for every state on its goal."""
    paid = np.array([place == "I" for place in places[1:]], float)
    return {**_walk(places), "rewards": paid}


@pytest.mark.parametrize("places", ["OOOO", "OOI", "OOIIOOO", "OIOI", "OIIII", "OOIO", "OIIOOIOO"])
def test_recorded_arrivals_cut_as_the_goal_itself_does(places: str) -> None:
    data = Trajectories.from_episodes("walk", [_paid("OOIO"), _paid(places)])
    by_reward, by_place = cut_at_arrivals(data, TASK), relabel_to_goal(data, TASK)
    assert by_reward.fingerprint() == by_place.fingerprint()
    assert cut_at_arrivals(by_reward, TASK).fingerprint() == by_reward.fingerprint()


def test_rewards_that_do_not_say_where_the_goal_is_are_refused() -> None:
    data = Trajectories.from_episodes("walk", [_walk("OOI")])
    with pytest.raises(DataError, match=r"'walk', rewards: got 0.5, expected 0 or 1 \(on the goal\) for task"):
        cut_at_arrivals(data, TASK)
