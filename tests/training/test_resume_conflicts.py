"""A training goes on as it was asked for, and a policy goes with its skills: anything else is refused, both named."""

import re
import shutil
from pathlib import Path

import pytest
import torch

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.published import CONTENTS, SUMS, publish
from dds_lightning.skill import SkillModule
from tests.fits import POLICY, QUIET, SKILL, call, of_data, skill_of, told


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    """Two skill models, skill/last.ckpt and other/last.ckpt, and a policy on the first, policy/last.ckpt."""
    out = tmp_path_factory.mktemp("made")
    words = [*data, *QUIET, "--trainer.max_steps=4", f"--trainer.default_root_dir={out}"]
    for name, seed in (("skill", 0), ("other", 1)):
        skill_of(data, out / name, 4, f"--seed_everything={seed}")
    fit = ["policy", "fit", *words, *POLICY, f"--data.skill={out}/skill/last.ckpt", "--data.gamma=0.9"]
    assert call(*fit, f"--checkpoint.dirpath={out}/policy") == 0
    return out


def files():
    return [path for path in Path().rglob("*") if path.is_file()]


# ---------------------------------------------------------------- --ckpt_path and what was asked for


@pytest.mark.parametrize(
    ("stage", "flag", "was"),
    [
        ("skill", "--model.num_skills=8", "4"),
        ("skill", "--data.horizon=6", "5"),
        ("skill", "--data.batch_size=16", "32"),
        ("skill", "--data.stride=2", "1"),
        ("skill", "--data.seed=9", "0"),
        ("skill", "--data.validation_fraction=0.3", "0.2"),
        ("skill", "--seed_everything=9", "0"),
        ("policy", "--model.tau=0.8", "0.7"),
        ("policy", "--data.gamma=0.95", "0.9"),
        ("policy", "--data.discount=per_step", "'per_skill'"),
        ("policy", "--data.reward_scale=2.0", "None"),
    ],
)
def test_a_flag_that_contradicts_the_training_that_goes_on_is_refused(capsys, made, data, stage, flag, was):
    capsys.readouterr()
    words = [*data[:2], f"--ckpt_path={made}/{stage}/last.ckpt", flag]
    words += [f"--data.skill={made}/skill/last.ckpt"] if stage == "policy" else []
    assert call(stage, "fit", *words) == 2
    error = told(capsys.readouterr().err)
    name, _, value = flag.partition("=")
    assert f"{name} is {value!r}" in error or f"{name} is {value}" in error
    assert f"was trained with {was}" in error
    assert files() == []


def test_what_is_not_said_is_taken_from_the_checkpoint_and_data_may_have_moved(made, data, tmp_path):
    """Neither horizon nor batch size nor seed nor the model's settings need to be typed again."""
    shutil.copytree(data[1].partition("local:")[2], tmp_path / "moved" / "set")
    quiet = [word for word in QUIET if not word.startswith("--data")]
    words = ["skill", "fit", data[0], *quiet, "--trainer.max_steps=7"]
    resumed = [f"--data.data=local:{tmp_path}/moved/set", f"--ckpt_path={made}/skill/last.ckpt"]
    assert call(*words, *resumed, "--checkpoint.dirpath=resumed") == 0
    through = [*data[1:], "--data.batch_size=32", *SKILL]
    assert call(*words, *through, "--checkpoint.dirpath=through") == 0
    one, two = (torch.load(f"{name}/last.ckpt", weights_only=True)["state_dict"] for name in ("resumed", "through"))
    assert [name for name in one if not torch.equal(one[name], two[name])] == []


# ---------------------------------------------------------------- a policy and its skills


def fingerprints(made):
    return [SkillModule.load(made / name / "last.ckpt").fingerprint() for name in ("skill", "other")]


def names_both(text, made):
    return all(fingerprint[:8] in text for fingerprint in fingerprints(made))


def test_a_policy_knows_the_skills_that_it_learnt_with(made):
    first, second = fingerprints(made)
    assert first != second
    assert PolicyModule.load(made / "policy" / "last.ckpt").hparams.skill_hash == first
    assert re.fullmatch("[0-9a-f]{64}-[0-9a-f]{64}", first)


