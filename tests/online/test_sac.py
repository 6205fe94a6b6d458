"""The losses of SAC against other libraries' formulas, written out here in our own words, on fixed batches."""

import copy
import math

import pytest
import torch
import torch.nn.functional as tf
from torch.distributions import Categorical, Normal

from dds_lightning.errors import UserError
from dds_lightning.online.offline import start_offline
from dds_lightning.online.sac import SACModule
from dds_lightning.policy import PolicyModule
from dds_lightning.saving.checkpoint import STAGE_KEY

B, WIDTH, K, D = 64, 4, 6, 3
GAMMA = 0.97


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def module_of(space, **settings):
    module = SACModule(WIDTH, space, K if space == "discrete" else D, hidden_dims=[16, 16], **settings)
    for weights in module.target_critic.parameters():
        weights.data.mul_(0.9)  # apart from the critics
    module.normaliser.fit(torch.randn(WIDTH), torch.rand(WIDTH) + 0.5)
    return module


def batch_of(space):
    batch = {
        "observations": torch.randn(B, WIDTH),
        "next_observations": torch.randn(B, WIDTH),
        "rewards": torch.randn(B),
    }
    batch["actions"] = torch.randint(K, (B,)) if space == "discrete" else 1.9 * torch.rand(B, D) - 0.95
    return {**batch, "discounts": torch.full((B,), GAMMA), "dones": (torch.rand(B) < 0.3).float()}


def members(mlp, x):
    """The two critics as two plain networks: [(B, J), (B, J)]."""
    outputs = []
    for n in range(2):
        h = x
        for layer in mlp:
            h = h @ layer.weight[n] + layer.bias[n] if hasattr(layer, "weight") else tf.relu(h)
        outputs.append(h)
    return outputs


def discrete_oracle(module, batch):
    """Discrete SAC as CleanRL's sac_atari and d3rlpy's DiscreteSAC compute it."""
    alpha = module.log_alpha.exp().item()
    s, s2 = (module.normaliser(batch[name]) for name in ("observations", "next_observations"))
    with torch.no_grad():
        after = Categorical(logits=module.actor.net(s2))
        q1, q2 = members(module.target_critic, s2)
        soft = (after.probs * (torch.min(q1, q2) - alpha * after.logits)).sum(dim=1)
        goal = batch["rewards"] + (1 - batch["dones"]) * GAMMA * soft
    q1, q2 = members(module.critic, s)
    taken = [q[torch.arange(B), batch["actions"]] for q in (q1, q2)]
    critic = tf.mse_loss(taken[0], goal) + tf.mse_loss(taken[1], goal)
    now = Categorical(logits=module.actor.net(s))
    actor = (now.probs * (alpha * now.logits - torch.min(q1, q2).detach())).sum(dim=1).mean()
    wanted = 0.98 * math.log(K)
    temperature = (now.probs.detach() * (-module.log_alpha.exp() * (now.logits.detach() + wanted))).sum(dim=1).mean()
    return critic, actor, temperature


def gaussian_oracle(module, batch, noise):
    """SAC as stable-baselines3 computes it, with the same noise: the squashed density minus log(1 - a^2 + 1e-6)."""
    alpha = module.log_alpha.exp().item()
    s, s2 = (module.normaliser(batch[name]) for name in ("observations", "next_observations"))

    def drawn(x, eps):
        mean, log_std = module.actor.net(x).chunk(2, dim=1)
        normal = Normal(mean, log_std.clamp(-20, 2).exp())
        u = normal.mean + normal.stddev * eps
        action = torch.tanh(u)
        return action, normal.log_prob(u).sum(dim=1) - torch.log(1 - action**2 + 1e-6).sum(dim=1)

    with torch.no_grad():
        action, log_pi = drawn(s2, noise[0])
        q = torch.cat(members(module.target_critic, torch.cat([s2, action], dim=1)), dim=1).min(dim=1).values
        goal = batch["rewards"] + (1 - batch["dones"]) * GAMMA * (q - alpha * log_pi)
    taken = members(module.critic, torch.cat([s, batch["actions"]], dim=1))
    critic = 0.5 * sum(tf.mse_loss(q.squeeze(1), goal) for q in taken)
    action, log_pi = drawn(s, noise[1])
    q = torch.cat(members(module.critic, torch.cat([s, action], dim=1)), dim=1).min(dim=1).values
    actor = (alpha * log_pi - q).mean()
    temperature = -(module.log_alpha * (log_pi - 1.0 * D).detach()).mean()
    return critic, actor, temperature


def gradients(loss, parameters):
    return torch.autograd.grad(loss, list(parameters), retain_graph=True, allow_unused=True)


