"""Files of real steps, recorded in the right physics and in wrong ones: the right ones fit, the others do not."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.physics.check import LIMIT, NOISY_LIMIT, replay_check
from datamodules.physics.states import FALLS, draw_steps
from datamodules.sources import d4rl_recording, minari
from datamodules.validation import DataError
from dds_lightning.cli import main
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task
from dds_lightning.tasks.bodies import state_layout
from tests.minari_recordings import write_minari_set
from tests.recordings import Episode, record, write_d4rl_file

Write = Callable[..., str]


def gear(factor: float) -> Callable[[Any], None]:
    def change(env: Any) -> None:
        env.model.actuator_gear[:, 0] *= factor

    return change


def gravity(env: Any) -> None:
    env.model.opt.gravity[2] *= 1.1


def one_more_substep(env: Any) -> None:
    env.frame_skip += 1


def older_contacts(env: Any) -> None:
    """The margins at which contacts begin as they would in MuJoCo 3.4: half of what they are since."""
    env.model.geom_margin[:] *= 0.5


def half_the_time(env: Any) -> None:
    env.robot_env.frame_skip = 20


def half_the_speed(env: Any) -> None:
    env.robot_env.act_rng = np.ones(9)


def d4rls_noise(env: Any) -> None:
    env.robot_env.robot_noise_ratio = env.object_noise_ratio = 0.1


def both(*changes: Callable[[Any], None]) -> Callable[[Any], None]:
    return lambda env: [change(env) for change in changes] and None


@functools.cache
def steps_of(task: str, change: Callable[[Any], None] | None = None, steps: int = 300) -> tuple[Episode, ...]:
    """Episodes of at most 50 steps, in an environment that somebody changed."""
    env = get_task(task).make_env()
    if change is not None:
        change(env.unwrapped)
    episodes = record(get_task(task), steps, env=env)
    env.close()
    return tuple(episodes)


@pytest.fixture
def written(tmp_path: Path) -> Write:
    """Writes recorded steps in D4RL's or Minari's layout and gives what to type after --data."""

    def write(source: str, task: str, change: Callable[[Any], None] | None = None, steps: int = 300) -> str:
        episodes = steps_of(task, change, steps)
        if source == "d4rl":
            return f"d4rl:{write_d4rl_file(tmp_path / 'file.hdf5', get_task(task), episodes)}"
        return f"local:{write_minari_set(tmp_path, 'set-v0', get_task(task), episodes)}"

    return write


# ---------------------------------------------------------------------- right and wrong


RIGHT = [
    *("hopper-medium@v4", "hopper-medium@v5", "walker2d-medium@v4", "walker2d-medium@v5", "halfcheetah-medium@v4"),
    *("antmaze-umaze@d4rl", "antmaze-large-play@robotics", "pointmaze-umaze-play"),
]


@pytest.mark.parametrize("source", ["d4rl", "minari"])
@pytest.mark.parametrize("task", RIGHT)
def test_what_was_recorded_in_the_environment_fits_it(task: str, source: str, written: Write) -> None:
    report = replay_check(written(source, task), task, steps=200)
    assert report.fit
    assert report.results[0].error < LIMIT / 100  # 32-bit rounding
    assert report.steps >= 190 or "walker" in task  # whose knees turn faster than is recorded


@pytest.mark.parametrize(
    ("task", "change"),
    [
        ("hopper-medium", gear(1.1)),
        ("hopper-medium", gravity),
        ("hopper-medium", one_more_substep),
        ("walker2d-medium", gear(1.1)),
        ("halfcheetah-medium", gear(1.1)),
        ("halfcheetah-medium", gravity),
        ("antmaze-umaze", gear(1.1)),
        ("pointmaze-umaze-play", gear(1.1)),
    ],
)
def test_a_tenth_more_of_anything_is_noticed(task: str, change: Any, written: Write) -> None:
    report = replay_check(written("d4rl", task, change), task, steps=100)
    assert not report.fit
    assert report.results[0].error > 5 * LIMIT
    assert not any(result.fit for result in report.results)
    assert "none of the task's environments fits" in report.sentence()


def test_torques_of_30_and_of_150_are_told_apart_in_d4rls_ant(written: Write) -> None:
    right = replay_check(written("d4rl", "antmaze-umaze"), "antmaze-umaze")
    wrong = replay_check(written("d4rl", "antmaze-umaze", gear(5)), "antmaze-umaze")
    assert right.steps == wrong.steps == 200
    assert right.results[0].error < 1e-4 < 1 < wrong.results[0].error
    assert (right.fit, wrong.fit) == (True, False)


def test_torques_of_150_and_of_30_are_told_apart_in_the_other_ant(written: Write) -> None:
    task = "antmaze-umaze@robotics"
    right = replay_check(written("minari", task), "antmaze-umaze")
    assert right.task.name == task  # the metadata say where it was recorded
    assert right.fit
    (Path(right.spec.removeprefix("local:"))).rename("other-v0")
    wrong = replay_check(written("minari", task, gear(0.2)), "antmaze-umaze", steps=50)
    assert not wrong.fit
    assert wrong.results[0].error > 1


def test_an_ant_of_the_other_physics_is_told_where_it_belongs(written: Write) -> None:
    report = replay_check(written("d4rl", "antmaze-umaze"), "antmaze-umaze@robotics", steps=50)
    assert [result.fit for result in report.results] == [False, True]
    assert report.results[0].error > 1
    assert "does not fit antmaze-umaze@robotics: " in report.sentence()
    assert report.sentence().endswith("it fits antmaze-umaze@d4rl")


# ---------------------------------------------------------------------- versions of one body


@pytest.mark.parametrize(("recorded", "other"), [("v4", "v5"), ("v5", "v4")])
@pytest.mark.parametrize("source", ["d4rl", "minari"])
def test_hoppers_differ_in_the_reward_of_the_step_that_falls(
    recorded: str, other: str, source: str, written: Write
) -> None:
    task = f"hopper-medium@{recorded}"
    own, there = replay_check(written(source, task), task).results
    assert own.fit
    assert own.rewards is not None
    assert own.rewards.falls > 10
    assert own.rewards.falls_differ == own.rewards.others_differ == 0
    assert there.task.physics == other
    assert there.physics_fit
    assert not there.fit
    assert there.rewards is not None
    assert (there.rewards.falls_differ, there.rewards.others_differ) == (there.rewards.falls, 0)


def test_a_hopper_of_the_other_version_is_told_why(written: Write) -> None:
    sentence = replay_check(written("d4rl", "hopper-medium@v5"), "hopper-medium").sentence()
    assert "does not fit hopper-medium: steps lead to the environment's states, but rewards differ" in sentence
    assert sentence.endswith("it fits hopper-medium@v5")


def test_walkers_differ_in_their_right_foot(written: Write) -> None:
    own, there = replay_check(written("d4rl", "walker2d-medium"), "walker2d-medium").results
    assert own.error < LIMIT / 100
    assert there.error > 5 * LIMIT
    assert not there.physics_fit


def test_cheetahs_do_not_differ(written: Write) -> None:
    report = replay_check(written("d4rl", "halfcheetah-medium"), "halfcheetah-medium")
    assert [result.fit for result in report.results] == [True, True]
    assert report.sentence().endswith("; halfcheetah-medium@v5 as well")


@pytest.mark.parametrize("task", ["hopper-medium", "antmaze-umaze@robotics"])
def test_contacts_of_another_mujoco_are_recognised(task: str, written: Write) -> None:
    report = replay_check(written("d4rl", task, older_contacts), task, steps=100)
    assert not report.fit
    assert report.results[-1].margins == 0.5
    assert report.results[-1].error < LIMIT / 100
    assert "with contact margins halved" in report.sentence()
    assert "another version of MuJoCo" in report.sentence()


# ---------------------------------------------------------------------- the kitchen


def test_a_kitchen_with_velocities_fits(written: Write) -> None:
    report = replay_check(written("minari", "kitchen-partial"), "kitchen-partial", steps=200)
    assert report.fit
    assert report.steps == 200
    assert report.results[0].error < NOISY_LIMIT / 4
    judged = report.dimensions[report.dimensions["judged"]]
    assert len(judged) == 18  # angles and velocities of the robot
    assert report.notes == ()


@pytest.mark.parametrize("change", [half_the_time, half_the_speed])
@pytest.mark.parametrize("source", ["minari", "d4rl"])
def test_a_kitchen_of_other_physics_does_not_fit(change: Any, source: str, written: Write) -> None:
    report = replay_check(written(source, "kitchen-partial", change, 100), "kitchen-partial", steps=25)
    assert not report.fit
    assert report.results[0].error > 4 * NOISY_LIMIT


def test_a_kitchen_without_velocities_fits_with_a_word_of_caution(written: Write) -> None:
    report = replay_check(written("d4rl", "kitchen-partial"), "kitchen-partial", steps=40)
    assert report.fit
    assert report.results[0].error < NOISY_LIMIT / 4
    assert "no velocities" in report.notes[0]


def test_d4rls_noise_is_seen_and_forgiven_but_not_other_physics(written: Write) -> None:
    right = replay_check(written("d4rl", "kitchen-partial", d4rls_noise, 100), "kitchen-partial", steps=25)
    assert right.fit
    assert right.dimensions["error_95"].max() > 0.005  # ten times as much noise as the environment has
    noisy_and_slow = both(d4rls_noise, half_the_time)
    assert not replay_check(written("d4rl", "kitchen-partial", noisy_and_slow, 100), "kitchen-partial", steps=25).fit


# ---------------------------------------------------------------------- which steps, which states


@pytest.mark.parametrize(
    "task", ["hopper-medium", "walker2d-medium", "halfcheetah-medium", "antmaze-umaze", "pointmaze-umaze-play"]
)
def test_layouts_are_those_of_the_environments(task: str) -> None:
    for episode in steps_of(task)[:3]:
        layout = state_layout(get_task(task), episode["observations"].shape[1])
        seen = [layout.observe(*state) for state in zip(episode["qpos"], episode["qvel"], strict=True)]
        np.testing.assert_allclose(seen, episode["observations"], rtol=1e-6, atol=1e-6)


def test_both_layouts_of_the_kitchen_are_the_environments() -> None:
    task, episode = get_task("kitchen-partial"), steps_of("kitchen-partial")[0]
    raw = np.stack([seen["observation"] for seen in episode["raw_observations"]])
    for width, rows in ((59, raw), (60, episode["observations"][:, :30])):
        layout = state_layout(task, width)
        seen = [layout.observe(*state) for state in zip(episode["qpos"], episode["qvel"], strict=True)]
        np.testing.assert_allclose(seen, rows, atol=1.01e-3)  # the noise
        assert len(set(layout.names)) == len(layout.names)


def test_steps_are_pairs_of_one_episode(written: Write) -> None:
    """The numbers of rows are written into the file, and read again."""
    spec = written("d4rl", "pointmaze-umaze-play")
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        count, last = len(file["rewards"]), file["terminals"][()] | file["timeouts"][()]
        file["observations"][:, 0] = np.arange(count) * 1e-3
        file["rewards"][...] = np.arange(count)
        del file["infos"]
    drawn = draw_steps(spec, get_task("pointmaze-umaze-play"), 100, seed=3)
    rows = drawn.rewards.astype(int)
    np.testing.assert_allclose(drawn.following[:, 0] - drawn.observations[:, -1, 0], 1e-3, rtol=1e-3)
    np.testing.assert_allclose(drawn.qpos[:, 0], rows * 1e-3, rtol=1e-5)
    assert len(set(rows)) == 100
    assert not last[rows].any()
    assert np.histogram(rows, bins=5, range=(0, count))[0].min() >= 10  # from all over the file
    again = draw_steps(spec, get_task("pointmaze-umaze-play"), 100, seed=3)
    np.testing.assert_array_equal(again.rewards, drawn.rewards)
    assert set(draw_steps(spec, get_task("pointmaze-umaze-play"), 100, seed=4).rewards) != set(drawn.rewards)


def test_a_quarter_of_a_runners_steps_fall(written: Write) -> None:
    drawn = draw_steps(written("d4rl", "hopper-medium"), get_task("hopper-medium"), 40)
    assert drawn.ended.sum() == 40 // FALLS
    assert np.isnan(drawn.following[drawn.ended]).all()  # D4RL's rows do not say where a fall led
    assert np.isfinite(drawn.following[~drawn.ended]).all()


def test_a_fall_whose_last_state_was_made_up_is_not_compared(written: Write, tmp_path: Path) -> None:
    load_trajectories(written("d4rl", "hopper-medium"), "hopper-medium").save(tmp_path / "arrays")
    report = replay_check(f"arrays:{tmp_path / 'arrays'}", "hopper-medium")
    assert report.fit
    assert report.results[0].rewards is not None
    assert report.results[0].rewards.falls > 0


def test_states_of_the_simulator_that_are_out_of_step_are_not_used(written: Write) -> None:
    spec = written("d4rl", "antmaze-umaze")
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        for key in ("infos/qpos", "infos/qvel"):
            file[key][...] = np.roll(file[key][()], -1, axis=0)
    assert replay_check(spec, "antmaze-umaze").results[0].error < LIMIT / 100


def test_steps_that_start_with_a_cut_velocity_are_left_out_unless_the_simulators_is_recorded(written: Write) -> None:
    spec, task = written("d4rl", "walker2d-medium"), get_task("walker2d-medium")
    assert np.abs(draw_steps(spec, task, 100).qvel).max() > 10
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        del file["infos"]
    drawn = draw_steps(spec, task, 100)
    assert np.abs(drawn.qvel).max() < 10
    assert 0 < len(drawn.rewards) < 100
    assert replay_check(spec, task, steps=100).fit


def test_no_more_is_read_than_the_steps_need(written: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    read, spans = d4rl_recording.read_rows, []

    def spy(dataset: Any, where: str, start: int, stop: int, *rest: Any) -> Any:
        spans.append(stop - start)
        return read(dataset, where, start, stop, *rest)

    for module in (d4rl_recording, minari):
        monkeypatch.setattr(module, "read_rows", spy)
    for source in ("d4rl", "minari"):
        draw_steps(written(source, "antmaze-umaze"), get_task("antmaze-umaze"), 20)
    assert max(spans) == 2
    assert len(spans) < 200


def test_of_many_episodes_some_are_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = get_task("pointmaze-umaze-play")
    monkeypatch.setattr(minari, "EPISODES", 3)
    folder = write_minari_set(tmp_path, "set-v0", task, record(task, 100, episode_steps=10))
    assert len(draw_steps(f"local:{folder}", task, 100).rewards) == 30


# ---------------------------------------------------------------------- refusals


def test_a_recording_that_tells_nothing_is_refused(written: Write) -> None:
    spec = written("d4rl", "hopper-medium", steps=20)
    with pytest.raises(UserError, match="steps to replay is 0, expected at least 1"):
        replay_check(spec, "hopper-medium", steps=0)
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        file["terminals"][...] = True
    with pytest.raises(DataError, match=r"none of .* steps leads from one complete recorded state to another"):
        replay_check(spec, "hopper-medium")
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        file["terminals"][...] = False
        file["timeouts"][...] = False
        file["observations"][...] = file["observations"][0]
        file["actions"][...] = np.nan
    with pytest.raises(DataError, match=r"'file.hdf5', actions: expected finite numbers, got NaN or infinity"):
        replay_check(spec, "hopper-medium")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda file: file.pop("actions"), "'actions' is missing"),
        (lambda file: _replace(file, "actions", h5py.SoftLink("/rewards")), "'actions' is a link to elsewhere"),
        (lambda file: _replace(file, "observations", np.zeros((20, 4))), "got 4 columns, task 'hopper-medium' needs"),
        (lambda file: _replace(file, "rewards", np.zeros(7)), "observations: got shape"),
        (lambda file: _replace(file, "infos", h5py.ExternalLink("other.hdf5", "/")), "'infos' is a link to elsewhere"),
    ],
)
def test_damaged_files_are_refused(spoil: Callable[[h5py.File], None], message: str, written: Write) -> None:
    spec = written("d4rl", "hopper-medium", steps=20)
    with h5py.File(spec.removeprefix("d4rl:"), "r+") as file:
        spoil(file)
    with pytest.raises(DataError, match=message):
        replay_check(spec, "hopper-medium")


def _replace(file: h5py.File, key: str, value: Any) -> None:
    del file[key]
    file[key] = value


# ---------------------------------------------------------------------- the command


def test_the_command_says_fit_and_misfit(written: Write, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "check", written("d4rl", "hopper-medium"), "--replay", "60", "--task"]
    assert main([*words, "hopper-medium"]) == 0
    out = capsys.readouterr().out
    assert f"{words[2]} fits hopper-medium (relative error" in out
    assert "hopper-medium@v5: rewards differ by more than 0.01" in out
    assert "x velocity (m/s)" in out
    assert main([*words, "hopper-medium@v5", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["replay"]["verdict"] == "misfit"
    assert [each["verdict"] for each in found["replay"]["physics"]] == ["misfit", "fit"]
    assert len(found["replay"]["physics"][0]["dimensions"]) == 11


def test_the_command_needs_a_task_and_a_number(written: Write, capsys: pytest.CaptureFixture[str]) -> None:
    spec = written("d4rl", "hopper-medium", steps=20)
    assert main(["data", "check", spec, "--replay", "9"]) == 2
    assert "--replay needs an environment: give --task NAME" in capsys.readouterr().err
    assert main(["data", "check", spec, "--task", "hopper-medium", "--replay", "-1"]) == 2
    assert "--replay is -1" in capsys.readouterr().err


def test_other_coordinates_are_no_reason_to_refuse_the_question(
    written: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = written("d4rl", "antmaze-umaze@robotics")
    assert main(["data", "check", spec, "--task", "antmaze-umaze", "--replay", "50"]) == 1
    assert "it fits antmaze-umaze@robotics" in capsys.readouterr().out
