"""Codes of training segments that no longer change, so that each segment is encoded once."""

from collections.abc import Callable, Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from dds_lightning.nn.bottleneck import Skill


class SettledCodes(pl.Callback):
    """Remember the codes of a training's segments from when neither encoder nor codebook learns.

    They are part of a checkpoint, so that a training that goes on need not rely on products of other batches rounding
    alike. They belong to one training: a new one starts without any.
    """

    def __init__(self) -> None:
        self._codes = torch.empty(0, dtype=torch.int16)  # by the row of the data where a segment starts; -1 unknown

    @torch.no_grad()
    def skills(self, module: Any, batch: Mapping[str, Tensor]) -> Skill | None:
        """Return the skills of a training batch where encoder and codebook of a `SkillModule` stand still, else None.

        What the bottleneck adds to the loss is left out: nothing that still learns could change it.
        """
        if not (module.training and module.discrete and {"encoder", "bottleneck"} <= set(module.frozen_modules)):
            return None

        def encode() -> Tensor:
            codes: Tensor = module.encode(batch["observations"], batch["actions"])
            return codes

        codes = self._known(batch["starts"], encode) if "starts" in batch else encode()
        return Skill(module.vectors(codes), codes, {})

    def _known(self, starts: Tensor, encode: Callable[[], Tensor]) -> Tensor:
        """Look up codes (B,) by their segments' first rows in the data (B,), or compute them."""
        self._codes = self._codes.to(starts.device)  # those of a checkpoint come on the CPU
        rows = int(starts.max()) + 1
        if rows > len(self._codes):
            more = max(rows, 2 * len(self._codes)) - len(self._codes)
            unknown = torch.full((more,), -1, dtype=torch.int16, device=starts.device)
            self._codes = torch.cat([self._codes, unknown])
        codes = self._codes[starts].long()
        if bool((codes < 0).any()):
            codes = encode()
            self._codes[starts] = codes.to(torch.int16)
        return codes

    def state_dict(self) -> dict[str, Any]:
        """Return the codes known so far."""
        return {"codes": self._codes.cpu()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with the codes of a checkpoint."""
        self._codes = state_dict["codes"].clone()