def test_discrete_losses_and_gradients_are_cleanrls_and_d3rlpys():
    module, batch = module_of("discrete", backup_entropy=True, target_entropy=0.98), batch_of("discrete")
    total, terms = module.loss(batch)
    critic, actor, temperature = discrete_oracle(module, batch)
    assert terms["q_loss"] == pytest.approx(critic.item(), rel=1e-5)
    assert terms["actor_loss"] == pytest.approx(actor.item(), rel=1e-5)
    assert terms["temperature_loss"] == pytest.approx(temperature.item(), rel=1e-5)
    for loss, part in ((critic, module.critic), (actor, module.actor)):
        for ours, theirs in zip(gradients(total, part.parameters()), gradients(loss, part.parameters()), strict=True):
            assert torch.allclose(ours, theirs, rtol=1e-4, atol=1e-6)
    assert torch.allclose(*(gradients(loss, [module.log_alpha])[0] for loss in (total, temperature)))


def test_gaussian_losses_and_gradients_are_stable_baselines(monkeypatch):
    """SB3 halves the critics' loss and has log alpha where we have alpha: the gradients differ by these factors."""
    module, batch = module_of("raw", backup_entropy=True, target_entropy=1.0), batch_of("raw")
    torch.manual_seed(1)
    total, terms = module.loss(batch)
    torch.manual_seed(1)
    noise = [torch.randn(B, D), torch.randn(B, D)]
    critic, actor, temperature = gaussian_oracle(module, batch, noise)
    assert terms["q_loss"] == pytest.approx(2 * critic.item(), rel=1e-4)
    assert terms["actor_loss"] == pytest.approx(actor.item(), abs=1e-4)
    for loss, part, factor in ((critic, module.critic, 2), (actor, module.actor, 1)):
        for ours, theirs in zip(gradients(total, part.parameters()), gradients(loss, part.parameters()), strict=True):
            assert torch.allclose(ours, factor * theirs, rtol=5e-3, atol=1e-4)
    ours, theirs = (gradients(loss, [module.log_alpha])[0].item() for loss in (total, temperature))
    assert ours == pytest.approx(module.alpha.item() * theirs, rel=1e-4)


def test_without_entropy_in_the_backup_the_target_is_the_expected_value():
    module, batch = module_of("discrete", backup_entropy=False), batch_of("discrete")
    batch["dones"][:] = 0.0
    pi = module.logits(batch["next_observations"]).softmax(dim=1)
    q = module.q(batch["next_observations"])
    goal = batch["rewards"] + GAMMA * (pi * q).sum(dim=1)
    taken = [q[torch.arange(B), batch["actions"]] for q in members(module.critic, module.embed(batch["observations"]))]
    expected = sum(tf.mse_loss(q, goal) for q in taken)
    assert module.loss(batch)[1]["q_loss"] == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize(("pessimism", "judge"), [("min", torch.min), ("mean", lambda a, b: (a + b) / 2)])
def test_the_critics_agree_on_their_least_or_mean_value(pessimism, judge):
    module, x = module_of("discrete", pessimism=pessimism), torch.randn(B, WIDTH)
    assert torch.allclose(module.q(x), judge(*members(module.target_critic, module.embed(x))), atol=1e-6)


def test_codes_without_support_are_never_chosen_and_count_nothing():
    module, batch = module_of("discrete"), batch_of("discrete")
    module.support_mask[3] = False
    for selection in ("sample", "greedy", "argmax_q"):
        assert 3 not in module.choose(torch.randn(500, WIDTH), selection)
    total, terms = module.loss(batch)
    assert torch.isfinite(total)
    assert terms["entropy"] < math.log(K - 1) + 1e-6


@pytest.mark.parametrize("space", ["continuous", "raw"])
def test_numbers_are_in_their_box_and_greedy_is_the_mode(space):
    module = module_of(space)
    module.action_box.fit(torch.tensor([-2.0, 0.0, 1.0]), torch.tensor([2.0, 1.0, 5.0]))
    chosen = module.choose(10 * torch.randn(300, WIDTH))
    assert (chosen >= module.action_box.low).all()
    assert (chosen <= module.action_box.high).all()
    x = torch.randn(5, WIDTH)
    mean = module.actor.net(module.embed(x)).chunk(2, dim=1)[0].tanh()
    assert torch.allclose(module.choose(x, "greedy"), module.action_box.from_unit(mean))
    with pytest.raises(UserError, match="selection is 'argmax_q', expected sample or greedy"):
        module.choose(x, "argmax_q")


def test_a_fixed_temperature_does_not_learn_and_a_late_policy_waits():
    assert not module_of("discrete", target_entropy=None).log_alpha.requires_grad
    module, batch = module_of("discrete", actor_start=10), batch_of("discrete")
    total, _ = module.loss(batch)
    assert gradients(total, module.actor.parameters()) == (None,) * 6
    module.learning = module.learning_at(10)
    total, _ = module.loss(batch)
    assert all(gradient is not None for gradient in gradients(total, module.actor.parameters()))


