"""Gymnasium's interface, and what to say of an environment that does not keep to it."""

from __future__ import annotations

import traceback
from typing import Any

import gymnasium as gym

from dds_lightning.errors import UserError

ANSWERS = {
    "reset": "reset(seed=..., options=...) to return two values: observation, info",
    "step": "step(action) to return five values: observation, reward, terminated, truncated, info",
}


def answer_of(env: gym.Env[Any, Any], call: str, *values: Any, **named: Any) -> tuple[Any, ...]:
    """What `env.reset` or `env.step` returns: as many values as Gymnasium says, the last of them a dictionary.

    Args:
        env: The environment, in Gymnasium's wrappers.
        call: A name of `ANSWERS`.
        *values: Arguments of the call.
        **named: The same.

    Raises:
        UserError: The environment has another interface, for example the four values of the old Gym.
    """
    try:
        answer = getattr(env, call)(*values, **named)
    except (TypeError, ValueError) as error:
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
        if frames[-1].f_globals.get("__name__", "").partition(".")[0] != "gymnasium":
            raise  # the environment's own mistake, which its author finds by the traceback
        raise _refusal(env, call, str(error)) from None
    count = 2 if call == "reset" else 5
    if not isinstance(answer, tuple) or len(answer) != count or not isinstance(answer[-1], dict):
        shown = f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"
        raise _refusal(env, call, f"it returns {shown}")
    return answer


def _refusal(env: gym.Env[Any, Any], call: str, found: str) -> UserError:
    kind = type(env.unwrapped)
    return UserError(
        f"{kind.__module__}.{kind.__qualname__} does not keep to Gymnasium's interface ({found}): expected "
        f"{ANSWERS[call]}"
    )
