"""Lightning's private names that this project relies on: each listed here, where it is used, and its signature.

Private names may change with any version. If a test below fails after an upgrade, look at the file in `used_in`.
"""

import ast
import inspect
import re
from pathlib import Path
from typing import Any, NamedTuple

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, ProgressBar
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy

ROOT = Path(__file__).parents[1]


class Private(NamedTuple):
    """One private name."""

    owner: Any
    name: str
    used_in: str
    parameters: tuple[str, ...] | None
    """Of the method, without `self`; None for an attribute or a compiled function."""


CONTRACT = [
    Private(ModelCheckpoint, "_monitor_candidates", "callbacks/best.py", ("trainer",)),
    Private(ModelCheckpoint, "_should_skip_saving_checkpoint", "callbacks/best.py", ("trainer",)),
    Private(ModelCheckpoint, "_remove_checkpoint", "callbacks/best.py", ("trainer", "filepath")),
    Private(ModelCheckpoint, "_save_topk_checkpoint", "callbacks/best.py", ("trainer", "monitor_candidates")),
    Private(ModelCheckpoint, "_every_n_train_steps", "callbacks/rollouts.py", None),
    Private(LightningCLI, "_parse_ckpt_path", "training/stage_cli.py", ()),
    Private(LightningCLI, "_set_seed", "training/stage_cli.py", ()),
    Private(LightningCLI, "_parser", "training/stage_cli.py", ("subcommand",)),
    Private(LightningCLI, "_instantiate_trainer", "training/stage_cli.py", ("config", "callbacks")),
    Private(LightningCLI, "_run_subcommand", "training/stage_cli.py", ("subcommand",)),
    Private(LightningCLI, "_prepare_subcommand_kwargs", "training/stage_cli.py", ("subcommand",)),
    Private(DDPStrategy, "_ddp_kwargs", "training/stage_cli.py", None),
    Private(torch, "_assert_async", "callbacks/guard.py", None),
    Private(torch, "_foreach_lerp_", "policy.py", None),
]
OWNERS = (
    *(pl.LightningModule, pl.LightningDataModule, pl.Trainer, pl.Callback),
    *(Checkpoint, ModelCheckpoint, ProgressBar, LightningCLI, TorchCheckpointIO),
)
"""Classes of Lightning that the project uses or extends."""


def private_names(owner: type) -> set[str]:
    """Private methods and attributes of a class of Lightning, those that only its methods assign included."""
    classes = [cls for cls in owner.__mro__ if cls.__module__.startswith("lightning.")]
    assigned = {name for cls in classes for name in re.findall(r"self\.(_[a-z]\w*)", inspect.getsource(cls))}
    return assigned | {name for cls in classes for name in vars(cls) if re.match(r"_[a-z]", name)}


def names_in(path: Path) -> set[str]:
    """Private names that a file reads, calls or overrides."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "getattr" and len(node.args) > 1:
            found |= {node.args[1].value} if isinstance(node.args[1], ast.Constant) else set()
    return {name for name in found if re.match(r"_[a-z]", str(name))}


@pytest.mark.parametrize("private", CONTRACT, ids=lambda private: f"{private.owner.__name__}.{private.name}")
def test_the_installed_version_has_the_name_with_this_signature(private):
    where = f"{private.owner.__name__}.{private.name}, which dds_lightning/{private.used_in} uses,"
    known = private_names(private.owner) if inspect.isclass(private.owner) else set(vars(private.owner))
    assert private.name in known, f"{where} is missing in Lightning {pl.__version__}, torch {torch.__version__}"
    if private.parameters is not None:
        _, *parameters = inspect.signature(getattr(private.owner, private.name)).parameters
        assert tuple(parameters) == private.parameters, f"{where} takes other arguments in Lightning {pl.__version__}"


def test_attributes_that_are_read_exist_on_a_new_object():
    assert ModelCheckpoint(every_n_train_steps=7)._every_n_train_steps == 7


@pytest.mark.parametrize("private", CONTRACT, ids=lambda private: private.name)
def test_the_list_names_what_is_still_used(private):
    assert private.name in names_in(ROOT / "dds_lightning" / private.used_in), f"delete {private.name} from CONTRACT"


def test_no_file_uses_a_private_name_of_lightning_that_is_not_listed():
    """This also catches an attribute of ours that would overwrite one of Lightning's."""
    private = set().union(*map(private_names, OWNERS))
    listed = {(one.used_in, one.name) for one in CONTRACT}
    found = []
    for package in ("dds_lightning", "datamodules"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "lightning.pytorch" not in text and "StageModule" not in text:
                continue
            file = str(path.relative_to(ROOT / "dds_lightning")) if package == "dds_lightning" else str(path)
            found += [f"{file}: {name}" for name in names_in(path) & private if (file, name) not in listed]
    assert found == [], "add these to CONTRACT, or rename what is ours"
