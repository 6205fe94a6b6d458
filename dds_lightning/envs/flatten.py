"""From what environments give to flat numbers, and what to say where that cannot be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError


def flatten(observation: Mapping[str, Any], keys: Sequence[str]) -> NDArray[Any]:
    """Put entries of a dictionary observation end to end, (O,), in the order of `keys`."""
    return np.concatenate([np.ravel(observation[key]) for key in keys])


def numbers(observations: Any) -> NDArray[np.float32]:
    """Return observations as finite 32-bit numbers, of any shape.

    Raises:
        UserError: They are a dictionary, no numbers, or not finite.
    """
    if isinstance(observations, Mapping):
        raise UserError(
            f"observations are a dictionary of {', '.join(map(str, observations))}, expected one array: flatten them "
            "as in the training data; `get_task(NAME).make_env()` gives them flat"
        )
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(observations, dtype=np.float32)
    except (TypeError, ValueError):
        kind = type(observations).__name__
        pair = ": reset returns them and a dictionary, give the first" if isinstance(observations, tuple) else ""
        raise UserError(f"observations are a {kind}, expected an array of numbers{pair}") from None
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0]
        raise UserError(
            f"observations hold {array[tuple(place)]} at {place.tolist()}, expected finite numbers: nothing sensible "
            "can be done there"
        )
    return array
