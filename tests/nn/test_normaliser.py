"""Units: what goes in comes back, and what never moves does not blow up."""

import pytest
import torch

from dds_lightning.errors import UserError
from dds_lightning.nn.normaliser import MIN_STD, ActionBox, Normaliser


def test_normalised_data_have_zero_mean_and_unit_deviation_and_the_way_back_is_exact_to_rounding():
    data = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 10.0, 0.1]) + 5.0
    normaliser = Normaliser(3)
    assert torch.equal(normaliser(data), data)  # before it is fitted
    normaliser.fit(data.mean(dim=0), data.std(dim=0))
    unit = normaliser(data)
    torch.testing.assert_close(unit.mean(dim=0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(unit.std(dim=0), torch.ones(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(unit * normaliser.std + normaliser.mean, data)
    assert normaliser.fitted


def test_a_dimension_that_never_moves_is_divided_by_the_floor():
    normaliser = Normaliser(2)
    normaliser.fit(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 2.0]))
    assert normaliser(torch.tensor([1.0 + MIN_STD, 4.0])).tolist() == pytest.approx([1.0, 2.0], rel=1e-3)


def test_actions_return_from_the_cube_and_are_clipped_to_the_box():
    box = ActionBox(2)
    box.fit(torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 0.5]))
    actions = torch.tensor([[-1.0, 0.0], [3.0, 0.5], [1.0, 0.25], [0.0, 0.1]])
    torch.testing.assert_close(box.to_unit(actions)[:3], torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]))
    torch.testing.assert_close(box.from_unit(box.to_unit(actions)), actions)
    assert box.from_unit(torch.tensor([-9.0, 9.0])).tolist() == [-1.0, 0.5]


@pytest.mark.parametrize("part", [Normaliser, ActionBox])
def test_statistics_of_another_width_are_refused(part):
    with pytest.raises(UserError, match=r"2 dimensions, the model expects 3"):
        part(3).fit(torch.zeros(2), torch.ones(2))