def test_a_policy_stays_with_skills_whose_decoder_was_tuned(capsys, made, data, tmp_path):
    start = f"--model.init_from={made}/skill/last.ckpt"
    tuned = skill_of(data, tmp_path / "tuned", 3, start, "--model.trainable=[decoder]", "--seed_everything=3")
    before, after = (SkillModule.load(path).decoder.state_dict() for path in (made / "skill" / "last.ckpt", tuned))
    assert any(not torch.equal(value, after[name]) for name, value in before.items())
    given = ["--skill", tuned, "--policy", made / "policy" / "last.ckpt"]
    assert call("evaluate", "-", *given, "--episodes=1", "--workers=0") == 0
    goes_on = [*data, *QUIET, "--trainer.max_steps=6", f"--data.skill={tuned}", "--data.cache=.", "--data.gamma=0.9"]
    goes_on += [f"--ckpt_path={made}/policy/last.ckpt", "--checkpoint.dirpath=."]
    assert call("policy", "fit", *goes_on) == 0, capsys.readouterr().err


def test_a_fingerprint_is_of_every_bit_and_not_of_the_file(made, tmp_path):
    skill = SkillModule.load(made / "skill" / "last.ckpt")
    publish(tmp_path / "agent", {"skill": skill})
    assert SkillModule.load(tmp_path / "agent").fingerprint() == skill.fingerprint()
    before = skill.fingerprint()
    weight = skill.decoder.net.output.bias.data
    weight[0] = torch.nextafter(weight[0], torch.tensor(torch.inf))
    assert skill.fingerprint() != before


@pytest.mark.parametrize("command", ["fit", "validate"])
def test_going_on_with_other_skills_is_refused(capsys, made, data, command):
    capsys.readouterr()
    words = [*data, "--data.batch_size=32", f"--data.skill={made}/other/last.ckpt"]
    assert call("policy", command, *words, f"--ckpt_path={made}/policy/last.ckpt", "--data.cache=.") == 2
    error = told(capsys.readouterr().err)
    assert names_both(error, made)
    assert "data.skill" in error
    assert files() == []


def test_starting_from_a_policy_of_other_skills_is_refused(capsys, made, data):
    capsys.readouterr()
    words = [*data, *QUIET, f"--data.skill={made}/other/last.ckpt", "--data.cache=."]
    assert call("policy", "fit", *words, f"--model.init_from={made}/policy/last.ckpt") == 2
    error = told(capsys.readouterr().err)
    assert names_both(error, made)
    assert "model.init_from" in error
    assert files() == []


def test_publishing_two_checkpoints_that_are_no_pair_is_refused(capsys, made):
    capsys.readouterr()
    words = ["publish", "-", "agent", "--policy", made / "policy" / "last.ckpt", "--skill"]
    assert call(*words, made / "other" / "last.ckpt") == 2
    assert names_both(told(capsys.readouterr().err), made)
    assert files() == []
    assert call(*words, made / "skill" / "last.ckpt") == 0
    assert DDSAgent.load("agent").policy.hparams.skill_hash == fingerprints(made)[0]


def test_a_published_directory_with_swapped_skills_is_refused_when_it_is_loaded(made, tmp_path):
    from dds_lightning.saving.files import sha256

    policy = PolicyModule.load(made / "policy" / "last.ckpt")
    modules = {"skill": SkillModule.load(made / "other" / "last.ckpt"), "policy": policy}
    swapped = publish(tmp_path / "swapped", modules)
    assert (swapped / SUMS).read_text() == "".join(f"{sha256(swapped / name)}  {name}\n" for name in CONTENTS)
    with pytest.raises(UserError) as caught:
        DDSAgent.load(swapped)
    assert names_both(str(caught.value), made)


def test_a_policy_of_before_that_knows_no_skills_is_taken_as_it_is(made):
    policy = PolicyModule.load(made / "policy" / "last.ckpt")
    settings = {name: value for name, value in policy.hparams.items() if name != "skill_hash"}
    DDSAgent(SkillModule.load(made / "other" / "last.ckpt"), PolicyModule(**settings))
