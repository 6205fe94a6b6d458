"""A task with a known answer: two modes of behaviour, of which the observation says which one pays.

An observation is (x, c), c is -1 or 1 for a whole episode, x moves by 0.2 a. The data push in either direction,
a = -0.6 or 0.6, kept for an episode. Every step pays c a. So the best action is 0.6 c; imitation of both modes gives 0.
"""

import lightning.pytorch as pl
import numpy as np
import torch

from datamodules.trajectories import Trajectories
from dds_lightning.callbacks.resume import ExactResume

LENGTH = 8


def two_modes(episodes: int = 200, seed: int = 0) -> Trajectories:
    random = np.random.default_rng(seed)
    made = []
    for _ in range(episodes):
        pays, mode = random.choice([-1.0, 1.0], 2)
        actions = 0.6 * mode + 0.05 * random.standard_normal((LENGTH, 1))
        x = np.concatenate([[0.0], 0.2 * np.cumsum(actions)]) + 0.3 * random.standard_normal()
        last = np.arange(LENGTH) == LENGTH - 1
        made.append(
            {
                "observations": np.stack([x, np.full_like(x, pays)], axis=1).astype(np.float32),
                "actions": actions.astype(np.float32),
                "rewards": (pays * actions[:, 0]).astype(np.float32),
                "terminations": last,
                "truncations": np.zeros(LENGTH, bool),
            }
        )
    return Trajectories.from_episodes("two modes", made)


def train(module, data, steps: int, checkpoint: str | None = None, **options):
    trainer = pl.Trainer(
        max_steps=steps,
        max_epochs=-1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        accelerator="cpu",
        limit_val_batches=0,
        check_val_every_n_epoch=None,
        **options,
    )
    trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    return module


def assert_resumes(make, data, folder) -> None:
    """A training that stopped after 4 of 9 steps and went on ends with the bits of one that never stopped.

    Args:
        make: Makes the module.
        data: Makes the data module.
        folder: For the checkpoint.
    """

    def go(steps, checkpoint=None):
        torch.manual_seed(0)
        module = make()
        train(module, data(), steps, checkpoint, callbacks=[ExactResume()])
        assert module.trainer.global_step == steps
        return module

    through = go(9)
    go(4).trainer.save_checkpoint(folder / "4.ckpt")
    resumed = go(9, str(folder / "4.ckpt"))
    started = make().state_dict()
    assert any(not torch.equal(value, started[name]) for name, value in through.state_dict().items())
    assert all(torch.equal(value, resumed.state_dict()[name]) for name, value in through.state_dict().items())


def regret(actor, episodes: int = 32) -> float:
    """How far an actor stays below the best return of the toy, 0.6 a step, per step; imitation has 0.6."""
    random = np.random.default_rng(1)
    pays = np.tile([-1.0, 1.0], episodes // 2)
    x = 0.3 * random.standard_normal(episodes)
    rows, earned = np.arange(episodes), 0.0
    actor.reset(episodes, seed=0)
    for step in range(LENGTH):
        observations = np.stack([x, pays], axis=1).astype(np.float32)
        acted = actor.act(observations, np.full(episodes, step == 0), rows)
        actions = getattr(acted, "actions", acted)[:, 0]
        assert np.abs(actions).max() <= 1.0
        paid = pays * actions
        if hasattr(actor, "paid"):
            actor.paid(paid.astype(np.float32), rows)
        x, earned = x + 0.2 * actions, earned + paid.mean() / LENGTH
    return 0.6 - float(earned)


def batch_of(observation_dim: int = 3, choice_dim: int = 2, size: int = 16, seed: int = 0) -> dict[str, torch.Tensor]:
    """A fixed batch of transitions."""
    stream = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=stream)

    return {
        "observations": normal(size, observation_dim),
        "actions": normal(size, choice_dim).clamp(-1, 1),
        "rewards": normal(size),
        "next_observations": normal(size, observation_dim),
        "discounts": torch.full((size,), 0.9),
        "dones": (torch.arange(size) % 4 == 0).float(),
    }


def dense(network, x: torch.Tensor, member: int) -> torch.Tensor:
    """One member of an ensemble MLP, written out: (B, I) to (B,)."""
    layers = [layer for layer in network if hasattr(layer, "weight")]
    for number, layer in enumerate(layers):
        x = x @ layer.weight[member] + layer.bias[member]
        x = x.clamp_min(0) if number < len(layers) - 1 else x
    return x.squeeze(-1)
