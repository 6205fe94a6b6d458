"""Discrete IQL and AWR: on a chain whose values are known, and on hand-made batches."""

import math
import warnings

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from dds_lightning.errors import UserError
from dds_lightning.nn.watch import complaints
from dds_lightning.policy import Judged, PolicyModule


def small(**settings) -> PolicyModule:
    torch.manual_seed(0)
    settings = {"hidden_dims": (32, 32), "extraction": "joint"} | settings
    return PolicyModule(settings.pop("observation_dim", 2), settings.pop("num_skills", 4), **settings)


def batch(size: int = 8, dim: int = 2, skills: int = 4) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {
        "observations": torch.randn(size, dim, generator=generator),
        "codes": torch.randint(skills, (size,), generator=generator),
        "rewards": torch.randn(size, generator=generator),
        "next_observations": torch.randn(size, dim, generator=generator),
        "discounts": torch.full((size,), 0.9),
        "dones": torch.zeros(size),
    }


class Chain(pl.LightningDataModule):
    """Five states in a row; code 1 steps right, code 0 left; reward 1 on reaching the right end, which ends it."""

    def __init__(self) -> None:
        super().__init__()
        rows = []
        for s in range(4):
            rows.append((s, 1, float(s == 3), s + 1, float(s == 3)))
            rows.append((s, 0, 0.0, max(s - 1, 0), 0.0))
        s, k, r, n, d = map(torch.tensor, zip(*rows, strict=True))
        eye = torch.eye(5)
        self.data = {
            "observations": eye[s],
            "codes": k,
            "rewards": r,
            "next_observations": eye[n],
            "discounts": torch.full((8,), 0.9),
            "dones": d,
        }

    def statistics(self):
        share = torch.tensor([0.5, 0.5, 0.0, 0.0])
        return {
            "observation_mean": torch.zeros(5),
            "observation_std": torch.ones(5),
            "code_share": share,
            "reward_range": (0.0, 1.0),
            "max_discount": 0.9,
        }

    def train_dataloader(self):
        return DataLoader([self.data] * 100, batch_size=None)


def fit(module: PolicyModule, steps: int, datamodule: pl.LightningDataModule, **settings) -> pl.Trainer:
    trainer = pl.Trainer(
        max_steps=steps,
        logger=False,
        accelerator="cpu",
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=50,
        **settings,
    )
    trainer.fit(module, datamodule)
    return trainer


@pytest.fixture(scope="module")
def trained():
    chain = Chain()
    module = small(observation_dim=5, lr=3e-3, target_ema=0.05, tau=0.9, alpha=10.0, critic_steps=900)
    module.hparams.extraction = "after"
    fit(module, 1300, chain)
    return module.eval(), chain


def test_values_of_the_chain_are_the_powers_of_the_discount(trained):
    module, _ = trained
    with torch.no_grad():
        v = module.v(torch.eye(5)[:4])
    # tau = 0.9 between both codes: above their mean, a little under the maximum 0.9^(3 - s).
    best = torch.tensor([0.729, 0.81, 0.9, 1.0])
    assert (v < best + 0.02).all()
    assert (v > best - 0.12).all()
    assert (v.diff() > 0.03).all()


def test_the_policy_steps_right_everywhere_however_it_is_chosen(trained):
    module, _ = trained
    states = torch.eye(5)[:4]
    with torch.no_grad():
        assert module.codes(states, "greedy").tolist() == [1, 1, 1, 1]
        assert module.codes(states, "argmax_q").tolist() == [1, 1, 1, 1]
        many = module.codes(states.repeat(500, 1), "sample", generator=torch.Generator().manual_seed(0))
    assert (many == 1).float().mean() > 0.75
    assert many.max() == 1  # codes 2 and 3 are not in the data


def test_the_closed_form_is_what_the_regression_tends_to(trained):
    regressed, chain = trained
    states = torch.eye(5)[:4]
    settings = {"observation_dim": 5, "alpha": 10.0, "awr": "closed_form", "lr": 3e-3, "critic_steps": 0}
    module = small(**settings, extraction="after")
    module.load_state_dict(
        {**regressed.state_dict(), **{f"actor.{k}": v for k, v in module.actor.state_dict().items()}}
    )
    fit(module, 400, chain)
    with torch.no_grad():
        expected, found = (m.logits(states).softmax(dim=-1) for m in (regressed, module.eval()))
        module.hparams.alpha = 0.0
        data = module.logits(states).softmax(dim=-1)
    assert found[:, :2] == pytest.approx(expected[:, :2], abs=0.05)
    assert (found[:, 2:] == 0).all()  # codes 2 and 3 are not in the data
    assert data[:, :2] == pytest.approx(torch.full((4, 2), 0.5), abs=0.02)  # with alpha 0 the policy of the data


