"""One update of other packages' closest algorithm, on the same numbers: what `bench.py` measures beside ours.

Each maker returns a function that does one update on a ready batch, so that nobody pays for reading data. Sizes are
ours: two hidden layers of 256, batches of 256 (512 for cloning). A package that is missing raises ImportError.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

Update = Callable[[], Any]
Batch = dict[str, Tensor]
WIDTHS = [256, 256]
TAU, ALPHA, CLIP, EMA, LR = 0.7, 3.0, 100.0, 0.005, 3e-4


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers with ReLU."""
    layers: list[nn.Module] = []
    for width in WIDTHS:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def single_file_iql(batch: Batch, skills: int) -> Update:
    """Discrete IQL as single-file implementations write it: one optimiser a network, one after the other, float32."""
    observations, codes = batch["observations"], batch["codes"][:, None]
    width = observations.shape[1]
    value, actor = mlp(width, 1), mlp(width, skills)
    critics, targets = ([mlp(width, skills) for _ in range(2)] for _ in range(2))
    for target, critic in zip(targets, critics, strict=True):
        target.load_state_dict(critic.state_dict())
    value_adam, actor_adam = (torch.optim.Adam(net.parameters(), lr=LR) for net in (value, actor))
    critic_adam = torch.optim.Adam([p for critic in critics for p in critic.parameters()], lr=LR)

    def step(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()

    def update() -> None:
        with torch.no_grad():
            next_v = value(batch["next_observations"]).squeeze(-1)
            q = torch.minimum(*(target(observations).gather(1, codes).squeeze(-1) for target in targets))
        advantage = q - value(observations).squeeze(-1)
        step(value_adam, (torch.abs(TAU - (advantage < 0).float()) * advantage**2).mean())
        wanted = batch["rewards"] + batch["discounts"] * (1.0 - batch["dones"]) * next_v
        losses = [
            nn.functional.mse_loss(critic(observations).gather(1, codes).squeeze(-1), wanted) for critic in critics
        ]
        step(critic_adam, losses[0] + losses[1])
        with torch.no_grad():
            for target, critic in zip(targets, critics, strict=True):
                for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
                    slow.data.copy_((1 - EMA) * slow.data + EMA * fast.data)
        weights = torch.exp(ALPHA * advantage.detach()).clamp(max=CLIP)
        step(
            actor_adam,
            (weights * nn.functional.cross_entropy(actor(observations), codes.squeeze(-1), reduction="none")).mean(),
        )

    return update


def torchrl_iql(batch: Batch, skills: int) -> Update:
    """TorchRL's DiscreteIQLLoss with its own target updater and one Adam."""
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torch.distributions import Categorical
    from torchrl.modules import ProbabilisticActor
    from torchrl.objectives import DiscreteIQLLoss, SoftUpdate

    width, rows = batch["observations"].shape[1], len(batch["codes"])
    actor = ProbabilisticActor(
        TensorDictModule(mlp(width, skills), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
    )
    loss = DiscreteIQLLoss(
        actor,
        TensorDictModule(mlp(width, skills), ["observation"], ["state_action_value"]),
        TensorDictModule(mlp(width, 1), ["observation"], ["state_value"]),
        action_space="categorical",
        num_qvalue_nets=2,
        loss_function="l2",
        temperature=ALPHA,
        expectile=TAU,
    )
    loss.make_value_estimator(gamma=0.99)
    updater = SoftUpdate(loss, eps=1.0 - EMA)
    optimiser = torch.optim.Adam(loss.parameters(), lr=LR)
    ends = batch["dones"][:, None].bool()
    following = {"observation": batch["next_observations"], "reward": batch["rewards"][:, None]}
    data = TensorDict(
        {
            "observation": batch["observations"],
            "action": batch["codes"],
            "next": {**following, "done": ends, "terminated": ends},
        },
        batch_size=[rows],
    )

    def update() -> None:
        losses = loss(data)
        optimiser.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimiser.step()
        updater.step()

    return update


def _d3rlpy(name: str, observations: Tensor, actions: Tensor, more: Batch | None = None, **settings: Any) -> Update:
    """One update of an algorithm of d3rlpy, without its sampling."""
    import d3rlpy
    from d3rlpy.models.encoders import VectorEncoderFactory
    from d3rlpy.torch_utility import TorchMiniBatch

    rows = len(observations)
    networks = {key: VectorEncoderFactory(WIDTHS) for key in settings.pop("networks")}
    algorithm = getattr(d3rlpy.algos, f"{name}Config")(batch_size=rows, **networks, **settings).create(device="cpu")
    algorithm.create_impl((observations.shape[1],), actions.shape[1])
    more = more or {}
    column = torch.zeros(rows, 1)
    ready = TorchMiniBatch(
        observations=observations,
        actions=actions,
        rewards=more.get("rewards", column).reshape(-1, 1),
        next_observations=more.get("next_observations", observations),
        next_actions=actions,
        returns_to_go=column,
        terminals=more.get("dones", column).reshape(-1, 1),
        intervals=torch.ones(rows, 1),
        device="cpu",
    )
    return lambda: algorithm.impl.update(ready, 1)


def d3rlpy_iql(batch: Batch, skills: int) -> Update:
    """d3rlpy's IQL, which acts by Gaussians: 8 numbers an action instead of codes."""
    observations, actions = batch["observations"], torch.rand(len(batch["codes"]), 8) * 2 - 1
    networks = ("actor_encoder_factory", "critic_encoder_factory", "value_encoder_factory")
    return _d3rlpy("IQL", observations, actions, batch, networks=networks)


def d3rlpy_bc(observations: Tensor, actions: Tensor) -> Update:
    """d3rlpy's behaviour cloning."""
    return _d3rlpy("BC", observations, actions, networks=("encoder_factory",))
