"""Segment encoders: (B, H, O) states and (B, H, A) actions to one vector a segment (appendix A.1.1).

```
 s_1 a_1   s_2 a_2   ...   s_H a_H        concatenated along the last dimension
    └─ linear embedding ─┘  + learnable positions
    └─ 4 transformer layers (or a bidirectional GRU of the same size) ─┘
    └─ average over the steps ─┘
    └─ linear, ReLU, linear ─►  E(tau)  (B, D)
```
"""

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from dds_lightning.nn.dropout import Dropout


def step_mask(lengths: Tensor, horizon: int) -> Tensor:
    """Mark the steps that were really taken: (B,) lengths to a (B, H) boolean mask."""
    return torch.arange(horizon, device=lengths.device) < lengths[:, None]


def masked_mean(features: Tensor, mask: Tensor | None) -> Tensor:
    """Average (B, H, F) over the steps marked in ``mask`` (B, H), over all of them without one."""
    if mask is None:
        return features.mean(dim=1)
    weights = mask.to(features.dtype).unsqueeze(-1)  # (B, H, 1)
    return (features * weights).sum(dim=1) / weights.sum(dim=1)


def projection(hidden_dim: int, output_dim: int) -> nn.Sequential:
    """Two-layer ReLU head from pooled features to the skill space."""
    return nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, output_dim))


class TransformerEncoder(nn.Module):
    """The paper's encoder: embedding, learnable positions, transformer layers, average pooling, projection.

    Args:
        input_dim: O + A.
        output_dim: Width of the result; D for a codebook, 2 D for a Gaussian bottleneck.
        horizon: H, the number of learnable positions.
        hidden_dim: Width of the layers; the feed-forward part is four times as wide.
        layers: Number of transformer layers.
        heads: Attention heads; must divide ``hidden_dim``.
        dropout: Rate inside the layers.
    """

    def __init__(
        self,
        input_dim: int,
        output_dim: int,
        horizon: int,
        hidden_dim: int = 256,
        layers: int = 4,
        heads: int = 8,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.embedding = nn.Linear(input_dim, hidden_dim)
        self.positions = nn.Parameter(0.02 * torch.randn(horizon, hidden_dim))
        layer = nn.TransformerEncoderLayer(hidden_dim, heads, 4 * hidden_dim, dropout, batch_first=True)
        layer.dropout = layer.dropout1 = layer.dropout2 = Dropout(dropout)
        self.layers = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.projection = projection(hidden_dim, output_dim)

    def forward(self, sequence: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Encode segments.

        Args:
            sequence: (B, H, O + A) normalised states and actions.
            lengths: (B,) steps really taken, for segments that the end of an episode cut short.

        Returns:
            (B, output_dim).
        """
        mask = None if lengths is None else step_mask(lengths, sequence.shape[1])
        hidden = self.embedding(sequence) + self.positions  # (B, H, hidden)
        hidden = self.layers(hidden, src_key_padding_mask=None if mask is None else ~mask)
        return self.projection(masked_mean(hidden, mask))


class GRUEncoder(nn.Module):
    """Bidirectional GRU in place of the transformer layers, for the architecture ablation (section 5.4, table 3).

    Everything round the recurrence is the transformer's. The width of the GRU is the one whose parameter count
    lies nearest to that of the transformer layers it replaces.

    Args:
        input_dim: O + A.
        output_dim: Width of the result.
        horizon: H; kept so that both encoders are built alike.
        hidden_dim: Width of the embedding and of the projection.
        layers: Number of stacked GRU layers, and of the transformer layers whose size is matched.
        heads: Ignored by a GRU.
        dropout: Rate between the layers.
    """

    def __init__(
        self,
        input_dim: int,
        output_dim: int,
        horizon: int,
        hidden_dim: int = 256,
        layers: int = 4,
        heads: int = 8,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        del heads
        width = self.matched_width(hidden_dim, layers, horizon)
        self.embedding = nn.Linear(input_dim, hidden_dim)
        self.recurrence = nn.GRU(
            hidden_dim,
            width,
            num_layers=layers,
            batch_first=True,
            bidirectional=True,
            dropout=dropout if layers > 1 else 0.0,
        )
        self.narrow = nn.Linear(2 * width, hidden_dim)
        self.projection = projection(hidden_dim, output_dim)

    @staticmethod
    def matched_width(hidden_dim: int, layers: int, horizon: int) -> int:
        """Width of the GRU whose weights are as many as those of the transformer layers and positions."""
        transformer = layers * (12 * hidden_dim**2 + 13 * hidden_dim) + horizon * hidden_dim

        def gru(width: int) -> int:
            first = 6 * width * (hidden_dim + width + 2)
            rest = (layers - 1) * 6 * width * (3 * width + 2)
            return first + rest + 2 * width * hidden_dim + hidden_dim

        return min(range(4, 4 * hidden_dim), key=lambda width: abs(gru(width) - transformer))

    def forward(self, sequence: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Encode segments; arguments and result as for `TransformerEncoder.forward`."""
        horizon = sequence.shape[1]
        hidden = self.embedding(sequence)  # (B, H, hidden)
        if lengths is None:
            states, _ = self.recurrence(hidden)  # (B, H, 2 width)
            return self.projection(masked_mean(self.narrow(states), None))
        packed = pack_padded_sequence(hidden, lengths.cpu(), batch_first=True, enforce_sorted=False)
        packed, _ = self.recurrence(packed)
        states, _ = pad_packed_sequence(packed, batch_first=True, total_length=horizon)
        return self.projection(masked_mean(self.narrow(states), step_mask(lengths, horizon)))


ENCODERS = {"transformer": TransformerEncoder, "gru": GRUEncoder}
