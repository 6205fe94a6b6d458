"""Fine-tuning on the command line: settings come from the checkpoint, mistakes are told before the first file."""

import contextlib
import os
import shutil
from pathlib import Path

import pytest
import torch

from dds_lightning.cli import _interrupted, main
from dds_lightning.console.interrupts import Interrupted

TASK = "pointmaze-umaze-diverse"
SHAPE = ["--model.hidden_dim=16", "--model.skill_dim=8", "--model.encoder_layers=1", "--model.encoder_heads=2"]
SHAPE += ["--model.decoder_blocks=1", "--model.num_skills=4"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false", "--data.batch_size=32"]
QUIET += ["--trainer.accelerator=cpu", "--trainer.limit_val_batches=0"]


def call(*words) -> int:
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        return main([str(word) for word in words])


def refused(capsys, words, *parts):
    capsys.readouterr()
    assert call(*words) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("dds: error: ")]
    assert [part for part in parts if part not in line] == []
    assert [path for path in Path().rglob("*") if path.is_file() and path.suffix != ".yaml"] == []


def weights(path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["state_dict"]


def settings(path) -> dict:
    return torch.load(path, weights_only=True)["hyper_parameters"]


@pytest.fixture(scope="module")
def of_data(tmp_path_factory):
    """Words for 2,000 steps of the smallest maze."""
    root = tmp_path_factory.mktemp("data")
    assert call("data", "collect", TASK, "--steps", 2000, "--out", root, "--workers", 1) == 0
    return [f"--data.task={TASK}", f"--data.data=local:{root}/{TASK}-v0", "--data.validation_fraction=0.2"]


@pytest.fixture(scope="module")
def start(tmp_path_factory, of_data):
    """Skill model and policy after a few steps: start/skill/last.ckpt and start/policy/last.ckpt."""
    out = tmp_path_factory.mktemp("start")
    words = [*of_data, *QUIET, "--trainer.max_steps=3", f"--trainer.default_root_dir={out}"]
    assert call("skill", "fit", *words, *SHAPE, "--data.horizon=5", f"--checkpoint.dirpath={out}/skill") == 0
    words += [f"--data.skill={out}/skill/last.ckpt", f"--checkpoint.dirpath={out}/policy"]
    assert call("policy", "fit", *words, "--model.hidden_dims=[16]", "--model.extraction=joint") == 0
    return out


def test_skills_take_their_shape_from_the_checkpoint_and_only_the_decoder_learns(start, of_data):
    first = start / "skill" / "last.ckpt"
    words = ["skill", "fit", *of_data, *QUIET, "--data.horizon=5", "--trainer.max_steps=4", "--checkpoint.dirpath=new"]
    assert call(*words, f"--model.init_from={first}", "--model.trainable=decoder") == 0
    now = settings("new/last.ckpt")
    assert (now["hidden_dim"], now["num_skills"], now["trainable"]) == (16, 4, "decoder")
    assert "init_from" not in now
    old, new = weights(first), weights("new/last.ckpt")
    assert {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])} == {"decoder"}


def test_a_stopped_fine_tuning_goes_on_without_its_start_and_ends_with_the_same_bits(start, of_data):
    shutil.copy(start / "skill" / "last.ckpt", "start.ckpt")
    words = ["skill", "fit", *of_data, *QUIET, "--data.horizon=5", "--model.lr_scale={encoder: 0.1}"]
    tune = [*words, "--model.init_from=start.ckpt", "--model.trainable=[encoder,decoder]"]
    assert call(*tune, "--trainer.max_steps=8", "--checkpoint.dirpath=through") == 0
    assert call(*tune, "--trainer.max_steps=5", "--checkpoint.dirpath=half", "--trainer.default_root_dir=half") == 0
    Path("start.ckpt").unlink()
    # The three ways back: the plain words, the file of settings that the run left, and what `dds run` appends.
    (config,) = Path("half").rglob("config.yaml")
    ways = {"words": words, "file": ["skill", "fit", "--config", config], "run": [*tune, "--model.init_from=null"]}
    expected = weights("through/last.ckpt")
    for name, way in ways.items():
        more = ["--ckpt_path=half/last.ckpt", "--trainer.max_steps=8", f"--checkpoint.dirpath={name}"]
        assert call(*way, *more) == 0
        found = weights(f"{name}/last.ckpt")
        assert [key for key in expected if not torch.equal(expected[key], found[key])] == []
        assert settings(f"{name}/last.ckpt")["trainable"] == ["encoder", "decoder"]


def test_a_policy_starts_from_another_with_new_rewards(start, of_data):
    words = ["policy", "fit", *of_data, *QUIET, "--trainer.max_steps=2", "--checkpoint.dirpath=new"]
    words += [f"--data.skill={start}/skill/last.ckpt", "--data.cache=.", "--data.reward_scale=7"]
    assert call(*words, f"--model.init_from={start}/policy/last.ckpt", "--model.trainable=critic") == 0
    assert list(settings("new/last.ckpt")["hidden_dims"]) == [16]
    old, new = weights(start / "policy" / "last.ckpt"), weights("new/last.ckpt")
    moved = {name.split(".")[0] for name in old if not torch.equal(old[name], new[name])}
    assert moved - {"value_range"} == {"value", "critic", "target_critic"}


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--model.init_from=none.ckpt"], ["model.init_from is none.ckpt", "there is no checkpoint"]),
        (["--model.init_from={start}/policy/last.ckpt"], ["expected", "of stage skill"]),
        (["--model.init_from={start}/skill/last.ckpt", "--model.num_skills=8"], ["num_skills is 8", "num_skills=4"]),
        (["--model.init_from={start}/skill/last.ckpt", "--model.hidden_dim=32"], ["hidden_dim is 32", "with 16"]),
        (["--model.init_from={start}/skill/last.ckpt", "--data.horizon=6"], ["horizon is 6", "--data.horizon=5"]),
        (["--model.init_from={start}/skill/last.ckpt", "--model.trainable=head"], ["head", "codebook"]),
        (["--model.trainable=decoder"], ["model.trainable is decoder", "--model.init_from=CHECKPOINT"]),
        (["--model.init_from=a.ckpt", "--ckpt_path={start}/skill/last.ckpt"], ["a.ckpt", "skill/last.ckpt", "one"]),
    ],
)
def test_a_mistake_is_one_sentence_status_2_and_no_file(capsys, start, of_data, words, parts):
    words = ["--data.horizon=5", *(word.format(start=start) for word in words)]
    refused(capsys, ["skill", "fit", *of_data, *QUIET, "--trainer.max_steps=1", *words], *parts)


def test_the_command_that_goes_on_after_a_stop_leaves_the_start_out():
    words = ["skill", "fit", "--model.init_from", "a.ckpt", "--model.trainable=decoder", "--ckpt_path=old.ckpt"]
    told = _interrupted(words, Interrupted(15, "out/last.ckpt"))
    assert told.splitlines()[-1].strip() == "dds skill fit --model.trainable=decoder --ckpt_path out/last.ckpt"
