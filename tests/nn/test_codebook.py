"""Quantisation, its gradients, its start, its health."""

import pytest
import torch

from dds_lightning.nn.codebook import Codebook


def clusters(num: int, per: int = 64, dim: int = 8) -> torch.Tensor:
    """(num * per, dim) points in tight clusters far apart."""
    generator = torch.Generator().manual_seed(0)
    centres = 4.0 * torch.randn(num, dim, generator=generator)
    return centres.repeat_interleave(per, 0) + 0.05 * torch.randn(num * per, dim, generator=generator)


@pytest.mark.parametrize("init", ["uniform", "normal", "kmeans"])
@pytest.mark.parametrize("ema", [None, 0.99])
def test_codes_to_vectors_and_back(init, ema):
    codebook = Codebook(16, 8, init=init, ema_decay=ema).eval()
    codes = torch.arange(16)
    assert torch.equal(codebook(codebook.lookup(codes)).codes, codes)


def test_nearest_is_the_smallest_distance():
    codebook = Codebook(3, 2, init="uniform")
    codebook.set_vectors(torch.arange(3), torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]))
    assert codebook.nearest(torch.tensor([[0.4, 0.0], [0.6, 0.1], [0.1, 1.2]])).tolist() == [0, 1, 2]


def test_gradient_passes_straight_through():
    codebook = Codebook(4, 3)
    encodings = torch.randn(5, 3, requires_grad=True)
    weight = torch.randn(5, 3)
    result = codebook(encodings)
    torch.testing.assert_close(result.vectors, codebook.lookup(result.codes))
    (gradient,) = torch.autograd.grad((result.vectors * weight).sum(), encodings)
    torch.testing.assert_close(gradient, weight)


def test_kmeans_start_finds_every_cluster():
    codebook = Codebook(16, 8, init="kmeans")
    assert not codebook.initted
    points = clusters(16)
    codebook.start_from(points)
    assert codebook.initted
    assert len(codebook.nearest(points).unique()) == 16
    assert (points - codebook.lookup(codebook.nearest(points))).norm(dim=1).mean() < 0.5


def test_ema_moves_each_vector_to_the_mean_of_its_members():
    codebook = Codebook(2, 2, init="uniform", ema_decay=0.5)
    assert not codebook.vectors.requires_grad
    codebook.train()
    points = torch.tensor([[1.0, 1.0], [3.0, 1.0], [-2.0, -2.0], [-2.0, -4.0]])
    codebook.set_vectors(torch.arange(2), torch.tensor([[1.0, 0.0], [-1.0, 0.0]]))
    for _ in range(30):
        result = codebook(points)
        assert result.terms["codebook"].value.item() == 0.0
    torch.testing.assert_close(codebook.vectors, torch.tensor([[2.0, 1.0], [-2.0, -3.0]]), atol=1e-3, rtol=0)


def test_dead_codes_restart_on_points_that_are_badly_served():
    codebook = Codebook(4, 2, init="uniform").train()
    codebook.set_vectors(torch.arange(4), torch.tensor([[0.0, 0.0], [50.0, 50.0], [-50.0, 50.0], [50.0, -50.0]]))
    points = torch.cat([torch.randn(200, 2) * 0.1, torch.randn(200, 2) * 0.1 + 5.0])
    for _ in range(200):
        codebook(points)
    moved = codebook.restart_dead(points, threshold=0.1, generator=torch.Generator().manual_seed(0))
    assert moved.tolist() == [1, 2, 3]
    assert codebook.vectors[1:].norm(dim=1).min() > 4.0  # the far cluster, which code 0 served badly
    assert codebook.restart_dead(points, 0.1, torch.Generator()).numel() == 0  # they get time to be used


def test_state_keeps_its_buffers_in_place():
    codebook = Codebook(4, 2, ema_decay=0.9).train()
    before = {name: buffer.data_ptr() for name, buffer in codebook.named_buffers()}
    codebook(torch.randn(32, 2))
    codebook.start_from(torch.randn(32, 2))
    codebook.restart_dead(torch.randn(32, 2), 0.5, torch.Generator().manual_seed(0))
    assert {name: buffer.data_ptr() for name, buffer in codebook.named_buffers()} == before


def test_distances_stay_in_float32_under_autocast():
    codebook = Codebook(64, 128, init="normal")
    encodings = codebook.vectors.detach() + 0.01 * torch.randn(64, 128)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(codebook.nearest(encodings), torch.arange(64))
