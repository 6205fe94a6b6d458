"""Starting from a checkpoint: what is loaded, what is frozen to the bit, what is refused."""

import re
import warnings

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from dds_lightning.errors import UserError
from dds_lightning.saving.published import publish
from dds_lightning.skill import SkillModule
from tests.modules import changed, fit, state

SMALL = {
    "hidden_dim": 16,
    "encoder_layers": 1,
    "encoder_heads": 2,
    "decoder_blocks": 1,
    "skill_dim": 8,
    "num_skills": 4,
    "horizon": 5,
    "dropout": 0.1,
    "lr": 1e-3,
}
PREFIXES = {"encoder": "encoder.", "codebook": "bottleneck.", "decoder": "decoder."}


class Segments(pl.LightningDataModule):
    """Random segments; statistics of `seed`, so that other data have others."""

    def __init__(self, dim: int = 3, seed: int = 0, high: float = 1.0) -> None:
        super().__init__()
        self.dim, self.seed, self.high = dim, seed, high

    def statistics(self):
        return {
            "observation_mean": torch.full((self.dim,), float(self.seed)),
            "observation_std": torch.full((self.dim,), 1.0 + self.seed),
            "action_low": -torch.ones(2),
            "action_high": torch.full((2,), self.high),
        }

    def train_dataloader(self):
        stream = torch.Generator().manual_seed(self.seed)
        batches = [
            {
                "observations": torch.randn(32, 5, self.dim, generator=stream),
                "actions": torch.rand(32, 5, 2, generator=stream) * 2 - 1,
            }
            for _ in range(20)
        ]
        return DataLoader(batches, batch_size=None)


def skill(dim: int = 3, seed: int = 1, **settings) -> SkillModule:
    torch.manual_seed(seed)
    return SkillModule(dim, 2, **(SMALL | settings))


@pytest.fixture(scope="module")
def starts(tmp_path_factory):
    """Checkpoints of a skill model (also one with an EMA codebook) and of a Gaussian one, and something else."""
    root = tmp_path_factory.mktemp("starts")
    for name, module, data in (
        ("skill", skill(seed=0), Segments()),
        ("ema", skill(seed=0, codebook_ema=0.9), Segments()),
        ("gaussian", skill(seed=0, bottleneck="gaussian"), Segments()),
    ):
        fit(module, data, 6).save_checkpoint(root / f"{name}.ckpt")
    torch.save({"state_dict": {}, "hyper_parameters": {"observation_dim": 3, "tau": 0.7}}, root / "policy.ckpt")
    publish(root / "agent", {"skill": SkillModule.load(root / "skill.ckpt")})
    return root


# -------------------------------------------------------------------- what is loaded


@pytest.mark.parametrize("name", ["skill.ckpt", "agent"])
def test_the_weights_and_the_normaliser_are_the_checkpoints(starts, name):
    module = skill(init_from=str(starts / name))
    assert changed(state(SkillModule.load(starts / "skill.ckpt")), state(module)) == set()
    before = state(module)
    fit(module, Segments(seed=3), 1)
    assert changed(before, state(module), "normaliser.") == set()


def test_reading_a_checkpoint_draws_no_random_number(starts):
    torch.manual_seed(5)
    skill(seed=5)
    expected = torch.rand(1)
    skill(seed=5, init_from=str(starts / "skill.ckpt"))
    assert torch.equal(torch.rand(1), expected)


def test_the_statistics_of_the_new_data_on_request(starts):
    module = skill(init_from=str(starts / "skill.ckpt"), refit_normaliser=True)
    fit(module, Segments(seed=3, high=2.0), 1)
    assert module.normaliser.mean.tolist() == [3.0, 3.0, 3.0]
    assert module.action_box.high.tolist() == [2.0, 2.0]


