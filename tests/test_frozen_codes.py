"""Codes that stand still from a step on: bits, averages, resuming, and training on."""

import pytest
import torch

from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.errors import UserError
from dds_lightning.training.trainer import trainer_settings
from tests.test_skill import fit, segments, small

AFTER = 12


class Watch(AverageWeights):
    """Averages as they are told to; keeps encoder, codebook and decoder after every step."""

    def __init__(self):
        super().__init__(0.9)
        self.seen = []

    def on_train_batch_end(self, trainer, pl_module, *args, **kwargs):
        super().on_train_batch_end(trainer, pl_module, *args, **kwargs)
        state = pl_module.state_dict()
        self.seen.append({name: value.clone() for name, value in state.items()})


def parts(state):
    """Name to whether it belongs to the codes."""
    return {name: name.startswith(("encoder.", "bottleneck.")) for name in state}


@pytest.mark.parametrize("ema", [None, 0.9])
def test_from_then_on_only_the_decoder_learns_and_the_average_has_the_codes_as_they_are(ema):
    module, watch = small(lr=1e-3, freeze_codes_after=AFTER, codebook_ema=ema), Watch()
    fit(module, 20, callbacks=[watch], limit_val_batches=0)
    at, end, learnt = watch.seen[AFTER - 1], watch.seen[-1], module.state_dict()
    for name, of_codes in parts(at).items():
        if of_codes:
            assert torch.equal(at[name], end[name]), name
            assert torch.equal(at[name], learnt[name]), f"{name} was averaged"
    assert not torch.equal(at["decoder.net.output.weight"], end["decoder.net.output.weight"])
    assert not torch.equal(watch.seen[AFTER - 2]["encoder.embedding.weight"], at["encoder.embedding.weight"])


def test_until_then_the_training_is_that_without_freezing():
    states = []
    for after in (None, AFTER):
        watch = Watch()
        fit(small(lr=1e-3, freeze_codes_after=after), AFTER + 3, callbacks=[watch], limit_val_batches=0)
        states.append(watch.seen)
    plain, frozen = states
    assert all(torch.equal(plain[AFTER - 1][name], value) for name, value in frozen[AFTER - 1].items())
    assert not torch.equal(plain[-1]["encoder.embedding.weight"], frozen[-1]["encoder.embedding.weight"])


def test_a_frozen_step_leaves_encoder_and_codebook_without_gradients():
    module = small(freeze_codes_after=1)
    module.hold(("encoder", "bottleneck"))
    module.loss(segments())[0].backward()
    assert all(p.grad is None for name in ("encoder", "bottleneck") for p in getattr(module, name).parameters())
    assert all(p.grad is not None for p in module.decoder.parameters())
    module.hold(())
    module.loss(segments())[0].backward()
    assert all(p.grad is not None for p in module.encoder.parameters())


@pytest.mark.parametrize("stop", [7, 15])
def test_stopped_before_or_after_it_a_training_goes_on_to_the_same_bits(tmp_path, stop):
    def run(name, steps, ckpt_path=None):
        module = small(lr=1e-3, freeze_codes_after=AFTER, restart_every=4)
        shown = {"enable_checkpointing": True, "enable_progress_bar": True}
        settings = trainer_settings(shown, [RollingCheckpoint(str(tmp_path / name)), AverageWeights(0.9)])
        fit(module, steps, ckpt_path, limit_val_batches=0, **settings)
        return module.state_dict()

    through = run("through", 20)
    run("parts", stop)
    resumed = run("parts", 20, ckpt_path=tmp_path / "parts" / "last.ckpt")
    assert all(torch.equal(value, resumed[name]) for name, value in through.items())


def test_a_model_that_is_trained_anew_starts_with_moving_codes():
    module = small(lr=1e-3, freeze_codes_after=3)
    fit(module, 5, limit_val_batches=0)
    before = module.encoder.embedding.weight.clone()
    fit(module, 2, limit_val_batches=0)
    assert not torch.equal(before, module.encoder.embedding.weight)


def test_a_step_before_the_first_is_refused():
    with pytest.raises(UserError, match=r"model\.freeze_codes_after is 0, expected null or at least 1"):
        small(freeze_codes_after=0)
