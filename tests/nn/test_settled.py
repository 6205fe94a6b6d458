"""Segments whose codes stand still are encoded once: the same bits, in checkpoints, for one training only."""

import numpy as np
import pytest
import torch

from datamodules.segments import SegmentDataModule
from datamodules.trajectories import Trajectories
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.nn.settled import SettledCodes
from dds_lightning.training.trainer import trainer_settings
from tests.test_skill import QUIET, small

STEPS, AFTER = 40, 6


def data(seed=0):
    rng = np.random.default_rng(seed)
    episodes = [
        {
            "observations": rng.normal(size=(31, 3)).astype(np.float32),
            "actions": rng.uniform(-1, 1, (30, 2)).astype(np.float32),
            "rewards": np.zeros(30, np.float32),
            "terminations": np.zeros(30, bool),
            "truncations": np.arange(30) == 29,
        }
        for _ in range(4)
    ]
    return Trajectories.from_episodes(f"random {seed}", episodes, action_low=-1, action_high=1)


class Nameless(SegmentDataModule):
    """Batches that do not say where their segments start."""

    def _loader(self, *args, **kwargs):
        loader = super()._loader(*args, **kwargs)
        gather = loader.gather
        loader.gather = lambda index: {name: x for name, x in gather(index).items() if name != "starts"}
        return loader


def train(module, steps=STEPS, seed=0, kind=SegmentDataModule, ckpt_path=None, **settings):
    """Train, and return how often the encoder ran after the codes stood still."""
    import lightning.pytorch as pl

    calls = []
    encode = module.encode
    module.encode = lambda *args: calls.append(module.global_step) or encode(*args)
    base = {"max_steps": steps, "accelerator": "cpu", "num_sanity_val_steps": 0, "limit_val_batches": 0}
    loader = kind.from_trajectories(data(seed), horizon=5, batch_size=8, validation_fraction=0.0)
    trainer = pl.Trainer(**(QUIET | base | settings))
    torch.manual_seed(1)
    trainer.fit(module, loader, ckpt_path=ckpt_path, weights_only=True)
    return calls


@pytest.mark.parametrize(
    "settings", [{"freeze_codes_after": AFTER}, {"freeze_codes_after": AFTER, "codebook_ema": 0.9}]
)
def test_looking_codes_up_gives_the_bits_of_encoding_again(settings):
    known, encoded = small(lr=1e-3, **settings), small(lr=1e-3, **settings)
    few, many = train(known), train(encoded, kind=Nameless)
    assert all(torch.equal(x, encoded.state_dict()[name]) for name, x in known.state_dict().items())
    assert len(many) == STEPS - AFTER  # every batch
    assert max(few) < 2 * 13  # by the end of the second epoch all 104 segments are known


def test_a_checkpoint_holds_the_codes_and_a_training_goes_on_to_the_same_bits(tmp_path):
    def run(name, steps, ckpt_path=None):
        keeps = trainer_settings(
            {"enable_checkpointing": True, "enable_progress_bar": True}, [RollingCheckpoint(str(tmp_path / name))]
        )
        module = small(lr=1e-3, freeze_codes_after=AFTER)
        return train(module, steps, ckpt_path=ckpt_path, **keeps), module.state_dict()

    _, through = run("through", STEPS)
    run("parts", 27)
    (state,) = (
        state
        for name, state in torch.load(tmp_path / "parts" / "last.ckpt", weights_only=True)["callbacks"].items()
        if name.startswith(SettledCodes.__name__)
    )
    assert (state["codes"] >= 0).sum() == 104
    calls, resumed = run("parts", STEPS, ckpt_path=tmp_path / "parts" / "last.ckpt")
    assert calls == []
    assert all(torch.equal(x, resumed[name]) for name, x in through.items())


def test_another_training_of_the_same_module_asks_for_codes_of_its_own():
    module = small(lr=1e-3, freeze_codes_after=AFTER)
    train(module)
    module.hparams.freeze_codes_after = 1  # from the first step on, with the codes that it has
    assert len(train(module, seed=1)) >= 13


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_codes_of_a_checkpoint_go_where_the_batches_are():
    settled, starts = SettledCodes(), torch.tensor([0, 2], device="cuda")
    settled.load_state_dict({"codes": torch.tensor([3, -1, 1], dtype=torch.int16)})
    assert settled._known(starts, lambda: pytest.fail("both are known")).tolist() == [3, 1]