def test_another_action_box_under_kept_statistics_is_refused(starts):
    module = skill(init_from=str(starts / "skill.ckpt"))
    with pytest.raises(UserError, match=r"high bounds \[2.0, 2.0\].*\[1.0, 1.0\].*refit_normaliser=true"):
        fit(module, Segments(high=2.0), 1)


def test_of_other_observations_what_fits_is_loaded_and_the_rest_is_listed(starts):
    with pytest.warns(UserWarning, match="fits in .* tensors") as caught:
        module = skill(dim=6, init_from=str(starts / "skill.ckpt"))
    message = str(caught[0].message)
    source, fresh = state(SkillModule.load(starts / "skill.ckpt")), state(skill(dim=6))
    misfits = {"encoder.embedding.weight", "decoder.net.input.weight", "normaliser.mean", "normaliser.std"}
    assert {name for name in source if f"{name} (" in message} == misfits
    assert "encoder.embedding.weight (16, 5), (16, 8)" in message
    fits, every, data, anew = map(int, re.findall(r"(?:in|of|;) (\d+)", message))
    assert every == len(source) == fits + data + anew
    (listed,) = re.findall("come from the new data: ([^;]*);", message)
    assert (len(listed.split(", ")), message.partition("here): ")[2].count(";") + 1) == (data, anew)
    now = state(module)
    for name in source:
        if name in misfits:
            assert torch.equal(now[name], fresh[name]), name
        elif not name.startswith(("normaliser.", "action_box.")):
            assert torch.equal(now[name], source[name]), name
    fit(module, Segments(dim=6, seed=3), 2)
    assert module.normaliser.mean.tolist() == [3.0] * 6


def test_running_averages_that_the_checkpoint_lacks_begin_at_its_vectors(starts):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module = skill(init_from=str(starts / "skill.ckpt"), codebook_ema=0.99)
    vectors = module.bottleneck.vectors.clone()
    assert torch.equal(module.bottleneck.ema_sum, vectors)
    assert torch.equal(module.bottleneck.ema_count, torch.ones(4))


class Alike(Segments):
    """One and the same segment, over and over: a single code is in use."""

    def train_dataloader(self):
        one = {
            name: rows[:1].expand(32, *rows.shape[1:]) for name, rows in super().train_dataloader().dataset[0].items()
        }
        return DataLoader([one] * 20, batch_size=None)


@pytest.mark.parametrize("threshold", [0.0, 1.5])
def test_codes_that_new_data_do_not_use_stay_only_without_restarts(starts, threshold):
    restart = {"restart_threshold": threshold, "restart_every": 1, "restart_until": 1.0, "dropout": 0.0}
    module = skill(init_from=str(starts / "skill.ckpt"), lr_scale={"encoder": 1e-6}, **restart)
    before = module.bottleneck.vectors.detach().clone()
    fit(module, Alike(), 5)
    moved = (module.bottleneck.vectors.detach() != before).any(dim=1)
    assert (int(moved.sum()) == 1) == (threshold == 0)


@pytest.mark.parametrize("name", ["skill.ckpt", "agent"])
def test_a_start_in_one_line_takes_the_checkpoints_settings_but_not_how_it_was_made_itself(starts, tmp_path, name):
    module = SkillModule.starting_from(starts / name, trainable="decoder", lr=2e-3, lr_scale={"decoder": 0.5})
    assert changed(state(SkillModule.load(starts / name)), state(module)) == set()
    assert {key: module.hparams[key] for key in SMALL} == SMALL | {"lr": 2e-3}
    assert module.trained_parts == ("decoder",)
    fit(module, Segments(), 1).save_checkpoint(tmp_path / "tuned.ckpt")
    again = SkillModule.starting_from(tmp_path / "tuned.ckpt")
    assert again.trained_parts == ("encoder", "codebook", "decoder")
    assert again.hparams["lr_scale"] is None
    with pytest.warns(UserWarning, match="start anew"):
        assert SkillModule.starting_from(starts / name, observation_dim=6).hparams["observation_dim"] == 6
    with pytest.raises(UserError, match=r"hidden_dim is 32.*was trained with 16"):
        SkillModule.starting_from(starts / name, hidden_dim=32)


