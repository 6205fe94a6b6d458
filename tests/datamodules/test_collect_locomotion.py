"""Locomotion data: which behaviours run, that sets repeat and load, and what is in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules import load_trajectories
from datamodules.behaviours.policy import MLPPolicy
from datamodules.collect.locomotion import LocomotionRecipe, Runners, collect_locomotion, mixture
from datamodules.physics.check import replay_check
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task


def ladder(
    bias: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8), scores: tuple[float, ...] = (1, 20, 45, 80, 100)
) -> Any:
    """Hoppers that always push alike; what they do tells who they are."""
    return {
        f"{score:03.0f}": MLPPolicy(
            weights=(np.zeros((11, 3), np.float32),),
            biases=(np.full(3, value, np.float32),),
            mean=np.zeros(11, np.float32),
            std=np.ones(11, np.float32),
            log_std=np.zeros(3, np.float32),
            metadata={"score": {"score": score}},
        )
        for value, score in zip(bias, scores, strict=True)
    }


def collect(out: Path, steps: int = 900, task: str = "hopper-medium-expert", **options: Any) -> Path:
    options = {
        "workers": 1,
        "recipe": LocomotionRecipe(action_noise=0.0),
        "ladder": ladder(),
        "progress": False,
    } | options
    return collect_locomotion(task, steps, 5, out, **options)


def test_medium_is_the_rung_nearest_to_42_percent_of_the_expert() -> None:
    assert list(mixture(ladder(), "medium")) == ["045"]
    assert list(mixture(ladder(), "medium-replay")) == ["001", "020", "045"]
    assert list(mixture(ladder(), "medium-expert")) == ["045", "100"]
    with pytest.raises(UserError, match="quality: got 'random'"):
        mixture(ladder(), "random")


@pytest.mark.parametrize(
    ("quality", "shares"),
    [
        ("medium", {0.4: 1.0}),
        ("medium-expert", {0.4: 0.5, 0.8: 0.5}),
        ("medium-replay", {0.0: 1 / 3, 0.2: 1 / 3, 0.4: 1 / 3}),
    ],
)
def test_each_behaviour_takes_its_share_of_the_steps(quality: str, shares: dict[float, float], tmp_path: Path) -> None:
    data = load_trajectories(f"local:{collect(tmp_path, task=f'hopper-{quality}')}", f"hopper-{quality}")
    assert data.num_steps == 900
    for value, share in shares.items():
        found = np.isclose(data.actions[:, 0], value, atol=1e-6).mean()
        assert found == pytest.approx(share, abs=0.02), value


def test_falls_are_terminations_and_the_last_step_of_a_runner_is_a_truncation(tmp_path: Path) -> None:
    data = load_trajectories(f"local:{collect(tmp_path)}", "hopper-medium-expert")
    assert data.terminations.sum() > 5
    assert data.truncations.sum() == data.num_episodes - data.terminations.sum()
    np.testing.assert_allclose(data.rewards[:3], data.rewards[:3].clip(0.5, 2.5))  # a reward of 1 for being upright


def test_any_number_of_workers_gives_the_same_bytes(tmp_path: Path) -> None:
    one, two = collect(tmp_path / "1"), collect(tmp_path / "2", workers=2)
    assert (one / "data" / "main_data.hdf5").read_bytes() == (two / "data" / "main_data.hdf5").read_bytes()


def test_the_data_fit_the_environment_and_tell_who_made_them(tmp_path: Path) -> None:
    folder = collect(tmp_path)
    assert replay_check(f"local:{folder}", get_task("hopper-medium-expert"), steps=50).fit
    made = json.loads((folder / "data" / "metadata.json").read_text())["collection"]
    assert made["behaviours"] == {"045": {"score": {"score": 45}}, "100": {"score": {"score": 100}}}
    assert [path.name for path in tmp_path.iterdir()] == ["hopper-medium-expert-v0"]


def test_the_shipped_ladder_gives_medium_and_expert_scores(tmp_path: Path) -> None:
    folder = collect_locomotion("hopper-medium-expert", 16_000, 0, tmp_path, 1, progress=False)
    task = get_task("hopper-medium-expert")
    data = load_trajectories(f"local:{folder}", task)
    whole = data.terminations[data.step_offsets[1:] - 1] | (data.lengths == 1000)
    scores = task.normalised_score(data.returns[whole])
    medium, expert = scores[scores < 60], scores[scores > 90]
    assert 25 < medium.mean() < 50
    assert len(expert) >= 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "kitchen-mixed"}, "expected a task of locomotion"),
        ({"steps": 0}, "steps: got 0"),
        ({"workers": 0}, "workers: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        collect(tmp_path, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("setting", [{"action_noise": -0.1}, {"episode_steps": 0}])
def test_recipes_out_of_range_are_refused(setting: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=f"{next(iter(setting))}: got"):
        LocomotionRecipe(**setting)


def test_the_behaviours_play_again_each_in_its_own_environments() -> None:
    quiet, noisy = LocomotionRecipe(action_noise=0.0), LocomotionRecipe(action_noise=0.1)
    four = Runners("hopper-medium-expert", quiet, ladder())
    four.reset(4)
    actions = four.act(np.zeros((4, 11), np.float32))
    assert np.allclose(actions, np.array([0.4, 0.8, 0.4, 0.8])[:, None])
    runners, again = (Runners("hopper-medium", noisy, ladder()) for _ in range(2))
    runners.reset(2, seed=3)
    again.reset(2, seed=3)
    first = runners.act(np.zeros((2, 11), np.float32))
    assert np.array_equal(first, again.act(np.zeros((2, 11), np.float32)))
    assert 0 < np.abs(first - 0.4).max() < 0.5
