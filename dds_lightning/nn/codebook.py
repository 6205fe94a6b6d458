"""The discrete skill space: K vectors, nearest-neighbour quantisation, straight-through gradient (section 4.1)."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

import dds_lightning.losses as losses
from dds_lightning.nn.bottleneck import Bottleneck, Skill, Term
from dds_lightning.nn.usage import perplexity

CodebookInit = Literal["kmeans", "uniform", "normal"]


class Codebook(Bottleneck):
    """K skill vectors of dimension D.

    The distance is computed in float32 whatever the precision of the rest: in bfloat16 neighbouring codes tie.

    Args:
        num_skills: K.
        skill_dim: D.
        init: Start of the vectors. ``uniform`` in +-1/K as VQ-VAE; ``normal`` N(0, 1), which collapses (kept for the
            ablation); ``kmeans`` leaves them uniform until `start_from` is called with encodings of the data.
        ema_decay: None trains the vectors by the codebook loss (the paper); a number in (0, 1) instead moves each to
            the running mean of its encodings.
        commitment: Weight of the commitment loss, beta of equation 14.
    """

    discrete = True
    initted: Tensor
    usage: Tensor
    ema_count: Tensor
    ema_sum: Tensor

    def __init__(
        self,
        num_skills: int,
        skill_dim: int,
        init: CodebookInit = "kmeans",
        ema_decay: float | None = None,
        commitment: float = 0.25,
    ) -> None:
        super().__init__()
        self.ema_decay, self.commitment = ema_decay, commitment
        vectors = torch.randn(num_skills, skill_dim)
        if init != "normal":
            vectors.uniform_(-1.0 / num_skills, 1.0 / num_skills)
        self.vectors = nn.Parameter(vectors, requires_grad=ema_decay is None)
        # Training state lives in buffers and is changed in place: a replaced buffer loses its device and checkpoint.
        # "initted" is a misspelling that stays: shipped weights have this key.
        self.register_buffer("initted", torch.tensor(init != "kmeans"))
        self.register_buffer("usage", torch.full((num_skills,), 1.0 / num_skills))
        if ema_decay is not None:
            self.register_buffer("ema_count", torch.ones(num_skills))
            self.register_buffer("ema_sum", vectors.clone())

    @classmethod
    def build(cls, settings: Any) -> Self:
        """As `Bottleneck.build`."""
        h = settings
        return cls(h.num_skills, h.skill_dim, h.codebook_init, h.codebook_ema, h.commitment)

    @property
    def num_skills(self) -> int:
        """K."""
        return self.vectors.shape[0]

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)
    def nearest(self, encodings: Tensor) -> Tensor:
        """Code of the nearest vector (equation 11): encodings (B, D) to int64 (B,)."""
        return torch.cdist(encodings.detach().float(), self.vectors.detach().float()).argmin(dim=-1)

    def lookup(self, codes: Tensor) -> Tensor:
        """Skill vectors (..., D) of codes (...)."""
        return self.vectors[codes]

    def forward(self, encodings: Tensor) -> Skill:
        """Quantise encodings (B, D); while training also update the usage statistics.

        Returns:
            The nearest vectors, through which the gradient passes straight to the encodings; their codes; and the
            terms ``codebook``, ||sg[E] - z||^2, which moves the vectors only (0 with an EMA codebook), and
            ``commitment``, ||sg[z] - E||^2, which moves the encoder only.
        """
        encodings = encodings.float()
        codes = self.nearest(encodings)
        vectors = self.lookup(codes)  # (B, D)
        if self.training:
            self._observe(encodings.detach(), codes)
        codebook_loss, commitment_loss = losses.vector_quantisation(encodings, vectors)
        if self.ema_decay is not None:
            codebook_loss = torch.zeros_like(codebook_loss)
        straight_through = encodings + (vectors - encodings).detach()
        terms = {"codebook": Term(codebook_loss), "commitment": Term(commitment_loss, self.commitment)}
        return Skill(straight_through, codes, terms)

    @torch.no_grad()
    def _observe(self, encodings: Tensor, codes: Tensor) -> None:
        """Update the running usage of each code and, with EMA, move the vectors."""
        encodings = encodings.to(self.usage)  # which has the precision of the weights
        counts = _of_all(torch.bincount(codes, minlength=self.num_skills).to(encodings))  # (K,)
        self.usage.lerp_(counts / counts.sum(), 0.02)
        if self.ema_decay is None:
            return
        sums = _of_all(torch.zeros_like(self.ema_sum).index_add_(0, codes, encodings))  # (K, D)
        self.ema_count.lerp_(counts, 1.0 - self.ema_decay)
        self.ema_sum.lerp_(sums, 1.0 - self.ema_decay)
        # Laplace smoothing, so that a code without members keeps a finite vector.
        total = self.ema_count.sum()
        smoothed = (self.ema_count + 1e-5) / (total + self.num_skills * 1e-5) * total
        self.vectors.copy_(self.ema_sum / smoothed[:, None])

    @torch.no_grad()
    def set_vectors(self, rows: Tensor, vectors: Tensor) -> None:
        """Put ``vectors`` (R, D) into ``rows`` (R,) and reset their usage to the uniform share."""
        self.vectors[rows] = vectors.to(self.vectors)
        self.usage[rows] = 1.0 / self.num_skills
        if self.ema_decay is not None:
            self.ema_count[rows] = 1.0
            self.ema_sum[rows] = vectors.to(self.ema_sum)

    def start(self, encodings: Callable[[], Tensor]) -> None:
        """As `Bottleneck.start`: by k-means."""
        if not bool(self.initted):
            self.start_from(encodings())

    @torch.no_grad()
    def start_from(self, encodings: Tensor, seed: int = 0) -> None:
        """Start the vectors at the k-means centres of encodings (N, D), N >= K."""
        from scipy.cluster.vq import kmeans2

        points = encodings.detach().float().cpu().numpy()
        centres, _ = kmeans2(points, self.num_skills, iter=30, minit="++", rng=seed)
        self.set_vectors(
            torch.arange(self.num_skills, device=self.vectors.device),
            torch.as_tensor(centres, device=self.vectors.device),
        )
        self.initted.fill_(True)

    def revive(
        self, encodings: Callable[[], Tensor], threshold: float, generator: torch.Generator
    ) -> Mapping[nn.Parameter, Tensor]:
        """As `Bottleneck.revive`: by `restart_dead`."""
        return {self.vectors: self.restart_dead(encodings(), threshold, generator)}

    def health(self) -> Mapping[str, Tensor]:
        """Return ``perplexity`` and ``codes_used`` of the running usage; a code in use has a tenth of 1/K or more."""
        in_use = self.usage >= 0.1 * self.usage.sum() / self.num_skills  # a restart leaves the sum above 1
        return {"perplexity": perplexity(self.usage), "codes_used": in_use.sum().float()}

    @torch.no_grad()
    def restart_dead(self, encodings: Tensor, threshold: float, generator: torch.Generator) -> Tensor:
        """Move each code whose share fell under ``threshold / K`` to an encoding that is badly served now.

        Args:
            encodings: (N, D) to choose from; far ones are likelier, as in k-means++.
            threshold: Share of uniform usage under which a code counts as dead.
            generator: The random stream, so that training stays reproducible.

        Returns:
            (R,) the rows that were moved.
        """
        dead = torch.nonzero(self.usage < threshold / self.num_skills).flatten()
        if dead.numel() == 0:
            return dead
        distance = torch.cdist(encodings.float(), self.vectors.float()).min(dim=1).values
        weights = (distance.square() + 1e-12).cpu()
        chosen = torch.multinomial(weights, min(dead.numel(), len(weights)), generator=generator)
        dead = dead[: chosen.numel()]
        self.set_vectors(dead, encodings[chosen.to(encodings.device)])
        return dead


def _of_all(values: Tensor) -> Tensor:
    """Sum over the processes of a distributed training; every process has its own part of a batch."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.all_reduce(values)
    return values
