"""stable-baselines3's PPO with the optimiser steps in NumPy.

A minibatch of 64 through two networks of 64 x 64 is so little arithmetic that torch spends its time between the
operations: 2.7 ms measured on one busy core, against 0.6 ms for the same arithmetic here. Rollouts, advantages and
normalisation stay the library's; the networks' memory is shared, so both see every change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from torch import nn

Array = NDArray[np.float32]
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-5


@dataclass(frozen=True)
class Minibatch:
    """Rows of a rollout: (B, O), (B, A), then (B,) each; advantages are normalised already."""

    observations: Array
    actions: Array
    log_probs: Array
    advantages: Array
    returns: Array


class NumpyActorCritic:
    """The parameters of a policy of two tanh networks, in one flat vector that torch and NumPy share.

    Args:
        policy: stable-baselines3's ActorCriticPolicy with equally wide `pi` and `vf` networks of tanh layers.
    """

    def __init__(self, policy: Any) -> None:
        actor = [m for m in policy.mlp_extractor.policy_net if isinstance(m, nn.Linear)] + [policy.action_net]
        critic = [m for m in policy.mlp_extractor.value_net if isinstance(m, nn.Linear)] + [policy.value_net]
        parameters = [policy.log_std, *(p for layer in actor + critic for p in (layer.weight, layer.bias))]
        flat = torch.cat([p.detach().reshape(-1) for p in parameters])
        grads = torch.zeros_like(flat)
        views, slopes, at = [], [], 0
        for parameter in parameters:
            end = at + parameter.numel()
            parameter.data = flat[at:end].view(parameter.shape)
            views.append(parameter.data.numpy())
            slopes.append(grads[at:end].view(parameter.shape).numpy())
            at = end
        self.flat, self.gradient = flat.numpy(), grads.numpy()
        self.log_std, self.log_std_gradient = views[0], slopes[0]
        count = 2 * len(actor)
        self.actor, self.actor_gradient = _pairs(views[1 : 1 + count]), _pairs(slopes[1 : 1 + count])
        self.critic, self.critic_gradient = _pairs(views[1 + count :]), _pairs(slopes[1 + count :])

    def compute_gradient(self, batch: Minibatch, clip: float, value_weight: float, entropy_weight: float = 0.0) -> None:
        """Fill `gradient` with that of PPO's loss.

        Clipped surrogate + value_weight x mean squared value error - entropy_weight x the Gaussian's entropy, which
        is the sum of `log_std` and a constant.
        """
        rows = len(batch.returns)
        hidden_pi, mean = _forward(self.actor, batch.observations)
        hidden_v, values = _forward(self.critic, batch.observations)
        inverse = np.exp(-self.log_std)
        z = (batch.actions - mean) * inverse
        constant = self.log_std.sum() + 0.5 * np.log(2 * np.pi) * len(self.log_std)
        ratio = np.exp(-0.5 * np.einsum("ba,ba->b", z, z) - constant - batch.log_probs)
        # where the clipped branch is the smaller one, it is flat
        gain = batch.advantages
        active = np.where(gain > 0, ratio < 1 + clip, ratio > 1 - clip)
        weight = np.where(active, -gain * ratio / rows, 0.0).astype(np.float32)[:, None]  # d loss / d log-probability
        self.log_std_gradient[:] = (weight * (z * z - 1.0)).sum(axis=0) - entropy_weight
        _backward(self.actor, self.actor_gradient, batch.observations, hidden_pi, weight * z * inverse)
        error = (2 * value_weight / rows) * (values - batch.returns[:, None])
        _backward(self.critic, self.critic_gradient, batch.observations, hidden_v, error)


class FastPPO(PPO):
    """PPO whose `train` runs in NumPy; for Gaussian policies of two tanh networks."""

    def _setup_model(self) -> None:
        super()._setup_model()
        self.numbers = NumpyActorCritic(self.policy)  # loading weights keeps the shared memory: it copies in place
        self.moments = np.zeros_like(self.numbers.flat), np.zeros_like(self.numbers.flat)
        self.adam_steps = 0

    def train(self) -> None:
        """`n_epochs` passes over the rollout in shuffled minibatches, Adam with clipped gradients."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        rate = self.policy.optimizer.param_groups[0]["lr"]
        clip_range: Any = self.clip_range  # a schedule, once the model is set up
        clip = clip_range(self._current_progress_remaining)
        numbers, (first, second) = self.numbers, self.moments
        rollout = next(self.rollout_buffer.get())  # all rows, already shuffled
        columns = [
            np.ascontiguousarray(column.numpy(), dtype=np.float32)
            for column in (
                rollout.observations,
                rollout.actions,
                rollout.old_log_prob,
                rollout.advantages,
                rollout.returns,
            )
        ]
        rows = len(columns[-1])
        for _ in range(self.n_epochs):
            order = np.random.permutation(rows)
            for at in range(0, rows, self.batch_size):
                chosen = order[at : at + self.batch_size]
                batch = Minibatch(*(column[chosen] for column in columns))
                advantages = batch.advantages
                advantages -= advantages.mean()
                advantages /= advantages.std(ddof=1) + 1e-8
                numbers.compute_gradient(batch, clip, self.vf_coef, self.ent_coef)
                gradient = numbers.gradient
                norm = float(np.sqrt(gradient @ gradient))
                if norm > self.max_grad_norm:
                    gradient *= self.max_grad_norm / norm
                self.adam_steps += 1
                first += (1 - BETA1) * (gradient - first)
                second += (1 - BETA2) * (gradient * gradient - second)
                size = rate * np.sqrt(1 - BETA2**self.adam_steps) / (1 - BETA1**self.adam_steps)
                numbers.flat -= size * first / (np.sqrt(second) + EPSILON)
        self._n_updates += self.n_epochs


def _pairs(arrays: list[Array]) -> list[tuple[Array, Array]]:
    return list(zip(arrays[0::2], arrays[1::2], strict=True))


def _forward(layers: list[tuple[Array, Array]], x: Array) -> tuple[list[Array], Array]:
    """Outputs of the hidden layers, and of the last."""
    hidden = []
    for weight, bias in layers[:-1]:
        x = x @ weight.T
        x += bias
        np.tanh(x, out=x)
        hidden.append(x)
    weight, bias = layers[-1]
    return hidden, x @ weight.T + bias


def _backward(
    layers: list[tuple[Array, Array]], slopes: list[tuple[Array, Array]], x: Array, hidden: list[Array], delta: Array
) -> None:
    """Write the gradients of all layers, given that of the last layer's output."""
    inputs = [x, *hidden]
    for i in range(len(layers) - 1, -1, -1):
        np.matmul(delta.T, inputs[i], out=slopes[i][0])
        delta.sum(axis=0, out=slopes[i][1])
        if i:
            delta = delta @ layers[i][0]
            delta *= 1.0 - inputs[i] * inputs[i]