@pytest.mark.parametrize("settings", [{"beta_floor": 0.1}, {"beta_ratio": 0.2}, {"beta_floor": 0.1, "beta_ratio": 0.1}])
def test_the_closed_form_leaves_out_what_the_data_hardly_do_there(settings):
    module = small(awr="closed_form", alpha=1.0, **settings)
    with torch.no_grad():
        module.actor[-1].weight.zero_()
        module.actor[-1].bias.copy_(torch.tensor([0.55, 0.35, 0.09, 0.01]).log())
        probabilities = module.logits(torch.randn(50, 2)).softmax(dim=-1)
    assert (probabilities[:, :2] > 0).all()
    assert (probabilities[:, 2:] == 0).all()


def test_only_the_likeliest_code_of_the_data_is_left_where_nothing_else_is_allowed():
    module, states = small(awr="closed_form", alpha=50.0, beta_ratio=1.0), torch.randn(50, 2)
    with torch.no_grad():
        chosen = module.codes(states)
        module.hparams.alpha = 0.0
        assert torch.equal(chosen, module.logits(states).argmax(dim=-1))


def test_codes_without_support_are_never_chosen():
    module = small()
    module.support_mask.copy_(torch.tensor([True, False, True, False]))
    states = torch.randn(300, 2)
    with torch.no_grad():
        for selection in ("sample", "greedy", "argmax_q"):
            assert set(module.codes(states, selection).tolist()) <= {0, 2}


def test_temperature_goes_from_sampling_to_greedy():
    module = small()
    states = torch.randn(400, 2)
    with torch.no_grad():
        greedy = module.codes(states, "greedy")
        cold = module.codes(states, "sample", temperature=1e-6, generator=torch.Generator().manual_seed(0))
        warm = module.codes(states, "sample", temperature=1.0, generator=torch.Generator().manual_seed(0))
    assert torch.equal(cold, greedy)
    assert (warm == greedy).float().mean() < 0.9


def test_losses_touch_only_their_own_networks():
    module = small()
    data = batch()
    features = module.embed(data["observations"])
    judged = Judged(data, features, torch.linspace(-1, 1, 8), module.value(features).squeeze(-1))
    networks = ("value", "critic", "target_critic", "actor")
    for name, learning in {"value_loss": "value", "critic_loss": "critic", "actor_loss": "actor"}.items():
        module.zero_grad()
        loss, _ = getattr(module, name)(judged)
        loss.backward(retain_graph=True)
        for network in networks:
            gradients = [p.grad for p in getattr(module, network).parameters()]
            if network == learning:
                assert all(gradient.abs().max() > 0 for gradient in gradients), (name, network)
            else:
                assert all(gradient is None for gradient in gradients), (name, network)


def test_each_loss_is_its_equation_on_numbers_worked_by_hand():
    module = small(tau=0.9, alpha=2.0, weight_clip=5.0)
    data = {name: value[:2] for name, value in batch().items()} | {"codes": torch.tensor([1, 3])}
    features = module.embed(data["observations"])
    judged = Judged(data, features, torch.tensor([1.0, -1.0]), torch.tensor([0.5, 0.0]))
    assert module.value_loss(judged)[0].item() == pytest.approx((0.9 * 0.25 + 0.1 * 1.0) / 2)
    with torch.no_grad():
        target = data["rewards"] + 0.9 * module.v(data["next_observations"])
        q = module.critic(features.expand(2, -1, -1))[:, torch.arange(2), data["codes"]]  # (2, B)
        assert module.critic_loss(judged)[0].item() == pytest.approx((q - target).square().mean(dim=1).sum().item())
        log_pi = module.actor(features).log_softmax(dim=-1)[torch.arange(2), data["codes"]]
        loss, statistics = module.actor_loss(judged)
    weights = torch.tensor([math.e, math.exp(-2.0)])  # exp(2 x 0.5), exp(2 x -1)
    assert loss.item() == pytest.approx(-(weights * log_pi).mean().item())
    assert statistics["clipped_share"] == 0.0
    total, terms = module.loss(data)
    assert total.item() == pytest.approx(sum(terms[name].item() for name in ("value_loss", "q_loss", "actor_loss")))


def test_one_adam_over_the_sum_equals_three_adams():
    one, three = small(), small()
    joint = torch.optim.Adam([p for p in one.parameters() if p.requires_grad], lr=1e-3)
    parts = [torch.optim.Adam(m.parameters(), lr=1e-3) for m in (three.value, three.critic, three.actor)]
    for _ in range(5):
        joint.zero_grad()
        one.loss(batch())[0].backward()
        joint.step()
        for optimizer in parts:
            optimizer.zero_grad()
        three.loss(batch())[0].backward()
        for optimizer in parts:
            optimizer.step()
    for a, b in zip(one.parameters(), three.parameters(), strict=True):
        assert torch.equal(a, b)


