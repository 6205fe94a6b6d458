"""Relabelling: rewards and ends worked out by hand, the cache refused when it does not match."""

import copy
import hashlib
import json
import warnings
from dataclasses import dataclass, fields, replace

import docstring_parser
import numpy as np
import pandas as pd
import pytest
import torch
from jsonargparse import ArgumentParser
from safetensors.torch import save_file

import datamodules.relabelled as relabelled
from datamodules.relabel import Relabelled, relabel, relabel_key
from datamodules.relabelled import RelabeledDataModule
from datamodules.relabelling import Relabelling
from datamodules.semi_mdp import STORED
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.nn.precision import Choice
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.fingerprint import halves
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task
from tests.modules import fit

SMALL = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 8}


def episode(steps: int, end: str, first: float = 0.0) -> dict[str, np.ndarray]:
    """Observation t is (first + t, t); reward of step t is t + 1."""
    t = np.arange(steps + 1, dtype=np.float32)
    flags = np.arange(steps) == steps - 1
    return {
        "observations": np.stack([first + t, t], axis=1),
        "actions": np.linspace(-1, 1, steps, dtype=np.float32)[:, None],
        "rewards": np.arange(1, steps + 1, dtype=np.float32),
        "terminations": flags if end == "terminated" else np.zeros(steps, bool),
        "truncations": flags if end == "truncated" else np.zeros(steps, bool),
    }


@pytest.fixture
def trajectories():
    return Trajectories.from_episodes(
        "toy", [episode(5, "terminated"), episode(5, "truncated", 100.0), episode(2, "terminated", 200.0)]
    )


@pytest.fixture
def skill():
    torch.manual_seed(0)
    return SkillModule(2, 1, horizon=3, num_skills=4, **SMALL).eval()


def test_every_end_of_an_episode(trajectories, skill):
    """H = 3. Terminated after 5: starts 0..4, the last two cut short. Truncated after 5: starts 0..2. 2 steps: both."""
    made = relabel(trajectories, skill, gamma=0.5)
    assert made.observations[:, 0].tolist() == [0, 1, 2, 3, 4, 100, 101, 102, 200, 201]
    assert made.next_observations[:, 0].tolist() == [3, 4, 5, 5, 5, 103, 104, 105, 202, 202]
    assert made.dones.tolist() == [0, 0, 1, 1, 1, 0, 0, 0, 1, 1]
    # 1 + 2/2 + 3/4, 2 + 3/2 + 4/4, 3 + 4/2 + 5/4, then 4 + 5/2 and 5 at the end of the episode.
    first = [2.75, 4.5, 6.25, 6.5, 5.0]
    assert made.rewards.tolist() == pytest.approx([*first, 2.75, 4.5, 6.25, 2.0, 2.0])
    assert made.discounts.tolist() == [0.5] * 10
    assert made.episodes.tolist() == [0] * 5 + [1] * 3 + [2] * 2
    assert made.starts.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 10, 11]


def test_discount_per_step_counts_the_steps_really_taken(trajectories, skill):
    made = relabel(trajectories, skill, gamma=0.5, discount="per_step")
    assert made.discounts.tolist() == pytest.approx([0.125, 0.125, 0.125, 0.25, 0.5, 0.125, 0.125, 0.125, 0.25, 0.5])


def test_the_learning_reward_is_shifted_then_scaled(trajectories, skill):
    made = relabel(trajectories, skill, gamma=1.0, reward_scale=0.1, reward_shift=-1.0)
    assert made.rewards[:2].tolist() == pytest.approx([0.1 * (0 + 1 + 2), 0.1 * (1 + 2 + 3)])


def test_a_bar_is_for_terminals_and_no_notebook_is_told_to_install_one(trajectories, skill, monkeypatch, capsys):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        relabel(trajectories, skill, progress=True)
    assert capsys.readouterr() == ("", "")


def test_stride_divides_episodes(trajectories, skill):
    made = relabel(trajectories, skill, stride=3)
    assert made.starts.tolist() == [0, 3, 5, 10]


