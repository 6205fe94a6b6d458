"""The names and shapes of what checkpoints hold: who changes them makes every saved checkpoint unreadable."""

import pytest
import torch

from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule

SMALL = {"hidden_dim": 16, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 8}

COMMON = """
normaliser.fitted -
normaliser.mean 3
normaliser.std 3
"""
SKILL = """
action_box.high 2
action_box.low 2
encoder.embedding.bias 16
encoder.embedding.weight 16 5
encoder.projection.0.bias 16
encoder.projection.0.weight 16 16
decoder.net.blocks.0.net.0.bias 16
decoder.net.blocks.0.net.0.weight 16
decoder.net.blocks.0.net.2.bias 64
decoder.net.blocks.0.net.2.weight 64 16
decoder.net.blocks.0.net.4.bias 16
decoder.net.blocks.0.net.4.weight 16 64
decoder.net.input.bias 16
decoder.net.output.bias 2
decoder.net.output.weight 2 16
"""
TRANSFORMER = """
encoder.layers.layers.0.linear1.bias 64
encoder.layers.layers.0.linear1.weight 64 16
encoder.layers.layers.0.linear2.bias 16
encoder.layers.layers.0.linear2.weight 16 64
encoder.layers.layers.0.norm1.bias 16
encoder.layers.layers.0.norm1.weight 16
encoder.layers.layers.0.norm2.bias 16
encoder.layers.layers.0.norm2.weight 16
encoder.layers.layers.0.self_attn.in_proj_bias 48
encoder.layers.layers.0.self_attn.in_proj_weight 48 16
encoder.layers.layers.0.self_attn.out_proj.bias 16
encoder.layers.layers.0.self_attn.out_proj.weight 16 16
encoder.positions 5 16
"""
GRU = """
encoder.narrow.bias 16
encoder.narrow.weight 16 30
encoder.recurrence.bias_hh_l0 45
encoder.recurrence.bias_hh_l0_reverse 45
encoder.recurrence.bias_ih_l0 45
encoder.recurrence.bias_ih_l0_reverse 45
encoder.recurrence.weight_hh_l0 45 15
encoder.recurrence.weight_hh_l0_reverse 45 15
encoder.recurrence.weight_ih_l0 45 16
encoder.recurrence.weight_ih_l0_reverse 45 16
"""
VQ = """
bottleneck.initted -
bottleneck.usage 4
bottleneck.vectors 4 8
encoder.projection.2.bias 8
encoder.projection.2.weight 8 16
"""
EMA = """
bottleneck.ema_count 4
bottleneck.ema_sum 4 8
"""
GAUSSIAN = """
encoder.projection.2.bias 16
encoder.projection.2.weight 16 16
"""
DIFFUSION = """
decoder.alpha_bars 5
decoder.betas 5
decoder.net.input.weight 16 29
decoder.time_table 5 16
"""
MLP = """
decoder.net.input.weight 16 11
"""
POLICY = """
actor.0.bias 16
actor.0.weight 16 3
actor.2.bias 4
actor.2.weight 4 16
critic.0.bias 2 1 16
critic.0.weight 2 3 16
critic.2.bias 2 1 4
critic.2.weight 2 16 4
support_mask 4
target_critic.0.bias 2 1 16
target_critic.0.weight 2 3 16
target_critic.2.bias 2 1 4
target_critic.2.weight 2 16 4
value.0.bias 16
value.0.weight 16 3
value.2.bias 1
value.2.weight 1 16
value_range 2
"""
WIDE_POLICY = """
actor.0.bias 16
actor.0.weight 16 11
actor.2.bias 4
actor.2.weight 4 16
critic.0.bias 2 1 16
critic.0.weight 2 11 16
critic.1.bias 16
critic.1.weight 16
critic.3.bias 2 1 4
critic.3.weight 2 16 4
features.frequencies 3 4
support_mask 4
target_critic.0.bias 2 1 16
target_critic.0.weight 2 11 16
target_critic.1.bias 16
target_critic.1.weight 16
target_critic.3.bias 2 1 4
target_critic.3.weight 2 16 4
value.0.bias 16
value.0.weight 16 11
value.1.bias 16
value.1.weight 16
value.3.bias 1
value.3.weight 1 16
value_range 2
"""
MODULES = {
    "skill": ({}, SKILL + TRANSFORMER + VQ + DIFFUSION),
    "skill, gru": ({"encoder": "gru"}, SKILL + GRU + VQ + DIFFUSION),
    "skill, mlp": ({"decoder": "mlp"}, SKILL + TRANSFORMER + VQ + MLP),
    "skill, gaussian": ({"bottleneck": "gaussian"}, SKILL + TRANSFORMER + GAUSSIAN + DIFFUSION),
    "skill, ema": ({"codebook_ema": 0.9}, SKILL + TRANSFORMER + VQ + EMA + DIFFUSION),
    "policy": ({}, POLICY),
    "policy, wide": ({"layer_norm": True, "fourier_features": 4}, WIDE_POLICY),
}


def build(name):
    settings = MODULES[name][0]
    if name.startswith("skill"):
        return SkillModule(3, 2, horizon=5, num_skills=4, **SMALL, **settings)
    return PolicyModule(3, 4, hidden_dims=[16], **settings)


def written(state):
    """Sorted lines like those above."""
    return sorted(f"{name} {' '.join(map(str, value.shape)) or '-'}" for name, value in state.items())


@pytest.mark.parametrize("name", MODULES)
def test_a_checkpoint_holds_these_names_and_shapes(name):
    expected = sorted(line for line in (COMMON + MODULES[name][1]).splitlines() if line)
    assert written(build(name).state_dict()) == expected


def test_masks_and_flags_are_booleans_and_everything_else_single_precision():
    kinds = {f"{n}.{key}": v.dtype for n in ("skill", "policy") for key, v in build(n).state_dict().items()}
    flags = {"skill.bottleneck.initted", "skill.normaliser.fitted", "policy.normaliser.fitted", "policy.support_mask"}
    assert {name for name, dtype in kinds.items() if dtype == torch.bool} == flags
    assert {dtype for name, dtype in kinds.items() if name not in flags} == {torch.float32}


@pytest.mark.parametrize("name", ["skill", "policy"])
def test_compiling_in_place_changes_no_name(name):
    """`torch.compile(module)` would put `_orig_mod.` before every one of them."""
    module = build(name)
    before = written(module.state_dict())
    module.compile()
    assert written(module.state_dict()) == before
    for part in module.children():
        part.compile()
    assert written(module.state_dict()) == before
