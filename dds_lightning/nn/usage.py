"""Metrics in torchmetrics' form: they accumulate over an epoch, reset themselves and sync across processes."""

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric


def perplexity(share: Tensor) -> Tensor:
    """``exp(H)`` of a distribution over codes (K,), as a scalar: K if uniform, 1 after a collapse.

    The shares need not sum to 1: after a restart of dead codes, the running usage of a codebook does not.
    """
    share = share / share.sum().clamp_min(torch.finfo(share.dtype).tiny)
    return (-torch.special.xlogy(share, share).sum()).exp()


class CodebookUsage(Metric):
    """How a codebook is used over an epoch: perplexity, codes in use, dead codes.

    A code is *in use* when its share of the epoch reaches ``threshold / K``. Measured over an epoch, because a single
    batch of a few hundred segments would call rare codes dead.

    Args:
        num_skills: K.
        threshold: Share of the uniform usage 1 / K from which a code counts as used.
    """

    full_state_update = False
    counts: Tensor

    def __init__(self, num_skills: int, threshold: float = 0.05) -> None:
        super().__init__()
        self.threshold = threshold
        self.add_state("counts", default=torch.zeros(num_skills), dist_reduce_fx="sum")

    def update(self, codes: Tensor) -> None:
        """Count codes (B,)."""
        self.counts += torch.bincount(codes.flatten(), minlength=len(self.counts)).to(self.counts)

    def compute(self) -> dict[str, Tensor]:
        """Return ``perplexity``, ``codes_used`` and ``dead_codes`` as scalars."""
        share = self.counts / self.counts.sum().clamp_min(1.0)  # (K,)
        used = (share >= self.threshold / len(share)).sum().float()
        return {"perplexity": perplexity(share), "codes_used": used, "dead_codes": len(share) - used}


class SegmentMetrics(nn.Module):
    """How well an epoch of held-out segments is decoded, and how their skills use the codebook where they have codes.

    Args:
        num_skills: K; None for continuous skills.
    """

    def __init__(self, num_skills: int | None) -> None:
        super().__init__()
        self.squared_error = MeanMetric()
        self.usage = None if num_skills is None else CodebookUsage(num_skills)

    def update(self, decoded: Tensor, actions: Tensor, codes: Tensor | None) -> None:
        """Add decoded and true actions, (B H, A) each, and the codes (B,) of their segments."""
        self.squared_error.update((decoded - actions).square().mean(dim=-1))
        if self.usage is not None and codes is not None:
            self.usage.update(codes)

    def compute(self) -> dict[str, Tensor]:
        """Return ``reconstruction_rmse``, in the unit of the actions, and what `CodebookUsage` has."""
        usage = {} if self.usage is None else self.usage.compute()
        return {"reconstruction_rmse": self.squared_error.compute().sqrt(), **usage}

    def reset(self) -> None:
        """Forget the epoch."""
        self.squared_error.reset()
        if self.usage is not None:
            self.usage.reset()