def test_codes_are_those_of_the_encoder_whatever_the_batch(trajectories, skill):
    made = relabel(trajectories, skill, batch_size=3)
    assert torch.equal(made.codes, relabel(trajectories, skill, batch_size=100).codes)
    observations = torch.as_tensor(trajectories.observations[1:4])[None]
    actions = torch.as_tensor(trajectories.actions[1:4])[None]
    with torch.no_grad():
        assert made.codes[1] == skill.encode(observations, actions)[0]


def test_summary_is_one_row_a_code(trajectories, skill):
    made = relabel(trajectories, skill, gamma=1.0)
    table = made.summary()
    assert table["code"].tolist() == [0, 1, 2, 3]
    assert table["segments"].sum() == 10
    assert table["share"].sum() == pytest.approx(1.0)
    assert table["terminations"].sum() == 5
    used = table[table["segments"] > 0]
    codes = made.codes.numpy()
    for row in used.itertuples():
        assert row.reward == pytest.approx(made.rewards.numpy()[codes == row.code].mean())
    assert isinstance(table, pd.DataFrame)


def test_saved_and_read_back_is_the_same(trajectories, skill, tmp_path):
    made = relabel(trajectories, skill)
    key = relabel_key(
        trajectories, skill, gamma=0.99, discount="per_skill", stride=1, reward_scale=1.0, reward_shift=0.0
    )
    path = tmp_path / "new" / "r.safetensors"
    made.save(path, key)
    assert [p.name for p in path.parent.iterdir()] == ["r.safetensors"]
    back = Relabelled.load(path, key)
    for name in ("observations", "codes", "rewards", "next_observations", "discounts", "dones", "starts"):
        assert torch.equal(getattr(back, name), getattr(made, name))
    with pytest.raises(UserError, match=r"other inputs .gamma 0\.99 instead of 0\.9"):
        Relabelled.load(path, key | {"gamma": 0.9})


@pytest.mark.parametrize("content", [b"", b"not a tensor", b"\xff" * 64])
def test_a_file_that_is_something_else_is_refused(tmp_path, content):
    path = tmp_path / "r.safetensors"
    path.write_bytes(content)
    with pytest.raises(UserError, match="not a readable relabelled file"):
        Relabelled.load(path)


def _stored(trajectories, skill):
    made = relabel(trajectories, skill)
    return {name: getattr(made, name).clone() for name in STORED}


