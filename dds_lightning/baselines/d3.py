"""TD3+BC, IQL, CQL and Decision Transformer by d3rlpy, as stages of ours.

Networks, losses and update are d3rlpy's; data, units, checkpoints, resuming and evaluation are ours. One update of the
algorithm is one optimiser step of the Trainer, and goes on bit for bit after a stop: weights are in the module's state,
moments and schedules in the optimiser's, and d3rlpy counts steps by the Trainer's.

`save_d3` writes d3rlpy's own format. It is a pickle, so nothing here reads one: ours are the checkpoints.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from dds_lightning.errors import lacks_extra
from dds_lightning.module import StageModule
from dds_lightning.nn.embedding import FOURIER
from dds_lightning.nn.normaliser import ActionBox

GAMMA = 0.99
"""d3rlpy takes a power of one discount; batches say theirs."""
Batch = dict[str, Tensor]


def library() -> Any:
    """Import d3rlpy.

    Raises:
        UserError: It is not installed.
    """
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # gym, which it imports, tells of its age there
            import d3rlpy
    except ImportError as error:
        # No extra can bring d3rlpy itself: it asks for gymnasium 1.0.0, does without, and this project does not.
        alone = "pip install --no-deps -c constraints.txt d3rlpy"
        raise lacks_extra(f"this baseline needs d3rlpy ({error})", "baselines", alone) from None
    return d3rlpy


class Optimisers(torch.optim.Optimizer):
    """The optimisers of an algorithm as one, which d3rlpy itself steps: kept in checkpoints, and counted once.

    Args:
        parts: d3rlpy's, by name.
        parameters: All that they move.
    """

    def __init__(self, parts: Mapping[str, Any], parameters: Sequence[nn.Parameter]) -> None:
        super().__init__(list(parameters), {})
        self.parts = parts

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Run the training step, in which the algorithm updates itself."""
        return closure() if closure is not None else None

    def state_dict(self) -> dict[str, Any]:
        """That of each part."""
        return {name: part.state_dict() for name, part in self.parts.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore each part."""
        for name, part in self.parts.items():
            part.load_state_dict(state_dict[name])


class D3Module(StageModule):
    """An algorithm of d3rlpy as a stage; a subclass has the settings."""

    PARTS: ClassVar = {"networks": ("networks",)}
    PREDICTION = "action"
    CONFIG: ClassVar[str]
    """Name of its configuration in `d3rlpy.algos`."""

    def _build(self, init_from: str | None, **config: Any) -> None:
        """Make the algorithm from its configuration, and our units around it; the settings are checked before."""
        h = self.hparams
        width = self._make_embedding(h)
        self.action_box = ActionBox(h.action_dim)
        device = "meta" if torch.get_default_device().type == "meta" else "cpu:0"
        self.algorithm = getattr(library().algos, self.CONFIG)(gamma=GAMMA, **config).create(device)
        self.algorithm.create_impl((width,), h.action_dim)
        parts = vars(self.algorithm.impl.modules)
        self.networks = nn.ModuleDict({name: part for name, part in parts.items() if isinstance(part, nn.Module)})
        self._optimisers = {name: part for name, part in parts.items() if hasattr(part, "optim")}
        self._begin(init_from)

    def torch_batch(self, batch: Batch) -> Any:
        """Our batch as d3rlpy's, in units of the networks."""
        ones = torch.ones_like(batch["rewards"])[:, None]
        actions = self.action_box.to_unit(batch["actions"])
        return library().torch_utility.TorchMiniBatch(
            observations=self.embed(batch["observations"]),
            actions=actions,
            rewards=batch["rewards"][:, None],
            next_observations=self.embed(batch["next_observations"]),
            next_actions=torch.zeros_like(actions),  # none of the algorithms here asks for these two
            returns_to_go=torch.zeros_like(ones),
            terminals=batch["dones"][:, None],
            intervals=(batch["discounts"].log() / torch.tensor(GAMMA).log().to(ones))[:, None],
            device=str(self.device),
        )

    def on_fit_start(self) -> None:
        """Use the data's statistics, unless a checkpoint provided them."""
        self.fit_units()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """One update by d3rlpy; returns the sum of what it reports as losses."""
        found = self.algorithm.impl.update(self.torch_batch(batch), self.global_step)
        self.terms = {name: torch.tensor(float(value)) for name, value in found.items()}
        total = sum((value for name, value in self.terms.items() if "loss" in name), torch.zeros(()))
        self.log_training(total)
        return total

    def backward(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Done by d3rlpy."""

    def optimizer_zero_grad(self, *args: Any, **kwargs: Any) -> None:
        """Done by d3rlpy."""

    def configure_optimizers(self) -> Optimisers:
        """The algorithm's."""
        return Optimisers(self._optimisers, [p for p in self.networks.parameters() if p.requires_grad])

    def evaluate(self, batch: Batch, stage: str) -> None:
        """Log how far the actions are from the data's on held-out episodes: d3rlpy has no losses without an update."""
        error = (self.unit_actions(batch["observations"]) - self.action_box.to_unit(batch["actions"])).square().mean()
        self.log(f"{stage}/action_mse", error, batch_size=len(batch["actions"]), sync_dist=True)

    def unit_actions(self, observations: Tensor) -> Tensor:
        """The best actions (B, A) in [-1, 1] for observations (B, O)."""
        actions: Tensor = self.algorithm.impl.predict_best_action(self.embed(observations))
        return actions

    def act(self, observations: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Actions (B, A) for observations (B, O)."""
        return self.action_box.from_unit(self.unit_actions(observations))

    def predict_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Actions (B, A) for the states of a batch."""
        return self.act(batch["observations"])

    def save_d3(self, path: str | Path) -> None:
        """Write the algorithm as `d3rlpy.load_learnable` reads it; it takes what `embed` makes of observations."""
        self.algorithm.save(str(path))


def _encoder(hidden_dims: Sequence[int]) -> Any:
    return library().models.VectorEncoderFactory(list(hidden_dims))


class TD3BC(D3Module):
    """TD3+BC (Fujimoto and Gu, 2021, equations 3 to 5) over single steps; defaults are the authors'.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of all networks.
        alpha: Weight of Q beside imitation.
        target_ema: Rate of the targets.
        lr: Learning rate of actor and critic.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.
    """

    STAGE, CONFIG = "td3bc", "TD3PlusBCConfig"
    SHAPE = ("hidden_dims", *FOURIER)

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        alpha: float = 2.5,
        target_ema: float = 0.005,
        lr: float = 3e-4,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [("alpha", alpha >= 0, "0 or more"), ("target_ema", 0 < target_ema <= 1, "in (0, 1]")]
        self._refuse(rules)
        rates = {"actor_learning_rate": lr, "critic_learning_rate": lr, "tau": target_ema}
        encoders = dict.fromkeys(("actor_encoder_factory", "critic_encoder_factory"), _encoder(hidden_dims))
        self._build(init_from, alpha=alpha, **rates, **encoders)


class IQL(D3Module):
    """IQL (Kostrikov et al., 2021, equations 5 to 7) over single steps; defaults are the authors' for locomotion.

    Their actor's learning rate decays by a cosine; here it stays.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of all networks.
        tau: Expectile; the authors take 0.9 on AntMaze.
        beta: Inverse temperature; the authors take 10 on AntMaze, 0.5 in the kitchen.
        weight_clip: Upper bound of the regression's weights.
        target_ema: Rate of the target critic.
        lr: Learning rate of all networks.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.
    """

    STAGE, CONFIG = "iql", "IQLConfig"
    SHAPE = ("hidden_dims", *FOURIER)

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256),
        tau: float = 0.7,
        beta: float = 3.0,
        weight_clip: float = 100.0,
        target_ema: float = 0.005,
        lr: float = 3e-4,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [("tau", 0 < tau < 1, "in (0, 1)"), ("target_ema", 0 < target_ema <= 1, "in (0, 1]")]
        rules += [("beta", beta >= 0, "0 or more"), ("weight_clip", weight_clip > 0, "positive")]
        self._refuse(rules)
        rates = {"actor_learning_rate": lr, "critic_learning_rate": lr, "tau": target_ema}
        names = ("actor_encoder_factory", "critic_encoder_factory", "value_encoder_factory")
        encoders = dict.fromkeys(names, _encoder(hidden_dims))
        shape = {"expectile": tau, "weight_temp": beta, "max_weight": weight_clip}
        self._build(init_from, **shape, **rates, **encoders)


class CQL(D3Module):
    """CQL (Kumar et al., 2020, equation 4) over single steps; defaults are d3rlpy's for D4RL.

    Args:
        observation_dim: O, linked from the data on the command line.
        action_dim: A, linked from the data.
        hidden_dims: Widths of all networks.
        conservatism: Weight of the conservative term; 10 for data of a medium policy.
        samples: Actions that stand for all others in the conservative term.
        target_ema: Rate of the target critic.
        lr: Learning rate of the critic.
        actor_lr: Learning rate of the actor and of its entropy's temperature.
        fourier_features: Frequencies that all networks see beside the observation; 0 for none. Ours takes 64 in mazes.
        fourier_scale: Standard deviation of those frequencies.
        fourier_seen: How many leading numbers of the observation they see; 0 for all.
        init_from: ``.ckpt`` or published directory with the initial weights (`dds_lightning.finetune`).
        refit_normaliser: With ``init_from``, take the statistics of the new data, not the checkpoint's.
    """

    STAGE, CONFIG = "cql", "CQLConfig"
    SHAPE = ("hidden_dims", *FOURIER)

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        hidden_dims: Sequence[int] = (256, 256, 256),
        conservatism: float = 5.0,
        samples: int = 10,
        target_ema: float = 0.005,
        lr: float = 3e-4,
        actor_lr: float = 1e-4,
        fourier_features: int = 0,
        fourier_scale: float = 1.0,
        fourier_seen: int = 0,
        init_from: str | None = None,
        refit_normaliser: bool = False,
    ) -> None:
        super().__init__()
        hidden_dims = list(hidden_dims)
        self.save_hyperparameters(ignore=["init_from"])
        rules = [("conservatism", conservatism >= 0, "0 or more"), ("samples", samples >= 1, "at least 1")]
        rules += [("actor_lr", actor_lr > 0, "positive"), ("target_ema", 0 < target_ema <= 1, "in (0, 1]")]
        self._refuse(rules)
        rates = {"actor_learning_rate": actor_lr, "temp_learning_rate": actor_lr, "critic_learning_rate": lr}
        rates |= {"alpha_learning_rate": 0.0, "tau": target_ema}  # the weight of the conservative term stays
        encoders = dict.fromkeys(("actor_encoder_factory", "critic_encoder_factory"), _encoder(hidden_dims))
        shape = {"conservative_weight": conservatism, "n_action_samples": samples}
        self._build(init_from, **shape, **rates, **encoders)
