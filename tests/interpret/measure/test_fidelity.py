"""Recorded segments played again: by who recorded them, by skills that mean nothing, and by somebody else."""

import numpy as np
import pytest

from dds_lightning.interpret.measure.fidelity import RECORDED, SKILLS, fidelity
from dds_lightning.tasks import get_task
from tests.interpret.tiny import Compass, Deaf, recorded

MAZE = get_task("pointmaze-umaze-diverse")


@pytest.fixture(scope="module")
def compass_data():
    """Four episodes, each pushed one way all along."""
    ways = iter(np.repeat(Compass.ways.numpy(), 12, axis=0))
    return recorded(MAZE, 48, episode_steps=12, act=lambda seen, rng: next(ways))


def test_skills_that_repeat_the_data_have_no_error_and_others_are_as_far_off_as_any_segment(compass_data):
    east = Compass.ways[:1].numpy()
    others = {"always east": lambda seen, rows: east.repeat(len(rows), axis=0)}
    table = fidelity(MAZE, compass_data, Compass(), others, count=20).set_index("player")
    assert list(table.index) == [SKILLS, "always east", RECORDED]
    assert table["error"][RECORDED] == pytest.approx(0.0, abs=0.02)
    assert table["error"][SKILLS] == pytest.approx(0.0, abs=0.02)
    assert 0.5 < table["error"]["always east"] < 1.5
    assert (table["fell"] == 0).all()
    assert (table["segments"] == 20).all()
    deaf = fidelity(MAZE, compass_data, Deaf(), count=20).set_index("player")
    assert deaf["error"][SKILLS] == pytest.approx(table["error"]["always east"], rel=1e-6)


def test_replays_that_end_early_are_counted():
    hopper = get_task("hopper-medium")
    data = recorded(hopper, 60, episode_steps=12)
    dive = {"dive": lambda seen, rows: np.tile(np.float32([1.0, -1.0, 1.0]), (len(rows), 1))}

    class Long(Compass):
        horizon = 11

        def decode(self, observations, codes, noise_scale=None, generator=None):
            return super().decode(observations, codes)[:, :1].expand(-1, 3)

    table = fidelity(hopper, data, Long(), dive, count=10).set_index("player")
    assert np.isfinite(table["error"]).all()
    assert table["fell"].between(0, 1).all()
