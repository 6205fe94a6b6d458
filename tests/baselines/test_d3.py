"""d3rlpy's algorithms as stages: its losses on our batches, exact resuming, its files, and the toy of two modes."""

import itertools
import subprocess
import sys

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from datamodules.transitions import SequenceDataModule, TransitionDataModule
from dds_lightning.baselines import d3
from dds_lightning.baselines.decision_transformer import DecisionTransformer, TransformerActor
from dds_lightning.baselines.methods import METHODS
from dds_lightning.errors import UserError
from tests.baselines.toys import assert_resumes, batch_of, regret, train, two_modes

SIZES = {"hidden_dims": [64, 64], "lr": 1e-3}
FLAT = {
    "td3bc": (d3.TD3BC, {"alpha": 2.5, **SIZES}),
    "iql": (d3.IQL, {"tau": 0.9, "beta": 10.0, **SIZES}),
    "cql": (d3.CQL, {"samples": 4, "actor_lr": 1e-3, **SIZES}),
}


def small_transformer() -> DecisionTransformer:
    return DecisionTransformer(2, 1, 4, hidden_dim=32, layers=2, dropout=0.0, max_steps=8, warmup_steps=10, lr=3e-3)


def data_of(name: str, episodes: int = 200):
    if name == "dt":
        return SequenceDataModule.from_trajectories(two_modes(episodes), horizon=4, batch_size=64, gamma=1.0)
    return TransitionDataModule.from_trajectories(two_modes(episodes), batch_size=128, gamma=0.9, reward_scale="auto")


def module_of(name: str):
    return small_transformer() if name == "dt" else FLAT[name][0](2, 1, **FLAT[name][1])


def test_without_d3rlpy_one_sentence_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "d3rlpy", None)
    with pytest.raises(UserError, match=r"needs d3rlpy .*pip install -e '\.\[baselines\]' -c constraints\.txt"):
        d3.IQL(3, 2)