def test_extraction_after_trains_the_critic_first_and_then_leaves_it_alone():
    class Spy(pl.Callback):
        def on_train_batch_end(self, trainer, module, *_):
            if trainer.global_step in (20, 40):
                states[trainer.global_step] = {k: v.clone() for k, v in module.state_dict().items()}

    states: dict[int, dict[str, torch.Tensor]] = {}
    module = small(observation_dim=5, extraction="after", critic_steps=20, lr=1e-3)
    start = {k: v.clone() for k, v in module.state_dict().items()}
    trainer = pl.Trainer(
        max_steps=40,
        logger=False,
        accelerator="cpu",
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[Spy()],
    )
    trainer.fit(module, Chain())

    def moved(a, b, part):
        return any(not torch.equal(a[k], b[k]) for k in a if k.startswith(part))

    assert moved(start, states[20], "value")
    assert moved(start, states[20], "critic")
    assert not moved(start, states[20], "actor")
    assert not moved(states[20], states[40], "value")
    assert not moved(states[20], states[40], "critic")
    assert moved(states[20], states[40], "actor")


@pytest.mark.parametrize(
    ("settings", "warned"),
    [
        ({"extraction": "after", "critic_steps": 2}, True),
        ({"extraction": "after", "critic_steps": 1}, False),
        ({"extraction": "joint"}, False),
        ({"extraction": "after", "trainable": "critic"}, False),
    ],
)
def test_a_training_that_ends_before_the_policys_turn_is_warned_of(settings, warned):
    module = small(observation_dim=5, **settings)
    module.fit_statistics(torch.zeros(5), torch.ones(5), torch.ones(module.num_skills), (0.0, 1.0), 0.9)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit(module, 2, Chain())
    told = [str(one.message) for one in caught if "the policy will have learnt nothing" in str(one.message)]
    assert len(told) == warned
    assert all("model.critic_steps is 2, and the training ends at step 2" in text for text in told)


def test_target_critic_follows_at_the_polyak_rate():
    module = small(target_ema=0.25)
    with torch.no_grad():
        for p in module.critic.parameters():
            p.add_(1.0)
    before = [p.clone() for p in module.target_critic.parameters()]
    module.after_step(1)
    for b, t, c in zip(before, module.target_critic.parameters(), module.critic.parameters(), strict=True):
        torch.testing.assert_close(t, 0.75 * b + 0.25 * c)


def test_a_checkpoint_in_the_middle_of_a_run_holds_the_last_move_of_the_target(tmp_path):
    """Callbacks come before the module at a batch's end: what the module did there was missing in checkpoints."""

    def fit(steps, callbacks):
        module = small(observation_dim=5, lr=1e-2, target_ema=0.5)
        pl.Trainer(
            max_steps=steps, logger=False, accelerator="cpu", enable_checkpointing=bool(callbacks),
            enable_progress_bar=False, enable_model_summary=False, callbacks=callbacks,
        ).fit(module, Chain())  # fmt: skip
        return module.state_dict()

    every = ModelCheckpoint(tmp_path, "{step}", save_top_k=-1, every_n_train_steps=3, save_on_train_epoch_end=False)
    fit(5, [every])
    saved = torch.load(tmp_path / "step=3.ckpt", weights_only=True)["state_dict"]
    for name, value in fit(3, []).items():
        assert torch.equal(value, saved[name]), name


def test_complaints_of_values_that_no_rewards_can_sum_to():
    module = small(observation_dim=5)
    module.fit_statistics(**Chain().statistics())
    assert module.value_range.tolist() == pytest.approx([0.0, 10.0])

    def said(most: float, **more: torch.Tensor) -> list[str]:
        return complaints({"v_min": torch.tensor(0.0), "v_max": torch.tensor(most), **more}, module.value_range, 100.0)

    assert said(9.9) == []
    (one,) = said(25.0)
    assert "allow only 0 to 10: the critic diverges" in one
    (one,) = said(1.0, clipped_share=torch.tensor(0.8))
    assert "80 % of the AWR weights are clipped at 100" in one


def test_a_training_passes_complaints_on():
    module = small(observation_dim=5, watch=1)
    module.value[-1].bias.data.fill_(50.0)
    with pytest.warns(UserWarning, match="step 0: V runs from .* the critic diverges"):
        fit(module, 1, Chain())


