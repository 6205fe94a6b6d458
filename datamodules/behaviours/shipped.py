"""The trained policies that are shipped."""

from __future__ import annotations

from pathlib import Path

from datamodules.behaviours.policy import MLPPolicy
from dds_lightning.errors import UserError

_PACKAGED = Path(__file__).resolve().parent / "shipped_policies"
SHIPPED = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).resolve().parents[2] / "checkpoints" / "behaviours"
"""The folder of the shipped policies: inside an installed package, or in a checkout of the repository."""


def load_ladder(behaviour: str, directory: str | Path | None = None) -> dict[str, MLPPolicy]:
    """Load a runner's policies, from random to expert.

    Args:
        behaviour: "hopper", "walker2d" or "halfcheetah".
        directory: The folder of the ladders; by default the shipped one.

    Returns:
        Policies by name, with rising scores: "000_random" first, "expert" last. `metadata["score"]` holds the score.

    Raises:
        UserError: There is no such ladder.
        DataError: A file is damaged.
    """
    folder = Path(directory or SHIPPED) / behaviour
    paths = sorted(folder.glob("*.safetensors"))
    if not paths:
        raise UserError(
            f"behaviour: {folder} holds no policies; train them with python -m datamodules.behaviours.train and "
            "publish them, or pass another directory"
        )
    return {path.stem: MLPPolicy.load(path) for path in paths}