def test_nothing_is_imported_before_it_is_used():
    code = "import dds_lightning.baselines.d3, dds_lightning.baselines.decision_transformer as x, sys"
    code += "; sys.exit('d3rlpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class Reseed(pl.Callback):
    """Lets a training draw the noise that another one drew."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if batch_idx == 0:
            torch.manual_seed(1)


class TestWithD3rlpy:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip("d3rlpy")

    def test_the_losses_of_iql_are_the_authors_formulas(self):
        torch.manual_seed(0)
        module, batch = d3.IQL(3, 2, hidden_dims=[8, 8], tau=0.8, beta=2.0, weight_clip=1.5), batch_of()
        s, a, after = batch["observations"], batch["actions"], batch["next_observations"]
        parts = module.algorithm.impl.modules
        with torch.no_grad():
            both = [
                torch.stack([q(s, a).q_value.squeeze(-1) for q in qs]) for qs in (parts.q_funcs, parts.targ_q_funcs)
            ]
            v, v_after = (parts.value_func(x).squeeze(-1) for x in (s, after))
        u = (both[1].amin(dim=0) - v).numpy()
        y = batch["rewards"] + 0.9 * (1 - batch["dones"]) * v_after
        q_loss = ((both[0] - y) ** 2).mean(dim=1).sum().item()
        v_loss = np.mean(np.where(u < 0, 0.2, 0.8) * u**2)
        found = module.algorithm.impl.update(module.torch_batch(batch), 0)
        assert found["q_loss"] == pytest.approx(q_loss, rel=1e-4)
        assert found["v_loss"] == pytest.approx(v_loss, rel=1e-4)

    def test_the_losses_of_td3bc_are_the_authors_formulas(self):
        torch.manual_seed(0)
        module, batch = d3.TD3BC(3, 2, hidden_dims=[8, 8], alpha=1.7), batch_of()
        s, a, after = batch["observations"], batch["actions"], batch["next_observations"]
        impl, wanted = module.algorithm.impl, module.torch_batch(batch)
        parts = impl.modules
        with torch.no_grad():
            torch.manual_seed(1)
            smooth = (0.2 * torch.randn(len(s), 2)).clamp(-0.5, 0.5)
            next_a = (parts.targ_policy(after).squashed_mu + smooth).clamp(-1, 1)
            next_q = torch.stack([q(after, next_a).q_value.squeeze(-1) for q in parts.targ_q_funcs]).amin(dim=0)
            y = batch["rewards"] + 0.9 * (1 - batch["dones"]) * next_q
            both = torch.stack([q(s, a).q_value.squeeze(-1) for q in parts.q_funcs])
            mine = parts.policy(s).squashed_mu
            first = parts.q_funcs[0](s, mine).q_value
        actor_loss = -1.7 / first.abs().mean() * first.mean() + ((mine - a) ** 2).mean()
        assert impl.compute_actor_loss(wanted, parts.policy(s)).actor_loss.item() == pytest.approx(actor_loss.item())
        torch.manual_seed(1)
        found = impl.update(wanted, 0)
        assert found["critic_loss"] == pytest.approx(((both - y) ** 2).mean(dim=1).sum().item(), rel=1e-4)

    def test_the_conservative_term_of_cql_is_the_authors_formula(self):
        """Equation 4: log of the integral of exp Q over all actions, minus Q of the data's; here by a sum on a grid."""
        torch.manual_seed(0)
        count, weight = 4000, 3.0
        module = d3.CQL(3, 1, hidden_dims=[8, 8], samples=count, conservatism=weight)
        batch = {name: value[:6] for name, value in batch_of().items()}
        s, a, after = batch["observations"], batch["actions"][:, :1], batch["next_observations"]
        batch["actions"] = a
        impl = module.algorithm.impl
        parts = impl.modules
        grid = torch.linspace(-1, 1, 2001)
        with torch.no_grad():
            terms, losses = [], []
            next_a = parts.policy(after).squashed_mu
            next_q = torch.stack([q(after, next_a).q_value.squeeze(-1) for q in parts.targ_q_funcs]).amin(dim=0)
            y = batch["rewards"] + 0.9 * (1 - batch["dones"]) * next_q
            for q in parts.q_funcs:
                everywhere = torch.stack([q(s, x.expand(len(s), 1)).q_value.squeeze(-1) for x in grid], dim=1)
                integral = torch.trapezoid(everywhere.exp(), grid, dim=1).log()
                data = q(s, a).q_value.squeeze(-1)
                # d3rlpy adds up its samples of three kinds where the integral is their mean: a constant.
                terms.append((integral + np.log(3 * count) - data).mean() - module.algorithm.config.alpha_threshold)
                losses.append(((data - y) ** 2).mean())
        found = impl.update(module.torch_batch(batch), 0)
        conservative = weight * sum(terms).item()
        assert found["conservative_loss"] == pytest.approx(conservative, abs=0.03)  # of terms about 30 each
        assert found["critic_loss"] - found["conservative_loss"] == pytest.approx(sum(losses).item(), rel=1e-3)

    def test_the_loss_of_the_transformer_is_the_authors_formula(self):
        torch.manual_seed(0)
        module, data = small_transformer(), data_of("dt", 20)
        batch = next(iter(data.train_dataloader()))
        module.return_range.copy_(torch.tensor([-4.8, 4.8]))
        returns = (batch["returns"] / 4.8)[..., None]
        network = module.networks["transformer"].train()
        ones = torch.ones(len(returns), 4)
        guess = network(batch["observations"], batch["actions"], returns, batch["steps"] + 1, 1 - ones)
        loss = ((guess - batch["actions"]) ** 2).sum(dim=-1).mean().item()
        assert module.algorithm.impl.update(module.torch_batch(batch), 0)["loss"] == pytest.approx(loss, rel=1e-4)

    @pytest.mark.parametrize("name", [*FLAT, "dt"])
    def test_a_training_that_stopped_goes_on_bit_for_bit(self, name, tmp_path):
        assert_resumes(lambda: module_of(name), lambda: data_of(name, 20), tmp_path)

    @pytest.mark.parametrize("name", [*FLAT, "dt"])
    def test_it_finds_the_mode_that_pays(self, name, tmp_path):
        torch.manual_seed(0)
        module = train(module_of(name), data_of(name), 500)
        module.trainer.save_checkpoint(tmp_path / "last.ckpt")
        actor = METHODS[name].play({name: str(tmp_path / "last.ckpt")})
        assert regret(actor) < (0.25 if name == "cql" else 0.15)  # of 0.6, what imitation of both modes loses

    @pytest.mark.parametrize("name", FLAT)
    def test_the_same_batches_give_the_weights_that_d3rlpy_alone_learns(self, name):
        """Hence what its training scores otherwise than ours is a matter of seeds and of the order of batches."""
        import d3rlpy

        def data():
            return TransitionDataModule.from_trajectories(two_modes(80), batch_size=32, gamma=0.99)

        torch.manual_seed(0)
        ours = module_of(name)
        theirs = ours.algorithm.config.create("cpu:0")
        theirs.create_impl((2,), 1)
        parts = vars(theirs.impl.modules)
        for part, network in ours.networks.items():
            parts[part].load_state_dict(network.state_dict())
        train(ours, data(), 12, callbacks=[Reseed()])
        torch.manual_seed(1)
        statistics = data().statistics()
        scaler = d3rlpy.preprocessing.StandardObservationScaler(
            mean=statistics["observation_mean"].numpy(), std=statistics["observation_std"].numpy(), eps=0.0
        )
        for batch in itertools.islice(data().train_dataloader(), 12):
            flat = {key: value.numpy() for key, value in batch.items()}
            theirs.update(
                d3rlpy.dataset.TransitionMiniBatch(
                    observations=scaler.transform_numpy(flat["observations"]).astype(np.float32),
                    actions=ours.action_box.to_unit(batch["actions"]).numpy(),
                    rewards=flat["rewards"][:, None],
                    next_observations=scaler.transform_numpy(flat["next_observations"]).astype(np.float32),
                    next_actions=np.zeros_like(flat["actions"]),
                    terminals=flat["dones"][:, None],
                    intervals=np.ones((32, 1), np.float32),
                    transitions=[],
                )
            )
        for part, network in ours.networks.items():
            for key, value in network.state_dict().items():
                assert torch.allclose(value, parts[part].state_dict()[key], atol=1e-5), (part, key)

    def test_its_own_file_acts_alike(self, tmp_path):
        import d3rlpy

        torch.manual_seed(0)
        module = train(module_of("iql"), data_of("iql", 20), 5)
        module.save_d3(tmp_path / "iql.d3")
        x = torch.randn(6, 2)
        theirs = d3rlpy.load_learnable(str(tmp_path / "iql.d3")).predict(module.normaliser(x).numpy())
        assert np.allclose(theirs, module.eval().unit_actions(x).detach().numpy(), atol=1e-6)

    def test_the_transformer_wants_less_by_what_was_paid(self):
        torch.manual_seed(0)
        module = small_transformer()
        module.return_range.copy_(torch.tensor([0.0, 4.0]))
        module.reward_affine.copy_(torch.tensor([2.0, -0.5]))
        actor = TransformerActor(module)
        actor.reset(2)
        rows, x = np.arange(2), np.ones((2, 2), np.float32)
        first = actor.act(x, np.array([True, True]), rows).actions
        actor.paid(np.array([1.0, 0.5], np.float32), rows)
        assert actor._rest.tolist() == [3.0, 4.0]
        second = actor.act(x, np.array([False, True]), rows).actions
        assert actor._clock.tolist() == [2, 1]
        assert second[1] == pytest.approx(first[1], abs=1e-6)  # a new episode: nothing is remembered
        assert second[0] != pytest.approx(first[0], abs=1e-6)
