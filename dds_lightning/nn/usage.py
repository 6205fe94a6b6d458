"""Metrics in torchmetrics' form: they accumulate over an epoch, reset themselves and sync across processes."""

import torch
from torch import Tensor
from torchmetrics import Metric


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