# -------------------------------------------------------------------- what is frozen


@pytest.mark.parametrize(
    ("name", "trainable"),
    [
        *(("skill", trainable) for trainable in ("encoder", "codebook", "decoder", ["encoder", "decoder"], "all")),
        *(("ema", trainable) for trainable in ("encoder", "decoder", ["encoder", "codebook"], "all")),
    ],
)
def test_what_is_frozen_does_not_change_by_a_bit_and_everything_else_does(starts, name, trainable):
    ema = 0.9 if name == "ema" else None
    # Every code counts as dead at every step: a codebook that could restart would.
    restart = {"restart_threshold": 1.9, "restart_every": 1, "restart_until": 1.0}
    module = skill(init_from=str(starts / f"{name}.ckpt"), trainable=trainable, codebook_ema=ema, **restart)
    before = state(module)
    fit(module, Segments(seed=3), 5)
    after = state(module)
    trained = set(PREFIXES) if trainable == "all" else {trainable} if isinstance(trainable, str) else set(trainable)
    for part, prefix in PREFIXES.items():
        if part not in trained:
            assert changed(before, after, prefix) == set(), part
            continue
        learnt = {n for n, _ in module.named_parameters() if n.startswith(prefix)}
        assert learnt <= changed(before, after, prefix), part
    assert changed(before, after, "normaliser.") == changed(before, after, "action_box.") == set()


def test_a_frozen_encoder_has_no_dropout_while_the_decoder_has(starts):
    module = skill(init_from=str(starts / "skill.ckpt"), trainable="decoder").train()
    assert not any(part.training for part in module.encoder.modules())
    assert all(part.training for part in module.decoder.modules())


def test_a_gaussian_bottleneck_goes_on_drawing_beside_a_frozen_encoder(starts):
    module = skill(init_from=str(starts / "gaussian.ckpt"), bottleneck="gaussian", trainable="decoder")
    assert module.train().bottleneck.training


# -------------------------------------------------------------------- rates by part


def test_each_part_learns_at_its_own_rate(starts):
    """The first step of Adam is its learning rate, whatever the gradient."""
    module = skill(init_from=str(starts / "skill.ckpt"), lr_scale={"encoder": 0.1, "codebook": 0.5}, lr=1e-3)
    before = state(module)
    trainer = fit(module, Segments(seed=3), 1)
    after = state(module)
    assert {g["name"]: g["lr"] for g in trainer.optimizers[0].param_groups} == {
        "encoder": pytest.approx(1e-4),
        "codebook": pytest.approx(5e-4),
        "decoder": 1e-3,
    }
    for name, rate in (("encoder.projection.2.bias", 1e-4), ("decoder.net.output.bias", 1e-3)):
        torch.testing.assert_close((after[name] - before[name]).abs().amax().item(), rate, rtol=1e-2, atol=0)


def test_a_scale_of_one_is_no_scale(starts):
    ends = []
    for scale in (None, {"encoder": 1.0}):
        module = skill(init_from=str(starts / "skill.ckpt"), lr_scale=scale)
        torch.manual_seed(0)
        fit(module, Segments(seed=3), 4)
        ends.append(state(module))
    assert changed(*ends) == set()


# -------------------------------------------------------------------- afterwards the start is forgotten


