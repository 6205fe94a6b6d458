"""SIGKILL at random moments of every stage: nothing unloadable, nothing lost, the same bits at the end.

Marked `faults`: about five minutes. `make faults` prints the counts.
"""

import json
import os
import time
from pathlib import Path

import pytest
import torch

from dds_lightning.cli import main
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from tests.faults.killing import kill_until_finished, launch

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked child"),
]

TASK = "pointmaze-umaze-diverse"
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false", "--trainer.accelerator=cpu"]
QUIET += ["--trainer.num_sanity_val_steps=0", "--trainer.logger=false"]
SKILL = ["--model.hidden_dim=16", "--model.skill_dim=8", "--model.encoder_layers=1", "--model.encoder_heads=2"]
SKILL += ["--model.decoder_blocks=1", "--data.batch_size=32", "--data.horizon=5", "--model.num_skills=4"]
KILLS = 16  # of each training; with the other tests more than sixty in all


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    assert main(["data", "collect", TASK, "--steps", "3000", "--out", str(root), "--workers", "1"]) == 0
    return ["--data.task", TASK, "--data.data", f"local:{root}/{TASK}-v0", "--data.validation_fraction=0.2"]


@pytest.fixture(scope="module")
def skill(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("skill")
    words = ["skill", "fit", *data, *SKILL, *QUIET, "--trainer.max_steps=5", f"--checkpoint.dirpath={folder}"]
    assert main(words) == 0
    return folder / "last.ckpt"


TRAININGS = [
    # Dead codes are restarted in the step after which a checkpoint is due.
    ("skill", ["--trainer.max_steps=300", "--trainer.val_check_interval=40", "--model.restart_every=7"], SkillModule),
    ("policy joint", ["--trainer.max_steps=400", "--trainer.val_check_interval=60"], PolicyModule),
    (
        "policy after",
        ["--trainer.max_steps=400", "--trainer.val_check_interval=60", "--model.critic_steps=200"],
        PolicyModule,
    ),
]


@pytest.mark.parametrize(("name", "words", "module"), TRAININGS, ids=[name for name, *_ in TRAININGS])
def test_a_training_killed_at_random_moments_ends_with_the_same_bits(
    name, words, module, data, skill, tmp_path, capsys
):
    """Its story: checkpoints in the middle of a run lacked the last move of the target critic."""
    stage = name.split()[0]
    model = SKILL if stage == "skill" else [f"--data.skill={skill}", "--model.hidden_dims=[16]", "--data.batch_size=32"]
    fit = [stage, "fit", *data, *model, *QUIET, "--trainer.check_val_every_n_epoch=null", "--seed_everything=3"]
    fit += ["--checkpoint.every_n_steps=7", *words]
    fit += [f"--model.extraction={name.split()[1]}"] if stage == "policy" else []

    def train(folder):
        last = folder / "last.ckpt"
        resume = [f"--ckpt_path={last}"] if last.is_file() else []
        return main([*fit, f"--checkpoint.dirpath={folder}", f"--trainer.default_root_dir={folder}", *resume])

    straight = tmp_path / "straight"
    start = time.monotonic()
    assert launch(lambda: train(straight), None)
    seconds = time.monotonic() - start
    expected = torch.load(straight / "last.ckpt", weights_only=True)
    steps: dict[Path, int] = {}

    def look(folder):
        last = folder / "last.ckpt"
        if last.is_file():
            module.load(last)
            step = torch.load(last, weights_only=True)["global_step"]
            assert step >= steps.get(folder, 0), "a kill lost finished steps"
            steps[folder] = step

    def check(folder):
        found = torch.load(folder / "last.ckpt", weights_only=True)
        assert found["global_step"] == expected["global_step"]
        for key, value in expected["state_dict"].items():
            assert torch.equal(value, found["state_dict"][key]), key

    told = kill_until_finished(train, look, check, tmp_path, seconds=seconds, kills=KILLS, seed=len(name))
    with capsys.disabled():
        print(f"\n{name}: {told}; every checkpoint loadable, the same bits", end="")


def test_a_collection_killed_at_random_moments_leaves_a_whole_set_or_none(tmp_path, capsys):
    words = ["data", "collect", TASK, "--steps", "20000", "--workers", "1", "--seed", "5"]
    start = time.monotonic()
    assert launch(lambda: main([*words, "--out", str(tmp_path / "straight")]), None)
    seconds = time.monotonic() - start
    hdf5 = Path(f"{TASK}-v0") / "data" / "main_data.hdf5"
    expected = (tmp_path / "straight" / hdf5).read_bytes()

    def collect(folder):
        # A kill between the set's last rename and the end of the process leaves nothing to do.
        return 0 if (folder / f"{TASK}-v0").exists() else main([*words, "--out", str(folder)])

    def look(folder):
        if (folder / f"{TASK}-v0").exists():
            assert (folder / hdf5).read_bytes() == expected

    told = kill_until_finished(collect, look, look, tmp_path, seconds=seconds, kills=8, seed=1)
    with capsys.disabled():
        print(f"\ncollect: {told}; the same set or none", end="")


SMALL = ["--data_steps=2000", "--clone_steps=20", "--episodes=2", "--episodes_per_skill=1", "--workers=1"]
SMALL += ["--skill.trainer.max_steps=60", "--skill.data.validation_fraction=0.2", "--skill.data.batch_size=32"]
SMALL += ["--skill.model.num_skills=4", "--skill.model.hidden_dim=16", "--skill.model.skill_dim=8"]
SMALL += ["--policy.trainer.max_steps=60", "--policy.data.batch_size=32", "--policy.model.hidden_dims=[16]"]
SMALL += ["--policy.data.validation_fraction=0.2", "--skill.trainer.accelerator=cpu"]
SMALL += [
    "--policy.trainer.accelerator=cpu",
    "--skill.checkpoint.every_n_steps=5",
    "--policy.checkpoint.every_n_steps=5",
]


def test_a_whole_run_killed_at_random_moments_loses_no_finished_stage(tmp_path, capsys):
    def run(out):
        return main(["run", TASK, "--out", str(out), *SMALL])

    start = time.monotonic()
    assert launch(lambda: run(tmp_path / "straight"), None)
    seconds = time.monotonic() - start
    weights = Path("agent") / "model.safetensors"
    finished: set[Path] = set()

    def look(folder):
        markers = {path for path in folder.glob("*/stage.json") if json.loads(path.read_text())["state"] == "finished"}
        assert {path for path in finished if folder in path.parents} <= markers, "a kill lost a finished stage"
        finished.update(markers)

    def check(folder):
        assert (tmp_path / "straight" / weights).read_bytes() == (folder / weights).read_bytes()

    told = kill_until_finished(run, look, check, tmp_path, seconds=seconds, kills=16, seed=2)
    with capsys.disabled():
        print(f"\nrun: {told}; no stage lost, the same agent", end="")
