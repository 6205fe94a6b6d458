from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.sources import load_trajectories
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task

Make = Callable[..., dict[str, Any]]


@pytest.fixture
def three(make_episode: Make) -> Trajectories:
    lengths = (5, 3, 4)
    return Trajectories.from_episodes("three", [make_episode(n, e, terminated=e == 1) for e, n in enumerate(lengths)])


def test_layout_is_flat_with_one_more_observation_an_episode(three: Trajectories) -> None:
    assert (three.num_steps, three.num_episodes, three.observation_dim, three.action_dim) == (12, 3, 2, 1)
    np.testing.assert_array_equal(three.step_offsets, [0, 5, 8, 12])
    np.testing.assert_array_equal(three.observation_offsets, [0, 6, 10, 15])
    np.testing.assert_array_equal(three.observations[6:10], [[1, 0], [1, 1], [1, 2], [1, 3]])
    np.testing.assert_array_equal(three.terminations.nonzero()[0], [7])
    np.testing.assert_array_equal(three.truncations.nonzero()[0], [4, 11])
    np.testing.assert_array_equal(three.returns, [10, 3, 6])
    assert {array.dtype for array in (three.observations, three.actions, three.rewards)} == {np.dtype("float32")}


def test_an_episode_comes_back_as_it_went_in(three: Trajectories, make_episode: Make) -> None:
    for key, value in make_episode(4, 2).items():
        np.testing.assert_array_equal(three.episode(2)[key], np.asarray(value, np.float32))
    with pytest.raises(DataError, match="no episode 3, expected 0 to 2"):
        three.episode(3)


def test_every_step_knows_its_episode(three: Trajectories) -> None:
    np.testing.assert_array_equal(three.episode_of(np.arange(12)), [0] * 5 + [1] * 3 + [2] * 4)


def test_select_keeps_order_and_offsets(three: Trajectories) -> None:
    part = three.select([2, 0])
    np.testing.assert_array_equal(part.lengths, [4, 5])
    np.testing.assert_array_equal(part.episode(0)["observations"], three.episode(2)["observations"])
    np.testing.assert_array_equal(part.episode(1)["rewards"], three.episode(0)["rewards"])
    with pytest.raises(DataError, match="episode 7 was requested"):
        three.select([7])
    with pytest.raises(DataError, match="no episodes were selected"):
        three.select([])


def test_the_fingerprint_sees_every_array_but_not_the_name(three: Trajectories, make_episode: Make) -> None:
    episodes = [make_episode(n, e, terminated=e == 1) for e, n in enumerate((5, 3, 4))]
    assert Trajectories.from_episodes("other", episodes).fingerprint() == three.fingerprint()
    seen = {three.fingerprint()}
    for key, change in (("observations", 1e-3), ("actions", 1e-3), ("rewards", 1e-3)):
        changed = [dict(e) for e in episodes]
        changed[1][key] = changed[1][key] + change
        seen.add(Trajectories.from_episodes("three", changed).fingerprint())
    swapped = [make_episode(n, e, terminated=e == 0) for e, n in enumerate((5, 3, 4))]
    seen.add(Trajectories.from_episodes("three", swapped).fingerprint())
    seen.add(Trajectories.from_episodes("three", episodes, action_high=2.0).fingerprint())
    assert len(seen) == 6


def test_split_is_by_episode_by_seed_and_about_the_share_of_steps(make_episode: Make) -> None:
    data = Trajectories.from_episodes("many", [make_episode(10 + e, e) for e in range(40)])
    training, validation = data.split(0.2, seed=3)
    assert set(training) | set(validation) == set(range(40))
    assert not set(training) & set(validation)
    assert 0.2 <= data.lengths[validation].sum() / data.num_steps < 0.25
    np.testing.assert_array_equal(validation, data.split(0.2, seed=3)[1])
    assert not np.array_equal(validation, data.split(0.2, seed=4)[1])
    assert len(data.split(0.0, seed=3)[1]) == 0


def test_split_keeps_usable_episodes_on_both_sides(make_episode: Make) -> None:
    data = Trajectories.from_episodes("few", [make_episode(2), make_episode(30), make_episode(30)])
    for fraction in (0.01, 0.99):
        training, validation = data.split(fraction, seed=0, horizon=10)
        assert len(validation) == 1
        assert validation[0] != 0
        assert len(training) == 2
    with pytest.raises(DataError, match="1 of its episodes have 10 steps"):
        data.select([0, 1]).split(0.1, seed=0, horizon=10)
    with pytest.raises(DataError, match=r"validation_fraction: got 1\.5"):
        data.split(1.5, seed=0)


