"""The ranges of settings that networks of all stages share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Rule = tuple[str, bool, str]
"""A setting's name, whether its value is allowed, and what is expected."""


def _count(value: Any) -> bool:
    return value >= 1


_RANGES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "hidden_dims": (lambda widths: all(width >= 1 for width in widths), "widths of at least 1"),
    **dict.fromkeys(("hidden_dim", "layers", "blocks", "heads", "diffusion_steps"), (_count, "at least 1")),
    "dropout": (lambda rate: 0 <= rate < 1, "in [0, 1)"),
    "fourier_features": (lambda count: count >= 0, "0 (none) or more"),
    "fourier_scale": (lambda scale: scale > 0, "positive"),
}


def network_rules(settings: Mapping[str, Any]) -> list[Rule]:
    """The rules for those of the settings that have one, whatever the stage."""
    rules = [(name, fits(settings[name]), text) for name, (fits, text) in _RANGES.items() if name in settings]
    if "fourier_seen" in settings:
        width = settings["observation_dim"]
        rules.append(("fourier_seen", 0 <= settings["fourier_seen"] <= width, f"in [0, {width}]"))
    return rules
