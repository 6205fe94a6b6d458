"""Every formula against numbers worked out by hand."""

import math

import pytest
import torch
from torch import tensor

from dds_lightning import losses


def test_vector_quantisation_sums_over_dimensions_and_averages_over_the_batch():
    encodings = tensor([[1.0, 2.0], [0.0, 0.0]], requires_grad=True)
    vectors = tensor([[0.0, 0.0], [3.0, 4.0]], requires_grad=True)
    codebook, commitment = losses.vector_quantisation(encodings, vectors)
    assert codebook.item() == pytest.approx((1 + 4 + 9 + 16) / 2)
    assert commitment.item() == pytest.approx(15.0)
    # sg[.]: the codebook term moves only the vectors, the commitment term only the encoder.
    (grad_vectors, grad_encodings) = torch.autograd.grad(codebook, [vectors, encodings], allow_unused=True)
    assert grad_encodings is None
    torch.testing.assert_close(grad_vectors, vectors.detach() - encodings.detach())  # 2 (z - E) / B with B = 2
    (grad_vectors, grad_encodings) = torch.autograd.grad(commitment, [vectors, encodings], allow_unused=True)
    assert grad_vectors is None
    torch.testing.assert_close(grad_encodings, encodings.detach() - vectors.detach())


def test_gaussian_kl_is_zero_at_the_prior_and_matches_the_closed_form():
    zeros = torch.zeros(3, 2)
    assert losses.gaussian_kl(zeros, zeros).item() == 0.0
    mean, log_variance = tensor([[2.0]]), tensor([[math.log(4.0)]])
    assert losses.gaussian_kl(mean, log_variance).item() == pytest.approx(0.5 * (4 + 4 - 1 - math.log(4.0)))


@pytest.mark.parametrize(("tau", "expected"), [(0.5, 0.5 * (4 + 1) / 2), (0.9, (0.9 * 4 + 0.1 * 1) / 2)])
def test_expectile_weighs_positive_differences_by_tau(tau, expected):
    assert losses.expectile(tensor([2.0, -1.0]), tau).item() == pytest.approx(expected)


def test_the_minimum_of_the_expectile_loss_is_the_expectile():
    samples = torch.arange(11.0)
    v = torch.zeros((), requires_grad=True)
    optimizer = torch.optim.Adam([v], lr=0.1)
    for _ in range(600):
        optimizer.zero_grad()
        losses.expectile(samples - v, 0.9).backward()
        optimizer.step()
    above, below = (samples - v.detach()).clamp_min(0).sum(), (v.detach() - samples).clamp_min(0).sum()
    assert (0.9 * above / (0.1 * below)).item() == pytest.approx(1.0, abs=0.02)


def test_td_target_bootstraps_unless_the_transition_ended():
    target = losses.td_target(tensor([1.0, 1.0]), tensor([0.9, 0.9]), tensor([0.0, 1.0]), tensor([10.0, 10.0]))
    assert target.tolist() == pytest.approx([10.0, 1.0])


def test_td_sums_over_both_critics():
    q = tensor([[1.0, 3.0], [2.0, 2.0]])
    assert losses.td(q, tensor([1.0, 1.0])).item() == pytest.approx((0 + 4) / 2 + (1 + 1) / 2)


def test_awr_weights_are_clipped_and_never_infinite():
    weights = losses.awr_weights(tensor([0.0, 1.0, 1000.0]), alpha=2.0, clip=100.0)
    assert weights.tolist() == pytest.approx([1.0, math.exp(2.0), 100.0])


def test_awr_is_the_weighted_negative_log_likelihood():
    value = losses.awr(tensor([math.log(0.5), math.log(0.25)]), tensor([1.0, 3.0]))
    assert value.item() == pytest.approx((math.log(2) + 3 * math.log(4)) / 2)


@pytest.mark.parametrize(("weights", "expected"), [([1.0, 1.0, 1.0, 1.0], 1.0), ([1.0, 0.0, 0.0, 0.0], 0.25)])
def test_effective_sample_size_runs_from_one_over_b_to_one(weights, expected):
    assert losses.effective_sample_size(tensor(weights)).item() == pytest.approx(expected)
