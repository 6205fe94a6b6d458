"""Fine-tuning: start from the weights of a checkpoint, train some parts of them, each at its own rate.

`init_from` starts a *new* training from weights; continuing an old one exactly is Lightning's `ckpt_path`, and the
two never mix. The starting checkpoint is read when the module is created and is not one of its settings:
what the training saves loads and resumes without it.

- Settings that shape the network must be the checkpoint's (`SHAPE` of each module); the command line takes those that
  are not given from it. Observations and actions may have other dimensions: then only what fits is loaded, and a
  warning lists what was not.
- The statistics of observations and actions are the checkpoint's if all of them fit, otherwise the new data's;
  `refit_normaliser` always takes the new data's.
- Parts that are not `trainable` do not change by a bit: no gradient, no dropout, no running averages, no restart of
  dead codes. A frozen part that does not fit is refused, because it would stay random.
- The other statistics of a policy, support of the codes and range of values, are always the new data's.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dds_lightning.errors import UserError
from dds_lightning.saving.fingerprint import cure_of_old, same, told_apart

if TYPE_CHECKING:
    from dds_lightning.module import StageModule

log = logging.getLogger(__name__)

STATISTICS = ("normaliser.", "action_box.")
"""Buffers that hold statistics; loaded together or not at all."""


def read(cls: type[StageModule], path: str) -> StageModule:
    """Read the module in a checkpoint without running code from it; the random streams stay untouched.

    Raises:
        UserError: The checkpoint is missing, damaged, or of another kind.
    """
    try:
        with torch.random.fork_rng(devices=[]):
            return cls.load(path)
    except UserError as error:
        expected = f"expected a .ckpt or a published directory of stage {cls.STAGE}"
        raise UserError(f"model.init_from is {path}, {expected}: {error}") from None


def start_from(module: StageModule, path: str) -> None:
    """Load everything that fits from the checkpoint at `path`, and warn about what does not.

    Raises:
        UserError: The checkpoint is missing, damaged, of another kind or of another shape, or a frozen part of
            `module` does not fit it.
    """
    source = read(type(module), path)
    if not bool(source.normaliser.fitted):
        raise UserError(f"model.init_from: {path} was saved before its training began: give a trained checkpoint")
    refuse_other_shape(module, source, path)
    refuse_other_skills(module, source, path)
    ours, theirs = module.state_dict(), source.state_dict()
    if "bottleneck.ema_sum" in ours and "bottleneck.ema_sum" not in theirs:
        # Running averages begin at the vectors, or the first step would reset those to random ones.
        theirs["bottleneck.ema_sum"] = theirs["bottleneck.vectors"].clone()
        theirs["bottleneck.ema_count"] = torch.ones_like(ours["bottleneck.ema_count"])
    left = {name for name in ours if name in module.OF_DATA}
    optional = tuple(f"{name}." for name in module.OPTIONAL)
    left |= {name for name in ours if name.startswith(optional) and name not in theirs}
    shapes = {name: value.shape for name, value in theirs.items()}
    misfits = [name for name, value in ours.items() if name not in left and shapes.get(name) != value.shape]
    if module.hparams.get("refit_normaliser") or any(name.startswith(STATISTICS) for name in misfits):
        left |= {name for name in ours if name.startswith(STATISTICS)}
    frozen = tuple(f"{name}." for name in module.frozen_modules)
    _refuse_random(module, [name for name in misfits if name.startswith(frozen)], path)
    used = [name for name in module.frozen_modules if name != "bottleneck"]  # codes do not depend on statistics
    if used and module.hparams.get("refit_normaliser"):
        raise UserError(
            f"model.refit_normaliser is True, but what is frozen ({', '.join(used)}) expects the statistics it was "
            "trained with: leave it false, or train all of it"
        )
    loaded = {name: theirs[name] for name in ours if name not in left and name not in misfits}
    for name, value in loaded.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise UserError(f"model.init_from: {path} holds numbers in {name} that are not finite: take an earlier one")
    module.load_state_dict(loaded, strict=False)
    log.info("started from %s: %d of %d tensors", path, len(loaded), len(ours))
    if misfits:
        listed = "; ".join(f"{name} {_shapes(theirs.get(name), ours[name])}" for name in misfits)
        others = [name for name in ours if name in left and name not in misfits]
        data = f"; {len(others)} come from the new data: {', '.join(others)}" if others else ""
        warnings.warn(
            f"model.init_from: {path} fits in {len(loaded)} of {len(ours)} tensors{data}; {len(misfits)} start anew "
            f"(shape there, here): {listed}",
            stacklevel=2,
        )


def refuse_other_shape(module: StageModule, source: StageModule, path: str) -> None:
    """Refuse a source whose network has another shape, naming every setting that differs."""
    there, here = dict(source.hparams), dict(module.hparams)
    differing = [name for name in module.SHAPE if _plain(there[name]) != _plain(here[name])]
    if differing:
        found = ", ".join(f"model.{name} is {_plain(here[name])}" for name in differing)
        was = ", ".join(f"{_plain(there[name])}" for name in differing)
        remedy = " ".join(
            f"--{'data' if name == 'horizon' else 'model'}.{name}={_plain(there[name])}" for name in differing
        )
        chosen = {"num_skills", "choices", "space"}.intersection(differing)  # what follows from the skills
        if chosen and module.STAGE != "skill":
            remedy = "the skill model of that policy (data.skill)"
            remedy += " or its kind of actions (data.actions)" if "space" in chosen else ""
        raise UserError(
            f"{found}, but model.init_from {path} was trained with {was}: give {remedy}, or train from scratch"
        )


def refuse_other_skills(module: StageModule, source: StageModule, path: str) -> None:
    """Refuse a policy that chose among the codes of another skill model: there the same numbers mean other skills."""
    # What a checkpoint's own decoder learnt belongs to it; where one is about to learn, the data say what it begins as.
    there, here = source.skill_hash, module.hparams.get("skill_hash")
    if there and here and not same(there, here, module.OF_DECODER):
        was, found = told_apart(there, here)
        raise UserError(
            f"data.skill is skill model {found}, but model.init_from {path} was trained on the codes of skill model "
            f"{was}: give that one as data.skill, or start anew{cure_of_old(there, here, module.OF_DECODER)}"
        )


def refuse_other_box(module: Any, datamodule: Any) -> None:
    """After a start from a checkpoint, refuse data whose actions have other bounds than those that were kept."""
    if module.init_from is None or not hasattr(datamodule, "statistics"):
        return
    box, statistics = module.action_box, datamodule.statistics()
    for name, kept in (("low", box.low), ("high", box.high)):
        found = statistics[f"action_{name}"].to(kept)
        if not torch.equal(found, kept):
            raise UserError(
                f"the data's actions have {name} bounds {found.tolist()}, those of model.init_from "
                f"{module.init_from} have {kept.tolist()}: give --model.refit_normaliser=true, or data of that robot"
            )


def _refuse_random(module: StageModule, names: Sequence[str], path: str) -> None:
    if names:
        parts = [p for p, modules in module.PARTS.items() if {n.split(".")[0] for n in names} & set(modules)]
        raise UserError(
            f"model.trainable is {module.hparams.trainable}, but {', '.join(names)} of {path} does not fit, and frozen "
            f"it would stay random: train {' and '.join(parts)} too"
        )


def _shapes(there: Tensor | None, here: Tensor) -> str:
    return f"{'none' if there is None else tuple(there.shape)}, {tuple(here.shape)}"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, (list, tuple)) else value
