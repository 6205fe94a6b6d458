"""What a policy and relabelled data keep of their skills: the codes, and everything."""

import hashlib
from pathlib import Path

import pytest
import torch
import yaml

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.online.sac import SACModule
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.fingerprint import halves, same, told_apart
from dds_lightning.skill import SkillModule

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
K = 4


def skill(**settings):
    torch.manual_seed(0)
    small = {"horizon": 5, "num_skills": K, "skill_dim": 8, "hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2}
    return SkillModule(3, 2, **(small | settings), decoder_blocks=1).eval()


def changed(name, **settings):
    """The same skills with one other number."""
    other = skill(**settings)
    value = other.state_dict()[name].flatten()
    value[0] = torch.nextafter(value[0], torch.tensor(torch.inf))
    return other


def by_hand(module):
    """The fingerprint that version 0.1.0 kept."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode() + tensor.numpy().tobytes())
    return digest.hexdigest()


DECODER = "decoder.net.output.bias"


def test_the_decoder_decides_no_code_and_everything_else_does():
    base = skill().fingerprint()
    assert halves(base)[1] == by_hand(skill())
    assert same(base, changed(DECODER).fingerprint())
    assert not same(base, changed(DECODER).fingerprint(), whole=True)
    assert same(base, changed("bottleneck.usage").fingerprint())
    names = [name for name in skill().state_dict() if name.startswith(("encoder.", "normaliser.", "action_box."))]
    for name in ("bottleneck.vectors", *(n for n in names if skill().state_dict()[n].is_floating_point())):
        assert not same(base, changed(name).fingerprint()), name
    for setting in ({"horizon": 6}, {"encoder_heads": 4}):
        assert not same(base, skill(**setting).fingerprint()), setting


def test_a_fingerprint_of_version_0_1_0_is_of_the_model_it_was_made_of():
    old, new = by_hand(skill()), skill().fingerprint()
    assert same(old, new)
    assert same(new, old, whole=True)
    assert not same(old, changed(DECODER).fingerprint())
    assert not same(old, by_hand(changed(DECODER)))


def test_people_see_where_two_differ():
    base, tuned, other = (one.fingerprint() for one in (skill(), changed(DECODER), changed("bottleneck.vectors")))
    assert told_apart(base, other) == (base[:8], other[:8])
    there, here = told_apart(base, tuned)
    assert there != here
    assert there.startswith(f"{base[:8]} with decoder ")
    assert told_apart(by_hand(skill()), tuned)[0] == by_hand(skill())[:8]


def policy_of(kind, learnt_with):
    if kind == "online":
        return SACModule(3, "discrete", K, [16], skill_hash=learnt_with)
    return PolicyModule(3, K, (16,), skill_hash=learnt_with)


@pytest.mark.parametrize("kind", ["offline", "online"])
def test_an_offline_policy_belongs_to_the_codes_and_an_online_one_to_the_decoder_too(kind):
    learnt_with = skill().fingerprint()
    for known in (learnt_with, by_hand(skill())):
        DDSAgent(skill(), policy_of(kind, known))
        with pytest.raises(UserError, match="trained on the codes of skill model"):
            DDSAgent(changed("bottleneck.vectors"), policy_of(kind, known))
    if kind == "offline":
        DDSAgent(changed(DECODER), policy_of(kind, learnt_with))
        return
    with pytest.raises(UserError, match=rf"{learnt_with[:8]} with decoder \w+, this one is {learnt_with[:8]} with"):
        DDSAgent(changed(DECODER), policy_of(kind, learnt_with))


def test_a_policy_of_version_0_1_0_is_cured_as_its_message_says(dds, tmp_path):
    def saved(module, name):
        torch.save({"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams)}, tmp_path / name)
        return tmp_path / name

    old, tuned = policy_of("offline", by_hand(skill())), changed(DECODER)
    with pytest.raises(UserError, match=r"publish this policy of version 0.1.0 once .*`dds publish - DIR --skill"):
        DDSAgent(tuned, old)
    with pytest.raises(UserError) as newer:
        DDSAgent(changed("bottleneck.vectors"), policy_of("offline", skill().fingerprint()))
    assert "0.1.0" not in str(newer.value)
    given = ["--skill", saved(skill(), "skill.ckpt"), "--policy", saved(old, "policy.ckpt")]
    answer = dds("publish", "-", tmp_path / "agent", *given)
    assert answer.status == 0, answer.err
    DDSAgent(tuned, PolicyModule.load(tmp_path / "agent"))


@pytest.mark.parametrize("name", ["antmaze-large-diverse", "walker2d-medium-expert"])
def test_a_shipped_policy_of_version_0_1_0_plays_with_its_skills_when_their_decoder_was_tuned(name):
    kept = yaml.safe_load((CHECKPOINTS / name / "config.yaml").read_text())["policy"]["skill_hash"]
    skills, policy = SkillModule.load(CHECKPOINTS / name), PolicyModule.load(CHECKPOINTS / name)
    assert by_hand(skills) == kept == halves(policy.skill_hash)[1]
    with torch.no_grad():
        skills.decoder.net.output.bias += 0.01
    DDSAgent(skills, policy)
    with torch.no_grad():
        skills.bottleneck.vectors += 0.01
    with pytest.raises(UserError, match="do not belong together"):
        DDSAgent(skills, policy)
