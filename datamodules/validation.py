"""Checks of data sets. Every error names the data set, the episode, the field and the value.

File formats accept almost anything (NaN, one observation too few, episodes without an end), and a learner trained
on such data fails late and silently. So all data pass these checks before they become `Trajectories`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError

FIELDS = ("observations", "actions", "rewards", "terminations", "truncations")
BOX_TOLERANCE = 1e-5
"""Actions may exceed their box by this much (rounding); they are clipped to it."""

SLICE = 2**20
"""Rows of a stored array that are checked at a time."""


class DataError(UserError):
    """A data set that cannot be used as it is."""


def validate_episode(
    dataset: str,
    episode: str,
    fields: Mapping[str, Any],
    *,
    observation_dim: int | None,
    action_low: NDArray[np.float32],
    action_high: NDArray[np.float32],
) -> dict[str, NDArray[Any]]:
    """Check one episode and convert it to the types of `Trajectories`.

    Args:
        dataset: Name of the data set, for messages.
        episode: Name of the episode, for messages.
        fields: `FIELDS` to arrays; observations (T + 1, O), actions (T, A), the rest (T,).
        observation_dim: O; None accepts any width.
        action_low: (A,) lower bounds of the action box.
        action_high: (A,) upper bounds.

    Returns:
        The five arrays: float32 for numbers, bool for flags, actions clipped into the box.

    Raises:
        DataError: At the first problem.
    """
    where = f"data set '{dataset}', {episode}"
    for name in FIELDS:
        if name not in fields or fields[name] is None:
            found = ", ".join(fields) or "nothing"
            raise DataError(f"{where}: '{name}' is missing; expected {', '.join(FIELDS)}, got {found}; add it")
    arrays = {name: _array(where, name, fields[name]) for name in FIELDS}
    _check_shapes(where, arrays, observation_dim, len(action_low))
    for name in ("observations", "actions", "rewards"):
        arrays[name] = finite(f"{where}, {name}", arrays[name])
    arrays["actions"] = in_box(f"{where}, actions", arrays["actions"], action_low, action_high)
    _check_ends(where, arrays)
    return arrays


def _array(where: str, name: str, value: Any) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    flag = name in ("terminations", "truncations")
    if array.dtype.kind not in ("b" if flag else "fiu") and not (flag and array.dtype.kind in "iu"):
        expected = "true and false" if flag else "real numbers"
        if name == "observations" and (isinstance(value, Mapping) or any(isinstance(x, Mapping) for x in value)):
            raise DataError(
                f"{where}, observations: got dictionaries, expected (steps + 1, O) numbers; put their entries end to "
                "end, as an environment of a task file with observation_keys gives them"
            )
        raise DataError(f"{where}, {name}: got values of type {array.dtype}, expected {expected}; convert them")
    if flag and array.dtype.kind != "b":
        odd = array[(array != 0) & (array != 1)]
        if odd.size:
            raise DataError(f"{where}, {name}: got {odd.flat[0]}, expected 0 or 1; convert them to true and false")
        return array.astype(bool)
    return array


def _check_shapes(where: str, arrays: dict[str, NDArray[Any]], observations: int | None, actions: int) -> None:
    steps = len(arrays["rewards"]) if arrays["rewards"].ndim else 0
    for name, width in (("observations", observations), ("actions", actions)):
        shape = arrays[name].shape
        if len(shape) != 2 or shape[1] != (shape[1] if width is None else width):
            expected = "(steps, width)" if width is None else f"(steps, {width})"
            remedy = "stack one row per step"
            if len(shape) == 1 and name == "actions" and arrays[name].dtype.kind in "iu":
                remedy = (
                    "whole numbers look like discrete actions, which are not supported: skills make continuous ones"
                )
            elif len(shape) == 1 and width in (None, 1):
                remedy += f", also where it is a single number: {name}.reshape(-1, 1)"
            raise DataError(f"{where}, {name}: got shape {shape}, expected {expected}; {remedy}")
    for name in ("rewards", "terminations", "truncations"):
        if arrays[name].ndim != 1:
            raise DataError(
                f"{where}, {name}: got shape {arrays[name].shape}, expected (steps,); give one value per step"
            )
    if steps == 0:
        raise DataError(f"{where}, rewards: got 0 steps, expected at least 1; leave the episode out")
    for name in ("actions", "terminations", "truncations"):
        if len(arrays[name]) != steps:
            raise DataError(
                f"{where}, {name}: got {len(arrays[name])} rows, but rewards has {steps}; give one of each per step"
            )
    seen = len(arrays["observations"])
    if seen != steps + 1:
        lacking = "the observation after the last step is missing: append it, or leave out the last step"
        missing = f"; {lacking if seen == steps else 'cut them to the same steps'}"
        raise DataError(f"{where}, observations: got {seen} rows, expected {steps + 1} (T + 1){missing}")


def finite(where: str, array: NDArray[Any], *, first: int = 0, unit: str = "step") -> NDArray[np.float32]:
    """Numbers as float32.

    Args:
        where: Data set, episode and field, as messages begin.
        array: (N,) or (N, columns).
        first: Number of the first row, where `array` is part of a longer array.
        unit: Name of a row in messages.

    Raises:
        DataError: For numbers that are not finite, or too large for 32 bits.
    """
    with np.errstate(over="ignore"):
        single = array.astype(np.float32)
    bad = np.argwhere(~np.isfinite(single))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        place = f"{unit} {first + index[0]}" + (f", column {index[1]}" if len(index) > 1 else "")
        raise DataError(
            f"{where}: got {array[index]} at {place}, expected finite 32-bit numbers; leave that {unit} out"
        )
    return single


def in_box(
    where: str,
    actions: NDArray[np.float32],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
    *,
    first: int = 0,
    unit: str = "step",
) -> NDArray[np.float32]:
    """Actions clipped to their box, which they may exceed by `BOX_TOLERANCE`.

    Args:
        where: See `finite`.
        actions: (N, A).
        low: (A,).
        high: (A,).
        first: See `finite`.
        unit: See `finite`.

    Raises:
        DataError: For actions that exceed it by more.
    """
    outside = np.argwhere((actions < low - BOX_TOLERANCE) | (actions > high + BOX_TOLERANCE))
    if len(outside):
        t, j = (int(i) for i in outside[0])
        raise DataError(
            f"{where}: got {actions[t, j]:g} at {unit} {first + t}, column {j}, expected {low[j]:g} to {high[j]:g}; "
            "for another box give action_low and action_high, to from_episodes or in the task file"
        )
    return np.clip(actions, low, high)


def check_box(where: str, low: NDArray[np.float32], high: NDArray[np.float32]) -> None:
    """Refuse bounds of actions, each (A,), that are not finite or the wrong way round.

    Raises:
        DataError: Names the first column where they are.
    """
    wrong = np.flatnonzero(~(np.isfinite(low) & np.isfinite(high) & (low < high)))
    if len(wrong):
        j = int(wrong[0])
        raise DataError(
            f"{where}, action_low and action_high: got {low[j]:g} and {high[j]:g} in column {j}, expected finite "
            "bounds, the lower one below"
        )


def validate_arrays(dataset: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Check all episodes of a data set that is stored as flat arrays, a slice at a time.

    Args:
        dataset: Name of the data set, for messages.
        arrays: The arrays of a `Trajectories`, of its types.

    Raises:
        DataError: At the first problem; see `validate_episode`.
    """
    where, lengths = f"data set '{dataset}'", arrays["lengths"]
    low, high = arrays["action_low"], arrays["action_high"]
    steps = len(arrays["rewards"]) if arrays["rewards"].ndim else 0
    if lengths.ndim != 1 or not len(lengths) or lengths.min() < 1 or lengths.max() > steps:
        raise DataError(f"{where}, lengths: got shape {lengths.shape}, expected some numbers of 1 to {steps} steps")
    if lengths.sum() != steps:
        raise DataError(f"{where}, lengths: they add up to {lengths.sum()}, expected {steps}")
    rows = {"observations": steps + len(lengths), "actions": steps}
    rows |= dict.fromkeys(("rewards", "terminations", "truncations"), steps)
    for name, expected in rows.items():
        shape, wide = arrays[name].shape, name in ("observations", "actions")
        if len(shape) != 1 + wide or shape[0] != expected or 0 in shape:
            told = f"({expected}, width)" if wide else f"({expected},)"
            raise DataError(f"{where}, {name}: got shape {shape}, expected {told}")
    if low.shape != high.shape or low.shape != arrays["actions"].shape[1:]:
        raise DataError(f"{where}, action_low: got {low.shape} and {high.shape}, expected one bound a column")
    check_box(where, low, high)
    for name, expected in rows.items():
        for first in range(0, expected, SLICE):
            part = arrays[name][first : first + SLICE]
            if part.dtype == np.bool_:
                if part.view(np.uint8).max() > 1:
                    raise DataError(f"{where}, {name}: got a byte {part.view(np.uint8).max()}, expected 0 or 1")
                continue
            finite(f"{where}, {name}", part, first=first, unit="row")
            if name == "actions":
                in_box(f"{where}, actions", part, low, high, first=first)
    last = np.cumsum(lengths) - 1
    ended = arrays["terminations"] | arrays["truncations"]
    early = np.setdiff1d(np.flatnonzero(ended), last, assume_unique=True)
    if len(early):
        raise DataError(f"{where}: an end at step {early[0]}, inside an episode; expected ends on last steps only")
    if not ended[last].all():
        number = int(np.flatnonzero(~ended[last])[0])
        raise DataError(
            f"{where}, episode {number}: never ends: terminations and truncations are False on its last step"
        )


def _check_ends(where: str, arrays: dict[str, NDArray[Any]]) -> None:
    for name in ("terminations", "truncations"):
        early = np.flatnonzero(arrays[name][:-1])
        if len(early):
            raise DataError(
                f"{where}, {name}: got True at step {early[0]}, inside an episode of {len(arrays[name])} "
                "steps, expected it on the last step only; divide the episode there"
            )
    if not (arrays["terminations"][-1] or arrays["truncations"][-1]):
        raise DataError(
            f"{where}: never ends: terminations and truncations are both False on the last step, expected one of them "
            "True; set truncations there if only the recording ended"
        )
