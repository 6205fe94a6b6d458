"""Values that Lightning's Trainer takes and should not."""

from collections.abc import Callable, Mapping
from typing import Any

from dds_lightning.errors import UserError

HALF = ("16-true", "bf16-true", "transformer-engine", "transformer-engine-float16")
RULES: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("val_check_interval", lambda value: value != 0, "a number of batches, a share of an epoch, or a time"),
    ("check_val_every_n_epoch", lambda value: value >= 1, "at least 1, or null to count batches across epochs"),
    ("accumulate_grad_batches", lambda value: value >= 1, "at least 1"),
    ("limit_train_batches", lambda value: value > 0, "more than 0: otherwise nothing would be trained"),
    ("max_steps", lambda value: value >= -1, "at least 0, or -1 for no end"),
    ("log_every_n_steps", lambda value: value >= 0, "at least 0"),
    ("precision", lambda value: value not in HALF, "bf16-mixed or 16-mixed: distances to codes need 32-bit weights"),
    ("gradient_clip_val", lambda value: value >= 0, "at least 0, or null: a negative one turns gradients round"),
    ("num_sanity_val_steps", lambda value: value >= -1, "at least 0, or -1 for all"),
    ("num_nodes", lambda value: value >= 1, "at least 1"),
)
"""Settings of the Trainer that fail in the middle of a training, or with which nothing happens, without a word."""


def refuse_values(config: Mapping[str, Any]) -> None:
    """Refuse values that break one of `RULES`.

    Args:
        config: Settings of the Trainer, all or some.

    Raises:
        UserError: Names the first.
    """
    for name, allowed, expected in RULES:
        if config.get(name) is not None and not allowed(config[name]):
            raise UserError(f"trainer.{name} is {config[name]}, expected {expected}")
