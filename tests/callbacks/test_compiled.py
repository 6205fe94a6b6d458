"""A compiled loss trains as the module's own does, for every stage, and leaves no trace in the module."""

import shutil

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader

from dds_lightning import PolicyModule, SkillModule
from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
from dds_lightning.callbacks import CompiledLoss, FiniteGuard
from dds_lightning.callbacks.compiled import COMPILERS
from dds_lightning.errors import UserError
from dds_lightning.online.sac import SACModule
from tests.modules import fit

ROWS = 8


def segments() -> list[dict[str, torch.Tensor]]:
    generator = torch.Generator().manual_seed(0)
    return [
        {
            "observations": torch.randn(5, 3, generator=generator),
            "actions": torch.rand(5, 2, generator=generator) * 2 - 1,
        }
        for _ in range(4 * ROWS)
    ]


def transitions(key: str) -> list[dict[str, torch.Tensor]]:
    generator = torch.Generator().manual_seed(0)
    return [
        {
            "observations": torch.randn(3, generator=generator),
            key: torch.randint(4, (), generator=generator),
            "rewards": torch.randn((), generator=generator),
            "next_observations": torch.randn(3, generator=generator),
            "discounts": torch.tensor(0.9),
            "dones": torch.tensor(0.0),
        }
        for _ in range(4 * ROWS)
    ]


def skill() -> SkillModule:
    return SkillModule(
        3, 2, 5, num_skills=4, skill_dim=4, hidden_dim=8, encoder_layers=1, encoder_heads=1, decoder_blocks=1
    )


STAGES = {
    "skill": (skill, segments),
    "policy joint": (
        lambda: PolicyModule(3, 4, hidden_dims=[8], extraction="joint", fourier_features=4, fourier_seen=2),
        lambda: transitions("codes"),
    ),
    "policy with dropout": (
        lambda: PolicyModule(3, 4, hidden_dims=[8], extraction="joint", dropout=0.5),
        lambda: transitions("codes"),
    ),
    "policy after": (
        lambda: PolicyModule(3, 4, hidden_dims=[8], extraction="after", critic_steps=2),
        lambda: transitions("codes"),
    ),
    "clone": (lambda: BehaviourCloning(3, 2, hidden_dims=[8]), segments),
    "online": (lambda: SACModule(3, "discrete", 4, hidden_dims=[8]), lambda: transitions("actions")),
}


def train(make, data, *more: pl.Callback) -> pl.LightningModule:
    torch._dynamo.reset()
    pl.seed_everything(0, verbose=False)
    module = make()
    module.normaliser.fit(torch.zeros(3), torch.ones(3))
    if hasattr(module, "action_box") and module.action_box.low.numel():
        module.action_box.fit(-torch.ones(2), torch.ones(2))
    fit(module, DataLoader(data(), batch_size=ROWS), 4, callbacks=[FiniteGuard(), *more])
    return module


@pytest.mark.parametrize("stage", STAGES)
def test_it_trains_as_the_modules_own_loss_does(stage):
    make, data = STAGES[stage]
    own, compiled = train(make, data), train(make, data, CompiledLoss(backend="aot_eager"))
    assert "loss" not in vars(compiled)
    assert list(own.state_dict()) == list(compiled.state_dict())
    for name, value in own.state_dict().items():
        torch.testing.assert_close(compiled.state_dict()[name], value, rtol=1e-4, atol=1e-5, msg=name)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 0


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, COMPILERS)), reason="needs a C++ compiler")
def test_the_compilers_code_draws_what_torch_draws():
    make, data = STAGES["policy with dropout"]
    own, compiled, other = (train(make, data, *more) for more in ([], [CompiledLoss()], [OtherDraws(), CompiledLoss()]))
    for name, value in own.actor.state_dict().items():
        torch.testing.assert_close(compiled.actor.state_dict()[name], value, rtol=1e-4, atol=1e-5, msg=name)
    assert not torch.allclose(other.actor[0].weight, own.actor[0].weight, rtol=1e-4, atol=1e-5)


class OtherDraws(pl.Callback):
    """So that the test above notices other masks."""

    def on_train_start(self, trainer, pl_module):
        torch.manual_seed(1)


def test_the_compilers_settings_are_as_before():
    import torch._functorch.config as settings

    if not hasattr(settings, "ban_recompute_materialized_backward"):
        pytest.skip("this torch has no such setting")
    make, data = STAGES["clone"]
    before, seen = settings.ban_recompute_materialized_backward, []

    class Look(pl.Callback):
        def on_train_batch_end(self, *_):
            seen.append(settings.ban_recompute_materialized_backward)

    train(make, data, CompiledLoss(backend="aot_eager"), Look())
    assert (before, set(seen)) == (True, {False})
    assert settings.ban_recompute_materialized_backward == before


def test_a_machine_without_a_compiler_is_told(monkeypatch):
    monkeypatch.setenv("PATH", "")
    make, data = STAGES["clone"]
    with pytest.raises(UserError, match=r"needs a C\+\+ compiler"):
        train(make, data, CompiledLoss())
