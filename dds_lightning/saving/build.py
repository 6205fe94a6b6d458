"""Builds a module from settings and weights of a file, within what the weights allow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from dds_lightning.errors import UserError, reason

DEEPEST, WIDEST, NOISIEST = 256, 65_536, 1000
"""Layers of a network, width of a layer, and denoising steps that a file may ask for."""
_SHAPES = ("_dim", "_dims", "_heads", "_layers", "_blocks")

M = TypeVar("M", bound=nn.Module)


def build_module(cls: type[M], settings: Mapping[str, Any], state: Mapping[str, Tensor], origin: str) -> M:
    """Build a module and load its weights, in evaluation mode on the CPU.

    Args:
        cls: Class of the module; its `SHAPE` names the settings that shape it.
        settings: Its arguments. Names of code that Lightning's command line stores are not followed.
        state: Its weights.
        origin: The file, for messages.

    Raises:
        UserError: The settings are not those of a `cls`, or the weights do not fit them, or are not finite.
    """
    settings = {key: value for key, value in settings.items() if not str(key).startswith("_")}
    refuse_unbearable(cls, settings, state, origin)
    try:
        with torch.device("meta"):  # takes no memory, whatever widths a file names
            own = cls(**settings).state_dict()
    except TypeError as error:
        told = str(error).replace("__init__()", "it").replace(f"{cls.__name__}.", "")
        raise UserError(f"{origin} does not hold a {cls.__name__} of this version: {told}") from None
    except UserError as error:
        raise UserError(f"{origin}: {error}") from None
    except Exception as error:  # arguments of any kind reach torch
        told = f"{type(error).__name__}: {reason(error)[:200]}"
        raise UserError(f"{origin} holds settings with which no {cls.__name__} can be built: {told}") from None
    missing, unknown = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    if missing or unknown:
        lists = ((what, names) for what, names in (("lacks", missing), ("has unknown", unknown)) if names)
        text = " and ".join(f"{what} {', '.join(names[:3])}{' ...' if names[3:] else ''}" for what, names in lists)
        raise UserError(f"{origin} does not fit {cls.__name__}: it {text}")
    for name, value in state.items():
        if value.shape != own[name].shape:
            shapes = f"{tuple(value.shape)}, expected {tuple(own[name].shape)}"
            raise UserError(f"{origin} does not fit {cls.__name__}: {name} is {shapes}")
        if value.dtype != own[name].dtype:
            raise UserError(f"{origin} does not fit {cls.__name__}: {name} is {value.dtype}, not {own[name].dtype}")
    module = cls(**settings)
    learnt = {name for name, _ in module.named_parameters()}
    for name, value in state.items():
        bad = ~torch.isfinite(value) if name in learnt else torch.isnan(value)  # a buffer may say "no bound"
        if bool(bad.any()):
            found = "NaN" if bool(torch.isnan(value).any()) else "infinity"
            raise UserError(f"{origin} holds {found} in {name}: its training diverged; take an earlier checkpoint")
    module.load_state_dict(state)
    return module.eval()


def refuse_unbearable(
    cls: type[nn.Module], settings: Mapping[str, Any], state: Mapping[str, Tensor], origin: str
) -> None:
    """Refuse settings whose module would be deeper or wider than the weights of its file allow, before it is built.

    Raises:
        UserError: See above; or a setting that names another file.
    """
    if settings.get("init_from") is not None:
        raise UserError(f"{origin} sets init_from to {settings['init_from']!r}, expected a model that stands by itself")
    widest = max((length for value in state.values() for length in value.shape), default=0)
    for name, value in settings.items():
        numbers = value if isinstance(value, (list, tuple)) else [value]
        if name.endswith(("_layers", "_blocks")):
            limit = min(DEEPEST, len(state))
        elif name == "diffusion_steps":
            limit = NOISIEST
        elif name in getattr(cls, "SHAPE", ()) or name.endswith(_SHAPES):
            limit = min(WIDEST, max(widest, 1000))
        else:
            continue
        if len(numbers) > min(DEEPEST, len(state)):
            raise UserError(f"{origin} sets {name} to {len(numbers)} layers, more than its {len(state)} tensors allow")
        for number in numbers:
            if isinstance(number, int) and not -limit <= number <= limit:
                raise UserError(f"{origin} sets {name} to {number:,}, expected at most {limit:,}, as its weights allow")