ABOUT = {"format": 1, "num_skills": 4, "key": {"data": "d"}}
DAMAGES = {
    "no metadata": (lambda tensors, about: about.clear(), "KeyError"),
    "no number": (lambda tensors, about: about.update(num_skills="four"), "ValueError"),
    "a tensor too few": (lambda tensors, about: tensors.pop("dones"), "expected observations, codes"),
    "a tensor too many": (lambda tensors, about: tensors.update(more=torch.zeros(1)), "it contains .*more"),
    "a row too few": (lambda tensors, about: tensors.update(rewards=torch.zeros(9)), r"rewards has shape \(9,\)"),
    "another type": (lambda tensors, about: tensors.update(codes=torch.zeros(10)), "codes has type torch.float32"),
    "a code too high": (lambda tensors, about: tensors["codes"].fill_(4), "codes run from 4 to 4, expected 0 to 3"),
    "a negative code": (lambda tensors, about: tensors["codes"].fill_(-1), "codes run from -1"),
    "a discount above one": (lambda tensors, about: tensors["discounts"].fill_(1.5), "discounts run from 1.5 to 1.5"),
    "a negative discount": (lambda tensors, about: tensors["discounts"].fill_(-1), "discounts run from -1"),
    "done twice": (lambda tensors, about: tensors["dones"].fill_(2), "dones run from 2 to 2, expected 0 to 1"),
    "a step before the first": (lambda tensors, about: tensors["starts"].fill_(-3), "starts run from -3"),
    "an episode before the first": (lambda tensors, about: tensors["episodes"].fill_(-3), "episodes run from -3"),
    "wider next states": (
        lambda tensors, about: tensors.update(next_observations=torch.zeros(10, 7)),
        "next_observations have shape",
    ),
    "a reward that is not a number": (
        lambda tensors, about: tensors["rewards"].fill_(torch.nan),
        "rewards contains numbers",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused_in_a_sentence(trajectories, skill, tmp_path, damage):
    tensors, about = _stored(trajectories, skill), {**ABOUT}
    save_file(tensors, tmp_path / "sound.safetensors", metadata={"about": json.dumps(about)})
    assert len(Relabelled.load(tmp_path / "sound.safetensors")) == 10
    change, message = DAMAGES[damage]
    change(tensors, about)
    save_file(tensors, tmp_path / "r.safetensors", metadata={"about": json.dumps(about)})
    with pytest.raises(UserError, match=rf"r\.safetensors is not a readable relabelled file .*{message}"):
        Relabelled.load(tmp_path / "r.safetensors")


def test_the_same_transitions_are_the_same_bytes_and_files_of_before_are_read(trajectories, skill, tmp_path):
    """Its story: three entries of metadata came in any order, so that every relabelling counted as another one."""
    for name in "abcdef":
        relabel(trajectories, skill).save(tmp_path / name, {"data": "d", "gamma": 0.9})
    assert len({(tmp_path / name).read_bytes() for name in "abcdef"}) == 1
    before = {"format": "1", "num_skills": "4", "key": json.dumps({"data": "d", "gamma": 0.9})}
    save_file(_stored(trajectories, skill), tmp_path / "before", metadata=before)
    assert Relabelled.load(tmp_path / "before", {"data": "d", "gamma": 0.9}).num_skills == 4


def test_a_missing_file_says_how_to_make_one(tmp_path):
    with pytest.raises(UserError, match="dds relabel"):
        Relabelled.load(tmp_path / "none.safetensors")


def test_a_checkpoint_of_other_dimensions_is_refused(trajectories):
    with pytest.raises(UserError, match="skill checkpoint has observation_dim 5, data set 'toy' has 2"):
        relabel(trajectories, SkillModule(5, 1, horizon=3, **SMALL))


@pytest.mark.parametrize("gamma", [0.0, 1.5])
def test_gamma_out_of_range_is_refused(trajectories, skill, gamma):
    with pytest.raises(UserError, match=f"gamma is {gamma}"):
        relabel(trajectories, skill, gamma=gamma)


def checkpoint(skill: SkillModule, path) -> str:
    """A Lightning checkpoint without a trainer."""
    torch.save(
        {
            "state_dict": skill.state_dict(),
            "hyper_parameters": dict(skill.hparams),
            "pytorch-lightning_version": "2.6.6",
        },
        path,
    )
    return str(path)


def module(trajectories, skill, folder, **settings) -> RelabeledDataModule:
    return RelabeledDataModule.from_trajectories(
        trajectories,
        checkpoint(skill, folder / "skill.ckpt"),
        validation_fraction=0.3,
        batch_size=4,
        **settings,
    )


def test_much_data_are_encoded_in_the_faster_precision_and_only_codes_may_differ(
    trajectories, skill, tmp_path, monkeypatch
):
    monkeypatch.setattr(relabelled, "fastest_precision", lambda: Choice("bf16-mixed", 2.0))
    used = []
    encode = SkillModule.encode
    monkeypatch.setattr(
        SkillModule, "encode", lambda *given: used.append(torch.is_autocast_enabled("cpu")) or encode(*given)
    )
    exact = module(trajectories, skill, tmp_path).relabel_into(tmp_path / "few.safetensors")
    monkeypatch.setattr(relabelled, "LONG", 5)
    fast = module(trajectories, skill, tmp_path).relabel_into(tmp_path / "many.safetensors")
    assert used == [False, True]
    for name in ("observations", "rewards", "next_observations", "discounts", "dones", "starts", "episodes"):
        assert torch.equal(getattr(exact, name), getattr(fast, name)), name
    assert (exact.codes == fast.codes).float().mean() > 0.7


def test_the_data_module_relabels_once_and_splits_by_episode(trajectories, skill, tmp_path):
    first = module(trajectories, skill, tmp_path)
    assert (first.observation_dim, first.num_skills) == (2, 4)
    first.prepare_data()
    (cached,) = tmp_path.glob("relabelled-*.safetensors")
    written = cached.stat().st_mtime_ns
    first.setup()
    train = set(first.transitions.episodes[first.train_index].tolist())
    validation = set(first.transitions.episodes[first.validation_index].tolist())
    assert train | validation == {0, 1, 2}
    assert not train & validation
    again = module(trajectories, skill, tmp_path)
    again.prepare_data()
    assert cached.stat().st_mtime_ns == written
    batch = next(iter(again.train_dataloader())) if again.setup() is None else {}
    assert {name: tuple(value.shape) for name, value in batch.items()} == {
        "observations": (4, 2),
        "codes": (4,),
        "rewards": (4,),
        "next_observations": (4, 2),
        "discounts": (4,),
        "dones": (4,),
    }


IMPOSSIBLE = {
    "codes": lambda made: {"codes": made.codes.clone().fill_(3), "num_skills": 9},
    "discounts": lambda made: {"discounts": made.discounts * 0.5},
    "dones": lambda made: {"dones": 1 - made.dones},
    "rewards": lambda made: {"rewards": made.rewards + 1},
    "starts": lambda made: {"starts": made.starts + 1},
    "episodes": lambda made: {"episodes": made.episodes + 10**6},
    "observations": lambda made: {"observations": made.observations + 1},
    "next_observations": lambda made: {"next_observations": made.observations.clone()},
    "fewer": lambda made: {name: getattr(made, name)[:-1].clone() for name in STORED},
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_transitions_that_the_data_cannot_give_are_refused_under_the_right_key(trajectories, skill, tmp_path, case):
    """Its story: the key says what a file claims to be, and anybody can write it."""
    first = module(trajectories, skill, tmp_path)
    first.prepare_data()
    made = Relabelled.load(first.cache_file())
    replace(made, **IMPOSSIBLE[case](made)).save(first.cache_file(), first.key)
    with pytest.raises(UserError, match=rf"{first.cache_file().name}.*: delete it and relabel"):
        module(trajectories, skill, tmp_path).setup()


def test_other_skills_or_settings_never_read_a_stale_cache(trajectories, skill, tmp_path):
    files = {module(trajectories, skill, tmp_path).cache_file()}
    files.add(module(trajectories, skill, tmp_path, gamma=0.9).cache_file())
    files.add(module(trajectories, skill, tmp_path, stride=2).cache_file())
    files.add(module(trajectories, skill, tmp_path, reward_shift=-1.0).cache_file())
    torch.manual_seed(1)
    other = SkillModule(2, 1, horizon=3, num_skills=4, **SMALL)
    files.add(module(trajectories, other, tmp_path).cache_file())
    assert len(files) == 5


def test_a_relabelled_file_of_another_checkpoint_is_refused(trajectories, skill, tmp_path):
    first = module(trajectories, skill, tmp_path)
    first.prepare_data()
    torch.manual_seed(1)
    other = SkillModule(2, 1, horizon=3, num_skills=4, **SMALL)
    wrong = module(trajectories, other, tmp_path, relabelled=str(first.cache_file()))
    with pytest.raises(UserError, match=r"relabelled with other inputs .skill"):
        wrong.setup()


def test_statistics_are_those_of_the_training_transitions(trajectories, skill, tmp_path):
    data = module(trajectories, skill, tmp_path)
    data.prepare_data()
    data.setup()
    statistics = data.statistics()
    rows = data.transitions.observations[data.train_index]
    torch.testing.assert_close(statistics["observation_mean"], rows.mean(dim=0))
    assert statistics["code_share"].sum().item() == pytest.approx(1.0)
    rewards = data.transitions.rewards[data.train_index]
    assert statistics["reward_range"] == pytest.approx((rewards.min().item(), rewards.max().item()))
    assert statistics["max_discount"] == pytest.approx(0.99)


def test_a_segment_cut_short_by_an_end_does_not_widen_the_range_of_values(trajectories, skill, tmp_path):
    """Its story: gamma^1 of a last step stood for gamma^H, and a critic could err tenfold unnoticed."""
    data = module(trajectories, skill, tmp_path, discount="per_step")
    data.prepare_data()
    data.setup()
    assert data.transitions.discounts.max().item() == pytest.approx(0.99)  # of a segment of one step, which ends there
    assert data.statistics()["max_discount"] == pytest.approx(0.99**skill.horizon)


# ---------------------------------------------------------------------- the settings in one record


def test_every_setting_is_a_flag_with_its_help_part_of_the_key_and_kept_with_the_module(
    trajectories, skill, tmp_path, capsys
):
    from dds_lightning.cli.parser import build_parser

    with pytest.raises(SystemExit):
        build_parser()[0].parse_args(["relabel", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    documented = {one.arg_name: one.description for one in docstring_parser.parse(Relabelling.__doc__).params}
    parser = ArgumentParser()
    parser.add_class_arguments(RelabeledDataModule, "data")
    defaults = parser.get_defaults().data
    made = module(trajectories, skill, tmp_path)
    for field in fields(Relabelling):
        assert f"--{field.name}" in text
        assert " ".join(documented[field.name].split()) in text
        assert defaults[field.name] == field.default
        assert made.hparams[field.name] == field.default
        assert field.name in made.key


def test_a_new_setting_is_one_more_field(trajectories, skill, tmp_path, monkeypatch):
    @dataclass(frozen=True)
    class Wider(Relabelling):
        """Settings with one more.

        Attributes:
            cap: The greatest reward.
        """

        cap: float = 9.0

    monkeypatch.setattr("datamodules.relabelled.Relabelling", Wider)
    parser = ArgumentParser()
    parser.add_class_arguments(RelabeledDataModule, "data")
    assert parser.parse_args(["--data.cap=4", "--data.gamma=0.5"]).data.cap == 4.0
    usual, capped = module(trajectories, skill, tmp_path), module(trajectories, skill, tmp_path, cap=4.0)
    assert (usual.key["cap"], capped.key["cap"]) == (9.0, 4.0)
    assert usual.cache_file() != capped.cache_file()
    assert capped.settings["cap"] == capped.hparams.cap == 4.0
    assert relabel(trajectories, skill, Wider(gamma=0.5, cap=4.0)).discounts[0] == 0.5


def test_settings_are_given_as_a_record_by_name_or_both(trajectories, skill):
    record = Relabelling(gamma=0.5, reward_shift=-1.0)
    by_name = relabel(trajectories, skill, gamma=0.5, reward_shift=-1.0)
    for made in (relabel(trajectories, skill, record), relabel(trajectories, skill, Relabelling(0.5), reward_shift=-1)):
        assert torch.equal(made.rewards, by_name.rewards)
    assert record.for_task(None) == Relabelling(0.5, reward_scale=1.0, reward_shift=-1.0)
    ants = get_task("antmaze-umaze")
    assert record.for_task(ants).reward_scale == ants.reward_scale
    assert Relabelling().for_task(ants).reward_shift == ants.reward_shift
    with pytest.raises(TypeError, match="gama"):
        relabel(trajectories, skill, gama=0.5)


def test_the_name_of_a_cached_file_is_that_of_earlier_versions(trajectories, skill, tmp_path):
    """Caches made before stay valid: the key's entries and their order are part of the name."""
    made = module(trajectories, skill, tmp_path, gamma=0.9)
    key = {"data": trajectories.fingerprint(), "skill": skill.fingerprint(), "horizon": 3, "gamma": 0.9}
    key |= {"discount": "per_skill", "stride": 1, "reward_scale": 1.0, "reward_shift": 0.0}
    assert json.dumps(made.key) == json.dumps(key)
    codes, whole = (
        tmp_path / f"relabelled-{hashlib.sha256(text.encode()).hexdigest()[:16]}.safetensors"
        for text in (json.dumps({**key, "skill": half}, sort_keys=True) for half in halves(skill.fingerprint()))
    )
    assert made.cache_file() == codes
    relabel(trajectories, skill, gamma=0.9).save(whole, {**key, "skill": halves(skill.fingerprint())[1]})
    assert made.cache_file() == whole  # as version 0.1.0 called it
    made.setup()
    assert not codes.exists()


def test_relabelled_data_stay_when_the_decoder_was_tuned(trajectories, skill, tmp_path):
    made = module(trajectories, skill, tmp_path)
    made.prepare_data()
    made.setup()
    tuned, moved = copy.deepcopy(skill), copy.deepcopy(skill)
    with torch.no_grad():
        next(tuned.decoder.parameters()).add_(0.1)
        moved.bottleneck.vectors.add_(0.1)
    again = module(trajectories, tuned, tmp_path)
    assert again.cache_file() == made.cache_file()
    again.setup()
    assert torch.equal(again.transitions.codes, made.transitions.codes)
    assert not module(trajectories, moved, tmp_path).cache_file().exists()
    with pytest.raises(UserError, match=r"relabelled with other inputs \(skill"):
        Relabelled.load(made.cache_file(), relabel_key(trajectories, moved))


def timed_out(rewards: list[list[float]]) -> Trajectories:
    """Episodes with these rewards that all end by time-out."""
    episodes = [episode(len(some), "truncated", 10.0 * i) for i, some in enumerate(rewards)]
    return Trajectories.from_episodes(
        "toy", [{**one, "rewards": np.array(r, np.float32)} for one, r in zip(episodes, rewards, strict=True)]
    )


def test_automatic_rewards_by_hand():
    """Returns to go at gamma 1/2: (3, 4, 0) for rewards (1, 4, 0), and (0, 0, 0)."""
    data = timed_out([[1.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    relabelling = Relabelling(gamma=0.5, discount="per_step", reward_scale="auto")
    spread = np.std([3.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(relabelling.learning_rewards(data, 3), np.array([1, 4, 0, 0, 0, 0]) * 10.0 / spread)
    per_skill = Relabelling(gamma=0.125, reward_scale="auto")  # 1/8 per skill of 3 steps is 1/2 a step
    np.testing.assert_allclose(per_skill.learning_rewards(data, 3), relabelling.learning_rewards(data, 3))
    still = timed_out([[0.0, 0.0, 0.0]])
    assert relabelling.learning_rewards(still, 3).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("factor", "constant"), [(0.1, 0.0), (10.0, 0.0), (1.0, 7.0), (0.1, -3.0)])
def test_automatic_rewards_do_not_depend_on_unit_and_origin(factor, constant):
    rewards = np.random.default_rng(0).normal(2.0, 1.0, (5, 40))
    auto = Relabelling(discount="per_step", reward_scale="auto", reward_shift="auto")
    plain, other = timed_out(rewards.tolist()), timed_out((factor * rewards + constant).tolist())
    np.testing.assert_allclose(auto.learning_rewards(other, 3), auto.learning_rewards(plain, 3), atol=1e-4)


def test_where_episodes_end_for_good_their_origin_stays(trajectories):
    """There a constant changes what it is worth to go on."""
    scale_only = Relabelling(reward_scale="auto", reward_shift=0.0)
    both = Relabelling(reward_scale="auto", reward_shift="auto")
    assert trajectories.terminations.any()
    assert both.learning_rewards(trajectories, 3).tolist() == scale_only.learning_rewards(trajectories, 3).tolist()


def test_a_misspelt_reward_scale_is_refused():
    with pytest.raises(UserError, match="reward_scale is 'automatic', expected a number, auto or null"):
        Relabelling(reward_scale="automatic")


@pytest.mark.parametrize(("factor", "constant"), [(0.1, 0.0), (10.0, 0.0), (1.0, -2.0)])
def test_the_same_policy_whatever_the_unit_and_origin_of_rewards(skill, tmp_path, factor, constant):
    """From data to probabilities: automatic rewards, and alpha in units of the advantages' spread."""
    rewards = np.random.default_rng(0).normal(1.0, 2.0, (4, 30))
    windows = timed_out(rewards.tolist()).windows(3, 1)
    observed = torch.as_tensor(timed_out(rewards.tolist()).observations[windows.observation_starts[:, None] + range(3)])
    skill.bottleneck.start_from(skill._encodings(observed, torch.zeros(len(observed), 3, 1)))
    auto = {"discount": "per_step", "reward_scale": "auto", "reward_shift": "auto"}

    def probabilities(values: np.ndarray) -> torch.Tensor:
        data = module(timed_out(values.tolist()), skill, tmp_path, cache=str(tmp_path / "cache"), **auto)
        torch.manual_seed(0)
        learns = {"alpha": 2.0, "alpha_unit": "spread", "awr": "closed_form", "extraction": "joint"}
        policy = PolicyModule(2, 4, hidden_dims=[16], lr=1e-2, target_ema=0.1, **learns)
        data.prepare_data()
        data.setup()
        fit(policy, data, 60)
        with torch.no_grad():
            return policy.logits(data.transitions.observations).softmax(dim=-1)

    plain, other = probabilities(rewards), probabilities(factor * rewards + constant)
    assert plain.std(dim=0).max() > 0.01  # it learnt something
    torch.testing.assert_close(other, plain, atol=1e-3, rtol=0.0)
