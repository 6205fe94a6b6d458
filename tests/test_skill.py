"""The skill model: every combination learns, the loss is the paper's, the codebook stays alive."""

import copy
import inspect
import itertools
import warnings
from typing import get_args

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from dds_lightning.errors import UserError
from dds_lightning.nn.encoder import ENCODERS
from dds_lightning.skill import BOTTLENECKS, DECODERS, SkillModule

SMALL = {
    "hidden_dim": 16,
    "encoder_layers": 1,
    "encoder_heads": 2,
    "decoder_blocks": 1,
    "skill_dim": 8,
    "num_skills": 4,
    "horizon": 5,
    "dropout": 0.0,
}


def small(**settings) -> SkillModule:
    torch.manual_seed(0)
    return SkillModule(3, 2, **(SMALL | settings))


def segments(size: int = 64, horizon: int = 5, modes: int = 4) -> dict[str, torch.Tensor]:
    """Segments of `modes` kinds: each pushes in its own direction all the time."""
    generator = torch.Generator().manual_seed(0)
    kind = torch.randint(modes, (size,), generator=generator)
    angle = 2 * torch.pi * kind / modes
    direction = 0.8 * torch.stack([angle.cos(), angle.sin()], dim=-1)  # (B, 2)
    actions = direction[:, None] + 0.05 * torch.randn(size, horizon, 2, generator=generator)
    observations = torch.randn(size, horizon, 3, generator=generator)
    return {"observations": observations, "actions": actions.clamp(-1, 1), "kind": kind}


@pytest.mark.parametrize(
    ("setting", "table"), [("encoder", ENCODERS), ("decoder", DECODERS), ("bottleneck", BOTTLENECKS)]
)
def test_the_command_line_offers_every_row_of_a_table(setting, table):
    assert get_args(inspect.signature(SkillModule).parameters[setting].annotation) == tuple(table)
    assert all(f"``{name}``" in inspect.getdoc(SkillModule) for name in table)


class Segments(pl.LightningDataModule):
    def statistics(self):
        return {
            "observation_mean": torch.tensor([1.0, 2.0, 3.0]),
            "observation_std": torch.tensor([1.0, 2.0, 4.0]),
            "action_low": torch.tensor([-1.0, -2.0]),
            "action_high": torch.tensor([1.0, 2.0]),
        }

    def train_dataloader(self):
        return DataLoader([segments()] * 500, batch_size=None)

    def val_dataloader(self):
        return DataLoader([segments()] * 2, batch_size=None)


QUIET = {
    "logger": False,
    "enable_checkpointing": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}


def fit(module: SkillModule, steps: int, ckpt_path=None, **settings) -> pl.Trainer:
    base = {"max_steps": steps, "accelerator": "cpu", "log_every_n_steps": 10, "num_sanity_val_steps": 0}
    trainer = pl.Trainer(**(QUIET | base | {"val_check_interval": steps} | settings))
    trainer.fit(module, Segments(), ckpt_path=ckpt_path, weights_only=True)
    return trainer


@pytest.mark.parametrize(
    ("encoder", "decoder", "bottleneck"),
    list(itertools.product(["transformer", "gru"], ["diffusion", "mlp"], ["vq", "gaussian"])),
)
def test_every_combination_trains_every_parameter(encoder, decoder, bottleneck):
    module = small(encoder=encoder, decoder=decoder, bottleneck=bottleneck)
    loss, terms, skill = module.loss(segments(8))
    loss.backward()
    assert [name for name, p in module.named_parameters() if not p.grad.abs().max() > 0] == []
    assert skill.vectors.shape == (8, 8)
    weights = {"denoising": 1.0, "codebook": 1.0, "commitment": 0.25, "kl": 0.01}
    assert loss.item() == pytest.approx(sum(weights[name] * term.item() for name, term in terms.items()))


def test_reconstruction_sums_or_averages_over_steps_and_action_dimensions():
    values = {}
    for reduction in ("sum", "mean"):
        module = small(reconstruction=reduction)
        torch.manual_seed(1)
        values[reduction] = module.loss(segments(8))[1]["denoising"].item()
    assert values["sum"] == pytest.approx(5 * 2 * values["mean"])


def test_the_gradient_reaches_the_encoder_through_the_codebook():
    module = small(commitment=0.0)
    loss, _, _ = module.loss(segments(8))
    loss.backward()
    assert module.encoder.embedding.weight.grad.abs().max() > 0


def test_fitting_takes_the_datas_statistics_and_starts_the_codebook():
    module = small()
    fit(module, 1)
    assert module.normaliser.mean.tolist() == [1.0, 2.0, 3.0]
    assert module.action_box.high.tolist() == [1.0, 2.0]
    assert module.bottleneck.initted


def test_an_idle_codebook_is_reported_at_the_end_of_a_training():
    module = small()
    module.bottleneck.usage.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))
    with pytest.warns(UserWarning, match="only 1 of 4 codes are in use"):
        module.on_fit_end()
    module.bottleneck.usage.fill_(0.25)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module.on_fit_end()
    continuous = small(bottleneck="gaussian")
    continuous.on_fit_end()


@pytest.fixture(scope="module")
def trained():
    module = small(lr=3e-3, restart_every=20)
    trainer = fit(module, 300, limit_val_batches=2)
    return module.eval(), trainer