def test_what_fine_tuning_saved_loads_and_resumes_without_the_start(starts, tmp_path):
    start = tmp_path / "start.ckpt"
    start.write_bytes((starts / "skill.ckpt").read_bytes())
    settings = {"trainable": "decoder", "lr_scale": {"decoder": 0.5}}
    module = skill(init_from=str(start), **settings)
    fit(module, Segments(seed=3), 3).save_checkpoint(tmp_path / "tuned.ckpt")
    start.unlink()
    saved = torch.load(tmp_path / "tuned.ckpt", weights_only=True)
    assert "init_from" not in saved["hyper_parameters"]
    tuned = SkillModule.load(tmp_path / "tuned.ckpt")
    assert changed(state(module), state(tuned)) == set()
    assert tuned.hparams.trainable == "decoder"
    resumed = skill(seed=9, **settings)
    fit(resumed, Segments(seed=3), 6, ckpt_path=tmp_path / "tuned.ckpt")
    moved = changed(state(module), state(resumed))
    assert moved
    assert all(name.startswith("decoder.") for name in moved)


# -------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("name", "settings", "parts"),
    [
        ("none.ckpt", {}, ["model.init_from", "none.ckpt", "there is no checkpoint"]),
        ("policy.ckpt", {}, ["model.init_from", "policy.ckpt", "stage skill"]),
        ("skill.ckpt", {"num_skills": 8}, ["model.num_skills is 8", "trained with 4", "--model.num_skills=4"]),
        ("skill.ckpt", {"horizon": 7}, ["model.horizon is 7", "trained with 5", "--data.horizon=5"]),
        ("gaussian.ckpt", {}, ["model.bottleneck is vq", "trained with gaussian"]),
        ("skill.ckpt", {"bottleneck": "gaussian"}, ["model.bottleneck is gaussian", "trained with vq"]),
        ("skill.ckpt", {"encoder_heads": 4}, ["model.encoder_heads is 4", "trained with 2"]),
        ("skill.ckpt", {"trainable": "head"}, ["model.trainable is head", "encoder, codebook, decoder"]),
        ("skill.ckpt", {"trainable": []}, ["model.trainable is []"]),
        ("ema.ckpt", {"trainable": "codebook", "codebook_ema": 0.9}, ["trainable is codebook", "codebook_ema: null"]),
        ("gaussian.ckpt", {"trainable": "codebook", "bottleneck": "gaussian"}, ["no codebook"]),
        ("skill.ckpt", {"lr_scale": {"head": 1.0}}, ["model.lr_scale", "head", "encoder, codebook, decoder"]),
        ("skill.ckpt", {"lr_scale": {"encoder": 0.0}}, ["model.lr_scale", "positive", "trainable"]),
        ("skill.ckpt", {"lr_scale": {"encoder": 0.5}, "trainable": "decoder"}, ["what is trained: decoder"]),
        ("skill.ckpt", {"refit_normaliser": True, "trainable": "decoder"}, ["refit_normaliser is True", "encoder"]),
        ("skill.ckpt", {"dim": 6, "trainable": "decoder"}, ["encoder.embedding.weight", "train encoder too"]),
    ],
)
def test_a_start_that_makes_no_sense_is_refused_with_the_remedy(starts, name, settings, parts):
    with pytest.raises(UserError) as caught:
        skill(**{"init_from": str(starts / name), **settings})
    assert [part for part in parts if part not in str(caught.value)] == []


def test_freezing_a_model_that_was_never_trained_is_refused():
    with pytest.raises(UserError, match=r"model.trainable is decoder.*random weights.*--model.init_from"):
        fit(skill(trainable="decoder"), Segments(), 1)


def test_a_checkpoint_of_an_untrained_model_or_with_infinite_weights_is_refused(tmp_path):
    module = skill()
    checkpoint = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams)}
    torch.save(checkpoint, tmp_path / "new.ckpt")
    with pytest.raises(UserError, match="before its training began"):
        skill(init_from=str(tmp_path / "new.ckpt"))
    module.normaliser.fitted.fill_(True)
    module.decoder.net.output.bias.data[0] = torch.inf
    torch.save(checkpoint, tmp_path / "diverged.ckpt")
    with pytest.raises(UserError, match=r"decoder\.net\.output\.bias"):
        skill(init_from=str(tmp_path / "diverged.ckpt"))
