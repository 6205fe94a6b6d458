"""Everything that a data set can have wrong is refused, and the message says where and what."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from datamodules.trajectories import DataError, Trajectories

Make = Callable[..., dict[str, Any]]


def _put(key: str, index: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(episode: dict[str, Any]) -> None:
        episode[key] = np.array(episode[key], dtype=float if key != "truncations" else None)
        episode[key][index] = value

    return change


def _replace(key: str, make: Callable[[Any], Any]) -> Callable[[dict[str, Any]], None]:
    def change(episode: dict[str, Any]) -> None:
        episode[key] = make(episode[key])

    return change


FAULTS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "observation not a number": (
        _put("observations", (3, 1), np.nan),
        r"observations: got nan at step 3, column 1, expected finite",
    ),
    "actions of one number": (
        _replace("actions", lambda values: np.asarray(values)[:, 0] / 9),
        r"actions: got shape \(6,\), expected \(steps, 1\); stack one row per step, also where it is a single",
    ),
    "discrete actions": (
        _replace("actions", lambda values: np.arange(len(values))),
        r"actions: got shape \(\d,\), expected \(steps, 1\); whole numbers look like discrete actions, which are not",
    ),
    "infinite action": (_put("actions", (2, 0), -np.inf), r"actions: got -inf at step 2, column 0"),
    "reward too large for 32 bits": (
        _put("rewards", 4, 1e300),
        r"rewards: got 1e\+300 at step 4, expected",
    ),
    "action outside the box": (
        _put("actions", (1, 0), 1.25),
        r"actions: got 1.25 at step 1, column 0, expected -1 to 1",
    ),
    "observations too narrow": (
        _replace("observations", lambda a: a[:, :1]),
        r"observations: got shape \(7, 1\), expected \(steps, 2\)",
    ),
    "actions too wide": (
        _replace("actions", lambda a: np.zeros((6, 3))),
        r"actions: got shape \(6, 3\), expected \(steps, 1\)",
    ),
    "flat actions": (_replace("actions", lambda a: a[:, 0]), r"actions: got shape \(6,\), expected"),
    "two-dimensional rewards": (
        _replace("rewards", lambda a: a[:, None]),
        r"rewards: got shape \(6, 1\), expected \(steps,\)",
    ),
    "T observations": (
        _replace("observations", lambda a: a[:-1]),
        r"observations: got 6 rows, expected 7 \(T \+ 1\); the observation after the last step is missing",
    ),
    "too many observations": (
        _replace("observations", lambda a: np.concatenate([a, a])),
        r"observations: got 14 rows, expected 7",
    ),
    "an action too few": (_replace("actions", lambda a: a[:-1]), r"actions: got 5 rows, but rewards has 6"),
    "a flag too few": (
        _replace("terminations", lambda a: a[1:]),
        r"terminations: got 5 rows, but rewards has 6",
    ),
    "no end": (
        _replace("truncations", lambda a: a & False),
        r"never ends: terminations and truncations are both",
    ),
    "a flag inside": (
        _put("truncations", 2, True),
        r"truncations: got True at step 2, inside an episode of 6 steps",
    ),
    "flag of 2": (
        _replace("terminations", lambda a: a.astype(int) + 2),
        r"terminations: got 2, expected 0 or 1",
    ),
    "numbers as flags": (
        _replace("terminations", lambda a: a.astype(float)),
        r"terminations: got values of type float64, expected true and false",
    ),
    "text as rewards": (
        _replace("rewards", lambda a: ["x"] * 6),
        r"rewards: got values of type <U1, expected real numbers",
    ),
    "ragged observations": (
        _replace("observations", lambda a: [[1, 2], [3]]),
        r"observations: got values of type object, expected real numbers",
    ),
    "missing key": (
        lambda e: e.pop("rewards"),
        r"'rewards' is missing; expected observations, actions, rewards, terminations, truncations, got "
        r"observations, actions, terminations, truncations",
    ),
    "no steps": (lambda e: e.update({k: v[:0] for k, v in e.items()}), r"rewards: got 0 steps"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_refused_with_its_place_and_value(fault: str, make_episode: Make) -> None:
    change, message = FAULTS[fault]
    episodes = [make_episode(5), make_episode(6)]
    change(episodes[1])
    with pytest.raises(DataError, match=r"^data set 'spoilt', episode 1.*" + message):
        Trajectories.from_episodes("spoilt", episodes)


def test_an_empty_set_is_refused() -> None:
    with pytest.raises(DataError, match="data set 'nothing' is empty: it has no episodes"):
        Trajectories.from_episodes("nothing", [])


def test_bounds_of_another_width_and_an_episode_by_itself_are_refused(make_episode: Make) -> None:
    with pytest.raises(DataError, match=r"action_low has shape \(7,\), expected one number or \d of them"):
        Trajectories.from_episodes("x", [make_episode(5)], action_low=[-1.0] * 7)
    with pytest.raises(DataError, match=r"is one mapping, expected a list of them: give \[episode\]"):
        Trajectories.from_episodes("x", make_episode(5))  # type: ignore[arg-type]


def test_rounding_over_the_box_is_clipped_not_refused(make_episode: Make) -> None:
    episode = make_episode(5)
    episode["actions"][0] = 1.000005
    data = Trajectories.from_episodes("rounded", [episode])
    assert data.actions[0, 0] == 1.0


def test_the_box_may_differ_by_dimension(make_episode: Make) -> None:
    episode = make_episode(5)
    episode["actions"] = np.tile([1.5, 0.5], (5, 1))
    data = Trajectories.from_episodes("wide", [episode], action_low=[-2, -1], action_high=[2, 1])
    np.testing.assert_array_equal(data.action_high, [2, 1])
    episode["actions"][:, 1] = 1.5
    with pytest.raises(DataError, match=r"got 1\.5 at step 0, column 1, expected -1 to 1"):
        Trajectories.from_episodes("wide", [episode], action_low=[-2, -1], action_high=[2, 1])


def test_flags_of_0_and_1_are_flags(make_episode: Make) -> None:
    episode = make_episode(5, terminated=True)
    episode["terminations"] = episode["terminations"].astype(np.uint8)
    assert Trajectories.from_episodes("numbers", [episode]).terminations.dtype == bool


def test_the_first_widths_hold_for_all(make_episode: Make) -> None:
    other = make_episode(5)
    other["observations"] = np.zeros((6, 3))
    with pytest.raises(DataError, match=r"episode 1, observations: got shape \(6, 3\), expected \(steps, 2\)"):
        Trajectories.from_episodes("mixed", [make_episode(5), other])