@pytest.mark.parametrize("awr", ["closed_form", "regression"])
def test_alpha_in_units_of_the_spread_of_advantages(awr):
    """The unit is the standard deviation of target Q - V over the data; both solutions use alpha / unit."""
    module = small(alpha=3.0, alpha_unit="spread", awr=awr)
    data = batch(64)
    module.fit_statistics(torch.zeros(2), torch.ones(2), torch.full((4,), 0.25), (-3.0, 3.0), 0.9)
    with torch.no_grad():
        q = module.q(data["observations"]).gather(1, data["codes"][:, None]).squeeze(1)
        spread = (q - module.v(data["observations"])).std(correction=0)
        module.advantage_spread.fill_(spread)
        plain = small(alpha=3.0 / spread.item(), awr=awr)
        plain.load_state_dict({k: v for k, v in module.state_dict().items() if k != "advantage_spread"})
        torch.testing.assert_close(module.logits(data["observations"]), plain.logits(data["observations"]))
        torch.testing.assert_close(module.loss(data)[0], plain.loss(data)[0])
        assert module.loss(data)[1]["advantage_std"].item() == pytest.approx(spread.item())


def test_the_spread_is_measured_while_training_and_goes_into_the_checkpoint():
    module = small(observation_dim=5, alpha_unit="spread", lr=1e-2, target_ema=0.5)
    fit(module, 300, Chain())
    kept = module.state_dict()["advantage_spread"].item()
    data = Chain().data
    with torch.no_grad():
        now = module.loss(data)[1]["advantage_std"].item()
    assert kept == pytest.approx(now, rel=0.15)
    assert "advantage_spread" not in small().state_dict()  # and older checkpoints still fit


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_skills": 1}, "model.num_skills is 1, expected at least 2"),
        ({"alpha_unit": "std"}, "model.alpha_unit is std, expected reward or spread"),
        ({"tau": 1.0}, r"model.tau is 1.0, expected in \(0, 1\)"),
        ({"alpha": -1.0}, "model.alpha is -1.0"),
        ({"target_ema": 0.0}, "model.target_ema is 0.0"),
        ({"support": 0.5}, "model.support is 0.5"),
        ({"fourier_seen": 3}, r"model.fourier_seen is 3, expected in \[0, 2\]"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(settings, message):
    with pytest.raises(UserError, match=message):
        small(**settings)


def test_layer_norm_makes_values_blind_to_the_scale_of_a_layer_and_fourier_features_are_sines_and_cosines():
    module = small(fourier_features=8, layer_norm=True)
    states = torch.randn(3, 2)
    values = module.v(states)
    assert values.shape == (3,)
    assert module.q(states).shape == module.logits(states).shape == (3, 4)
    phase = states @ module.features.frequencies
    torch.testing.assert_close(module.embed(states), torch.cat([states, phase.sin(), phase.cos()], dim=-1))
    with torch.no_grad():
        for parameter in module.value[0].parameters():
            parameter.mul_(10.0)
    torch.testing.assert_close(module.v(states), values, atol=1e-3, rtol=1e-3)


def test_statistics_are_strict_for_the_user_and_filtered_from_a_data_module():
    class Rich(Chain):
        def statistics(self):
            return {**super().statistics(), "episodes": 4}

    class Poor(Chain):
        def statistics(self):
            return {"observation_mean": torch.zeros(5), "observation_std": torch.ones(5)}

    module = small(observation_dim=5)
    with pytest.raises(TypeError, match="max_discont"):
        module.fit_statistics(**Chain().statistics(), max_discont=0.9)
    fit(module, 1, Rich())
    assert module.value_range.tolist() == pytest.approx([0.0, 10.0])
    with pytest.raises(UserError, match=r"Poor.statistics\(\) lacks code_share, reward_range, max_discount"):
        fit(small(observation_dim=5), 1, Poor())


def test_fourier_features_may_see_the_position_alone():
    module = small(fourier_features=8, fourier_seen=1)
    here, elsewhere = torch.tensor([[0.5, 1.0]]), torch.tensor([[0.5, -1.0]])
    width = 2
    assert torch.equal(module.embed(here)[:, width:], module.embed(elsewhere)[:, width:])
    assert not torch.equal(module.embed(here), module.embed(elsewhere))
    assert module.features.output_dim == width + 16


def test_a_policy_trains_in_bfloat16_whatever_the_unit_of_alpha():
    """Its story: the running spread of advantages refused a number of another precision in the first step."""
    module = small(observation_dim=5, alpha_unit="spread", awr="closed_form", fourier_features=4)
    fit(module, 3, Chain(), precision="bf16-mixed")
    assert float(module.advantage_spread) != 1.0
    assert {value.dtype for value in module.terms.values()} == {torch.float32}
    assert all(bool(torch.isfinite(value).all()) for value in module.terms.values())