def test_codes_part_the_four_kinds_of_segments(trained):
    module, _ = trained
    data = segments(200)
    with torch.no_grad():
        codes = module.encode(data["observations"], data["actions"])
    for kind in range(4):
        assert len(codes[data["kind"] == kind].unique()) == 1
    assert len(codes.unique()) == 4


def test_decoding_a_code_pushes_in_its_direction_inside_the_action_box(trained):
    module, _ = trained
    data = segments(200)
    with torch.no_grad():
        codes = module.encode(data["observations"], data["actions"])
        stream = torch.Generator().manual_seed(0)
        actions = module.decode(data["observations"][:, 0], codes, generator=stream)
    assert actions[:, 0].abs().max() <= 1.0
    assert actions[:, 1].abs().max() <= 2.0
    assert (actions - data["actions"].mean(dim=1)).abs().mean() < 0.25


def test_validation_logs_reconstruction_and_codebook_health(trained):
    _, trainer = trained
    metrics = {name: value.item() for name, value in trainer.callback_metrics.items()}
    assert metrics["val/codes_used"] == 4
    assert metrics["val/dead_codes"] == 0
    assert 3.5 < metrics["val/perplexity"] <= 4.0 + 1e-5
    assert 0 < metrics["val/reconstruction_rmse"] < 0.4


def test_a_model_can_be_validated_before_and_after_a_fit_and_every_validation_counts_anew(trained):
    module, trainer = copy.deepcopy(trained[0]), pl.Trainer(**QUIET, accelerator="cpu")
    data = Segments()
    data.val_dataloader = lambda: DataLoader([{**segments(), "actions": torch.zeros(64, 5, 2)}], batch_size=None)
    before, before_again = (trainer.validate(module, Segments(), verbose=False)[0] for _ in range(2))
    assert before["val/codes_used"] == before_again["val/codes_used"] == 4
    assert trainer.validate(module, data, verbose=False)[0]["val/codes_used"] < 4
    fit(module, 2)
    assert trainer.validate(module, Segments(), verbose=False)[0]["val/codes_used"] == 4


def test_a_restarted_code_forgets_its_moments():
    module = small(lr=1e-3, restart_every=1, restart_threshold=0.5, restart_until=1.0, codebook_init="uniform")

    class Kill(pl.Callback):
        def on_train_batch_start(self, trainer, pl_module, *_):
            if trainer.global_step == 5:
                pl_module.bottleneck.usage[2] = 0.0
                pl_module.bottleneck.vectors.data[2] = 1e3
            seen.append(trainer.optimizers[0].state.get(pl_module.bottleneck.vectors, {}).get("exp_avg"))

    seen: list[torch.Tensor | None] = []
    fit(module, 6, callbacks=[Kill()], limit_val_batches=0)
    assert module.bottleneck.vectors[2].norm() < 100
    state = module.trainer.optimizers[0].state[module.bottleneck.vectors]
    assert state["exp_avg"][2].abs().max() == 0.0


@pytest.mark.parametrize(
    ("ends", "settings", "last"),
    [
        ({"max_steps": 8}, {}, 4),
        ({"max_steps": 100, "max_epochs": 2, "limit_train_batches": 4}, {}, 4),
        ({"max_steps": -1, "max_epochs": 2, "limit_train_batches": 4}, {}, 4),
        ({"max_steps": 8}, {"freeze_codes_after": 6}, 3),
        ({"max_steps": 8}, {"freeze_codes_after": 100}, 4),
    ],
)
def test_codes_restart_until_their_share_of_the_training_whatever_ends_it(ends, settings, last):
    module = small(restart_every=1, restart_threshold=0.5, restart_until=0.5, codebook_init="uniform", **settings)
    steps = []
    module.bottleneck.revive = lambda *_: steps.append(module.global_step + 1) or {}
    fit(module, **{"steps": 8, "limit_val_batches": 0, "val_check_interval": 1.0, **ends})
    assert steps == list(range(1, last + 1))


def test_a_continuous_model_has_no_codes():
    module = small(bottleneck="gaussian")
    data = segments(2)
    with pytest.raises(UserError, match="no codes"):
        module.encode(data["observations"], data["actions"])
    with pytest.raises(UserError, match="give vectors"):
        module.decode(data["observations"][:, 0], torch.zeros(2, dtype=torch.long))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_skills": 1}, "model.num_skills is 1, expected at least 2: with one code"),
        ({"horizon": 0}, "model.horizon is 0"),
        ({"encoder_heads": 3}, "model.encoder_heads is 3, expected a divisor of hidden_dim=16"),
        ({"lr": 0.0}, "model.lr is 0.0, expected positive"),
        ({"codebook_ema": 1.0}, "model.codebook_ema is 1.0"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(settings, message):
    with pytest.raises(UserError, match=message):
        small(**settings)


def test_fitting_without_statistics_says_what_is_missing():
    module = small()
    trainer = pl.Trainer(max_steps=1, logger=False, enable_checkpointing=False, enable_progress_bar=False)
    with pytest.raises(UserError, match="no observation statistics"):
        trainer.fit(module, DataLoader([segments()], batch_size=None))


def test_the_papers_model_has_its_size():
    module = SkillModule(29, 8)
    assert sum(p.numel() for p in module.parameters()) == 5_425_032


def test_quantised_skills_of_a_batch_are_the_nearest_vectors():
    module = small()
    data = segments(8)
    skill = module.encode_segments(data["observations"], data["actions"])
    torch.testing.assert_close(skill.vectors, module.bottleneck.lookup(skill.codes))
