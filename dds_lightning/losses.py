"""The formulas of the paper as pure functions of tensors, one each."""

import torch
from torch import Tensor


def vector_quantisation(encodings: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Codebook and commitment term of equation 13, as VQ-VAE's squared distances.

    Args:
        encodings: (B, D) encoder outputs E(tau).
        vectors: (B, D) their nearest skill vectors z.

    Returns:
        ``||sg[E] - z||^2`` and ``||sg[z] - E||^2``, each summed over D and averaged over B.
    """
    codebook = (encodings.detach() - vectors).square().sum(dim=-1).mean()
    commitment = (vectors.detach() - encodings).square().sum(dim=-1).mean()
    return codebook, commitment


def gaussian_kl(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL divergence of N(mean, exp(log_variance)) from N(0, I): (B, D) each, summed over D, averaged over B."""
    return 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum(dim=-1).mean()


def expectile(difference: Tensor, tau: float) -> Tensor:
    """Asymmetric squared loss ``|tau - 1(u < 0)| u^2`` of equation 7, averaged.

    Args:
        difference: (B,) u = target Q - V.
        tau: Expectile in (0, 1); 0.5 is half the squared error.
    """
    weight = torch.where(difference < 0, 1.0 - tau, tau)
    return (weight * difference.square()).mean()


def td_target(rewards: Tensor, discounts: Tensor, dones: Tensor, next_values: Tensor) -> Tensor:
    """Bootstrap target ``R + discount (1 - done) V(s')`` of a semi-MDP transition; all (B,)."""
    return rewards + discounts * (1.0 - dones) * next_values


def td(q_values: Tensor, target: Tensor) -> Tensor:
    """Squared TD error of equation 8: ensemble (N, B) against target (B,), summed over N, averaged over B."""
    return (q_values - target).square().mean(dim=-1).sum()


def awr_weights(advantages: Tensor, alpha: float | Tensor, clip: float) -> Tensor:
    """Regression weights ``min(exp(alpha A), clip)`` of equation 9; (B,)."""
    # exp of a large number is inf, and min(inf, clip) is clip: no overflow reaches the loss.
    return (alpha * advantages).exp().clamp_max(clip)


def awr(log_probabilities: Tensor, weights: Tensor) -> Tensor:
    """Advantage-weighted regression ``-E[w log pi(k | s)]`` (equation 9, the sign that is minimised); (B,) each."""
    return -(weights * log_probabilities).mean()


def effective_sample_size(weights: Tensor) -> Tensor:
    """Share of the batch that the weights (B,) really use: ``(sum w)^2 / (B sum w^2)``, from 1/B to 1."""
    return weights.sum().square() / (weights.numel() * weights.square().sum().clamp_min(1e-12))
