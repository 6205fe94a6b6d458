"""The smallest trainings on the command line, for tests of what happens around them."""

import contextlib
import os
import shlex
from pathlib import Path

from dds_lightning.cli import main

TASK = "pointmaze-umaze-diverse"
SKILL = ["--model.hidden_dim=16", "--model.skill_dim=8", "--model.encoder_layers=1", "--model.encoder_heads=2"]
SKILL += ["--model.decoder_blocks=1", "--model.num_skills=4", "--data.horizon=5"]
POLICY = ["--model.hidden_dims=[16]", "--model.extraction=joint"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false", "--data.batch_size=32"]
QUIET += ["--trainer.accelerator=cpu", "--trainer.limit_val_batches=1", "--trainer.num_sanity_val_steps=0"]


def call(*words) -> int:
    """Run a command in this process; its standard output goes nowhere."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        return main([str(word) for word in words])


def of_data(root) -> list[str]:
    """Words for 2,000 steps of the smallest maze, collected into a folder."""
    assert call("data", "collect", TASK, "--steps", 2000, "--out", root, "--workers", 1) == 0
    return [f"--data.task={TASK}", f"--data.data=local:{root}/{TASK}-v0", "--data.validation_fraction=0.2"]


def skill_of(data, out: Path, steps: int, *words: str) -> Path:
    """Checkpoint of a skill model trained for some steps in the folder `out`."""
    fit = ["skill", "fit", *data, *QUIET, *SKILL, f"--trainer.max_steps={steps}", *words]
    assert call(*fit, f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}") == 0
    return out / "last.ckpt"


def told(err: str) -> str:
    """The one sentence of error that a command printed."""
    assert "Traceback" not in err
    (line,) = [line for line in err.splitlines() if line.startswith("dds: error: ")]
    return line


def resuming_words(err: str) -> list[str]:
    """The words of the command that an interrupted one named."""
    (line,) = [line for line in err.splitlines() if line.startswith("  dds ")]
    return shlex.split(line)[1:]