@pytest.mark.parametrize("mmap", [False, True])
def test_saved_and_loaded_is_the_same(three: Trajectories, tmp_path: Path, mmap: bool) -> None:
    folder = three.save(tmp_path / "sets" / "three")
    back = Trajectories.load(folder, mmap=mmap)
    assert back.name == "three"
    assert back.fingerprint() == three.fingerprint()
    assert isinstance(back.observations, np.memmap) is mmap
    assert [path.name for path in folder.parent.iterdir()] == ["three"]  # nothing temporary is left


def test_saving_over_something_must_be_asked_for(three: Trajectories, tmp_path: Path) -> None:
    folder = three.save(tmp_path / "three")
    with pytest.raises(UserError, match="exists already"):
        three.save(folder)
    three.select([0]).save(folder, overwrite=True)
    assert Trajectories.load(folder).num_episodes == 1
    assert [path.name for path in tmp_path.iterdir()] == ["three"]


def test_an_interrupted_save_leaves_nothing(
    three: Trajectories, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def stop(*args: object, **kwargs: object) -> None:
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(np, "save", stop)
    with pytest.raises(KeyboardInterrupt):
        three.save(tmp_path / "three")
    assert list(tmp_path.iterdir()) == []


def test_damaged_arrays_are_refused(three: Trajectories, tmp_path: Path) -> None:
    folder = three.save(tmp_path / "three")
    whole = (folder / "actions.npy").read_bytes()
    (folder / "actions.npy").write_bytes(whole[:-5])
    with pytest.raises(DataError, match=r"actions.npy is missing, truncated or damaged"):
        Trajectories.load(folder)
    (folder / "actions.npy").write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(DataError, match="do not match their fingerprint"):
        Trajectories.load(folder)
    (folder / "actions.npy").write_bytes(whole)
    np.save(folder / "lengths.npy", np.array([5, 3, 5]))
    with pytest.raises(DataError, match="lengths: they add up to 13, expected 12"):
        Trajectories.load(folder)
    (folder / "lengths.npy").unlink()
    with pytest.raises(DataError, match=r"lengths.npy is missing"):
        Trajectories.load(folder)
    with pytest.raises(DataError, match=r"trajectories.json is missing or damaged"):
        Trajectories.load(tmp_path)


def test_data_know_the_task_that_they_were_loaded_for(three: Trajectories, tmp_path: Path) -> None:
    task = get_task("pointmaze-umaze-play")
    assert three.task is None
    mark = three.fingerprint()
    known = three.for_task(task)
    assert known.task == task
    assert known.observations is three.observations
    assert "_fingerprint" in vars(known), "hashing again would read everything again"
    assert known.fingerprint() == mark
    assert known.select([2, 0]).task == task
    assert Trajectories.load(known.save(tmp_path / "set")).task is None


# ---------------------------------------------------------------- stored arrays are checked as every source


def _stored(three: Trajectories, folder: Path, **changes: Any) -> Path:
    """The set on disk with other arrays, under a fingerprint that fits them."""
    return replace(three, **changes).save(folder)


def _with(array: Any, index: Any, value: Any) -> Any:
    copy = array.copy()
    copy[index] = value
    return copy


IMPOSSIBLE: dict[str, tuple[Callable[[Trajectories], dict[str, Any]], str]] = {
    "NaN": (
        lambda t: {"observations": _with(t.observations, (7, 1), np.nan)},
        "observations: got nan at row 7, column 1",
    ),
    "infinity": (lambda t: {"rewards": _with(t.rewards, 3, np.inf)}, "rewards: got inf at row 3"),
    "outside": (lambda t: {"actions": _with(t.actions, (4, 0), 1e6)}, r"actions: got 1e\+06 at step 4, column 0"),
    "low above high": (
        lambda t: {"action_low": t.action_high, "action_high": t.action_low},
        "got 1 and -1 in column 0",
    ),
    "low is high": (lambda t: {"action_low": t.action_high}, "expected finite bounds, the lower one below"),
    "no bound": (lambda t: {"action_high": t.action_high * np.float32(np.inf)}, "got -1 and inf in column 0"),
    "two bounds": (lambda t: {"action_low": np.repeat(t.action_low, 2)}, "expected one bound a column"),
    "early end": (lambda t: {"terminations": _with(t.terminations, 2, True)}, "an end at step 2, inside an episode"),
    "no end": (lambda t: {"truncations": _with(t.truncations, 4, False)}, "episode 0: never ends"),
    "negative": (lambda t: {"lengths": np.array([5, -1, 8])}, "lengths: got shape"),
    "overflow": (lambda t: {"lengths": np.array([2**62, 2**62, 2**62])}, "lengths: got shape"),
    "a table of lengths": (lambda t: {"lengths": t.lengths[None]}, r"lengths: got shape \(1, 3\)"),
    "flat observations": (lambda t: {"observations": t.observations[:, 0]}, r"observations: got shape \(15,\)"),
    "no columns": (lambda t: {"observations": t.observations[:, :0]}, r"observations: got shape \(15, 0\)"),
    "rewards in columns": (lambda t: {"rewards": t.rewards[:, None]}, r"rewards: got shape \(12, 1\)"),
    "too few": (lambda t: {"actions": t.actions[:-1]}, r"actions: got shape \(11, 1\), expected \(12, width\)"),
    "flags of seven": (
        lambda t: {"terminations": np.full(12, 7, np.uint8).view(np.bool_)},
        "terminations: got a byte 7, expected 0 or 1",
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
@pytest.mark.parametrize("mmap", [False, True])
def test_impossible_arrays_are_refused_whatever_their_fingerprint(
    three: Trajectories, tmp_path: Path, case: str, mmap: bool
) -> None:
    change, message = IMPOSSIBLE[case]
    with pytest.raises(DataError, match=message) as told:
        Trajectories.load(_stored(three, tmp_path / "set", **change(three)), mmap=mmap)
    assert "data set 'three'" in str(told.value)


@pytest.mark.parametrize(("low", "high"), [(1.0, -1.0), (0.0, 0.0), (-np.inf, 1.0), (np.nan, 1.0)])
def test_bounds_of_no_box_are_refused(make_episode: Make, low: float, high: float) -> None:
    with pytest.raises(DataError, match=r"action_low and action_high: got .* expected finite bounds"):
        Trajectories.from_episodes("mine", [make_episode(4, 0)], action_low=low, action_high=high)


def test_arrays_must_fit_the_box_of_their_task(tmp_path: Path) -> None:
    task = get_task("pointmaze-umaze-play")
    start = np.zeros(task.observation_dim)
    start[:2] = task.start_xy()
    episode = {"observations": np.tile(start, (6, 1)), "actions": np.full((5, 2), 40.0), "rewards": np.zeros(5)}
    episode |= {"terminations": np.zeros(5, bool), "truncations": np.arange(5) == 4}
    wide = Trajectories.from_episodes("wide", [episode], action_low=-50.0, action_high=50.0)
    folder = wide.save(tmp_path / "wide")
    assert load_trajectories(f"arrays:{folder}").num_steps == 5
    with pytest.raises(DataError, match="data set 'wide', actions: got 40 at step 0, column 0, expected -1 to 1"):
        load_trajectories(f"arrays:{folder}", task)
    far = {**episode, "observations": episode["observations"] + 1000.0, "actions": np.zeros((5, 2))}
    folder = Trajectories.from_episodes("far", [far]).save(tmp_path / "far")
    with pytest.raises(DataError, match=r"data set 'far', observations: 100% of the positions lie outside"):
        load_trajectories(f"arrays:{folder}", task)


@pytest.mark.parametrize(
    "facts", ["[]", "{}", '{"name": "a", "format": 1}', '{"name": 1, "format": "x", "fingerprint": "f"}', "[" * 10**5]
)
def test_facts_of_no_data_set_are_refused(three: Trajectories, tmp_path: Path, facts: str) -> None:
    folder = three.save(tmp_path / "set")
    (folder / "trajectories.json").write_text(facts)
    with pytest.raises(UserError, match=r"trajectories\.json"):
        Trajectories.load(folder)


def test_a_name_reaches_nobody_as_more_than_a_name(three: Trajectories, tmp_path: Path) -> None:
    folder = replace(three, name="\x1b[2J<b>mine</b>").save(tmp_path / "set")
    assert Trajectories.load(folder).name == "2Jbmine/b"
