"""How a codebook's usage is measured over an epoch."""

import pytest
import torch

from dds_lightning.nn.usage import CodebookUsage, SegmentMetrics, perplexity


def test_perplexity_is_the_number_of_codes_that_are_used_alike():
    assert perplexity(torch.full((8,), 1 / 8)).item() == pytest.approx(8.0)
    assert perplexity(torch.tensor([0.5, 0.5, 0.0, 0.0])).item() == pytest.approx(2.0)
    assert perplexity(torch.tensor([1.0, 0.0])).item() == 1.0
    # exp of the entropy in nats, 0.75 ln(4/3) + 0.25 ln 4
    assert perplexity(torch.tensor([0.75, 0.25])).item() == pytest.approx((4 / 3) ** 0.75 * 4**0.25)


def test_perplexity_is_at_most_the_number_of_codes_whatever_the_shares_sum_to():
    assert perplexity(torch.tensor([0.3, 0.3, 0.3, 0.3])).item() == pytest.approx(4.0)
    assert perplexity(torch.tensor([3.0, 1.0])).item() == pytest.approx((4 / 3) ** 0.75 * 4**0.25)


def test_usage_counts_an_epoch_not_its_batches_and_begins_anew_after_a_reset():
    usage = CodebookUsage(4, threshold=0.5)
    usage.update(torch.tensor([0, 0, 0, 1]))
    usage.update(torch.tensor([[0, 1], [1, 1]]))  # any shape
    found = {name: value.item() for name, value in usage.compute().items()}
    assert found == {"perplexity": pytest.approx(2.0), "codes_used": 2.0, "dead_codes": 2.0}
    usage.reset()
    usage.update(torch.tensor([3]))
    assert usage.compute()["perplexity"].item() == 1.0


def test_a_code_is_in_use_from_the_threshold_share_on():
    usage = CodebookUsage(2, threshold=0.5)  # of 1/2: a quarter
    usage.update(torch.tensor([0, 0, 0, 1]))
    assert usage.compute()["codes_used"].item() == 2.0
    usage.update(torch.tensor([0]))
    assert usage.compute()["dead_codes"].item() == 1.0


def test_before_the_first_code_nothing_is_in_use():
    found = CodebookUsage(3).compute()
    assert (found["codes_used"].item(), found["perplexity"].item()) == (0.0, 1.0)


def test_an_epoch_of_segments_gives_the_root_of_the_mean_squared_error_and_the_usage_of_its_codes():
    metrics = SegmentMetrics(num_skills=4)
    metrics.update(torch.zeros(6, 2), torch.full((6, 2), 1.0), torch.tensor([0, 0, 1]))
    metrics.update(torch.zeros(2, 2), torch.full((2, 2), 3.0), torch.tensor([1]))
    found = metrics.compute()
    assert found["reconstruction_rmse"].item() == pytest.approx((6 * 1 + 2 * 9) ** 0.5 / 8**0.5)
    assert (found["codes_used"].item(), found["dead_codes"].item()) == (2, 2)
    metrics.reset()
    metrics.update(torch.zeros(1, 2), torch.full((1, 2), 0.5), torch.tensor([3]))
    assert metrics.compute()["reconstruction_rmse"].item() == 0.5
    continuous = SegmentMetrics(num_skills=None)
    continuous.update(torch.zeros(1, 2), torch.full((1, 2), 0.5), None)
    assert list(continuous.compute()) == ["reconstruction_rmse"]