def test_the_target_entropy_is_the_settings_whatever_weights_it_starts_from(tmp_path):
    _, path = offline(tmp_path)
    module = module_of("discrete", target_entropy=0.98)
    assert module.target_entropy.item() == pytest.approx(0.98 * math.log(K))
    start_offline(module, path)
    assert module.target_entropy.item() == pytest.approx(0.98 * math.log(K - 1))  # log(K - 1) can be reached
    saved = {"state_dict": module.state_dict(), "hyper_parameters": dict(module.hparams), STAGE_KEY: "online"}
    torch.save(saved, tmp_path / "online.ckpt")
    other = SACModule.starting_from(tmp_path / "online.ckpt", target_entropy=0.2)
    assert other.target_entropy.item() == pytest.approx(0.2 * math.log(K - 1))
    assert torch.equal(other.actor.net[0].weight, module.actor.net[0].weight)
    assert module_of("raw", target_entropy=0.5).target_entropy.item() == -0.5 * D


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"temperature": 0.0}, "model.temperature is 0.0, expected positive"),
        ({"target_entropy": 1.5}, r"model.target_entropy is 1.5, expected null or a share of log K in \[0, 1\]"),
        ({"critics": 0}, "model.critics is 0, expected at least 1"),
        ({"target_ema": 0.0}, r"model.target_ema is 0.0, expected in \(0, 1\]"),
        ({"lr": 0.0}, "model.lr is 0.0, expected positive"),
    ],
)
def test_settings_out_of_range_are_refused(settings, sentence):
    with pytest.raises(UserError, match=sentence):
        module_of("discrete", **settings)


def offline(tmp_path, **settings):
    policy = PolicyModule(WIDTH, K, **{"hidden_dims": [16, 16], **settings})
    policy.normaliser.fit(torch.randn(WIDTH), torch.rand(WIDTH) + 0.5)
    policy.support_mask[0] = False
    torch.save({"state_dict": policy.state_dict(), "hyper_parameters": dict(policy.hparams)}, tmp_path / "p.ckpt")
    return policy, str(tmp_path / "p.ckpt")


@pytest.mark.parametrize("critics", [2, 5])
def test_an_offline_policy_and_its_critics_are_where_it_starts(tmp_path, critics):
    policy, path = offline(tmp_path)
    module = module_of("discrete", critics=critics)
    start_offline(module, path)
    x = torch.randn(9, WIDTH)
    assert torch.equal(module.logits(x), policy.logits(x))
    assert torch.allclose(module.q(x), policy.q(x), atol=1e-6)


def test_a_policy_in_closed_form_becomes_a_network_in_the_states_of_the_data(tmp_path):
    policy, path = offline(tmp_path, awr="closed_form", alpha=3.0, beta_floor=0.05)
    module, states = module_of("discrete"), torch.randn(300, WIDTH)
    start_offline(module, path, states)
    there, here = policy.logits(states).softmax(-1), module.logits(states).softmax(-1)
    assert 0.5 * (there - here).abs().sum(-1).mean() < 0.05  # total variation; 0.4 before
    assert (there.argmax(-1) == here.argmax(-1)).float().mean() > 0.8  # several codes are nearly as good
    assert not here[:, 0].any(), "a code without support became possible"


@pytest.mark.parametrize(
    ("space", "theirs", "sentence"),
    [
        ("discrete", {"hidden_dims": [8]}, r"model.hidden_dims is \[16, 16\], but the policy in .* has \[8\]"),
        ("discrete", {"awr": "closed_form"}, "is in closed form and becomes a network in the states of prior data"),
        ("raw", {}, "a policy over codes, but the choices are raw: expected discrete"),
    ],
)
def test_an_offline_policy_that_does_not_fit_is_refused(tmp_path, space, theirs, sentence):
    _, path = offline(tmp_path, **theirs)
    with pytest.raises(UserError, match=sentence):
        start_offline(module_of(space), path)


def test_weights_start_from_one_checkpoint():
    with pytest.raises(UserError, match=r"model.offline is a.ckpt and model.init_from is b.ckpt, expected one of them"):
        SACModule(WIDTH, "discrete", K, offline="a.ckpt", init_from="b.ckpt")


def test_another_number_of_codes_is_refused(tmp_path):
    _, path = offline(tmp_path)
    module = copy.copy(SACModule(WIDTH, "discrete", K + 1, hidden_dims=[16, 16]))
    with pytest.raises(UserError, match=f"data.skill has {K + 1} codes, but the policy in .* among {K}"):
        start_offline(module, path)
