"""The actor of a trained behaviour policy in NumPy: a file of a few kilobytes that acts without torch.

Collectors run it in worker processes, where importing torch would cost a second and hundreds of megabytes in each.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_tensors
from dds_lightning.saving.files import expand, written_whole
from dds_lightning.saving.untrusted import mapping, parse_json

FORMAT = "1"
OBSERVATION_CLIP = 10.0
"""Normalised observations are clipped to +- this, in training and afterwards."""
ACTIVATIONS = ("tanh", "relu")
OUTPUTS = ("clip", "tanh")

Array = NDArray[np.float32]


@dataclass(frozen=True)
class MLPPolicy:
    """A Gaussian policy whose mean is a multilayer perceptron of the normalised observation.

    Attributes:
        weights: One (inputs, outputs) matrix per layer.
        biases: One (outputs,) vector per layer.
        mean: (O,), subtracted from observations.
        std: (O,), divides the difference; the quotient is clipped to +-10.
        log_std: (A,), logarithm of the standard deviation with which the policy explored when it was saved. The noise
            is added before `output`.
        activation: Activation between layers, "tanh" or "relu".
        output: How the last layer becomes an action in [-1, 1]: "clip" (PPO) or "tanh" (SAC).
        metadata: How it was trained: environment, algorithm, steps, score.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    mean: Array
    std: Array
    log_std: Array
    activation: str = "tanh"
    output: str = "clip"
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def act(
        self, observations: ArrayLike, rng: np.random.Generator | None = None, *, noise_scale: float = 1.0
    ) -> Array:
        """Compute actions for a batch.

        Args:
            observations: Array (..., O).
            rng: Samples from the policy as it explored in training; None takes its mean.
            noise_scale: Factor on the standard deviation of that exploration.

        Returns:
            (..., A) float32 in [-1, 1].
        """
        observations = np.asarray(observations, dtype=np.float32)
        x = np.clip((observations - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = x @ weight + bias
            x = np.tanh(x) if self.activation == "tanh" else np.maximum(x, 0.0)
        x = x @ self.weights[-1] + self.biases[-1]
        if rng is not None:
            x = x + noise_scale * np.exp(self.log_std) * rng.standard_normal(x.shape, dtype=np.float32)
        return np.clip(x, -1.0, 1.0) if self.output == "clip" else np.tanh(x)

    def save(self, path: str | Path) -> Path:
        """Write a safetensors file, with `metadata` as JSON in its header; returns the path."""
        from safetensors.numpy import save_file

        tensors = {"mean": self.mean, "std": self.std, "log_std": self.log_std}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            tensors |= {f"layers.{i}.weight": weight, f"layers.{i}.bias": bias}
        tensors = {key: np.ascontiguousarray(value, dtype=np.float32) for key, value in tensors.items()}
        header = {
            "format": FORMAT,
            "activation": self.activation,
            "output": self.output,
            "metadata": json.dumps(dict(self.metadata)),
        }
        with written_whole(Path(path)) as part:
            save_file(tensors, part, metadata=header)
            part.chmod(0o644)
        return Path(path)

    @classmethod
    def load(cls, path: str | Path) -> MLPPolicy:
        """Read what `save` wrote.

        Raises:
            DataError: The file is missing, damaged or not a behaviour policy.
        """
        path = expand(path)
        try:
            arrays, header = read_tensors(path, "numpy")
            metadata = mapping(parse_json(header.get("metadata", "{}"), path), path)
        except UserError as error:
            raise DataError(
                f"behaviour policy {path}: missing or damaged ({error}); train or fetch it again"
            ) from error
        layers = range(sum(key.endswith(".weight") for key in arrays))
        try:
            policy = cls(
                weights=tuple(arrays[f"layers.{i}.weight"] for i in layers),
                biases=tuple(arrays[f"layers.{i}.bias"] for i in layers),
                mean=arrays["mean"],
                std=arrays["std"],
                log_std=arrays["log_std"],
                activation=header["activation"],
                output=header["output"],
                metadata=metadata,
            )
        except KeyError as error:
            raise DataError(
                f"behaviour policy {path}: has no {error}, expected a file that MLPPolicy.save wrote; train it again"
            ) from error
        policy._check(header.get("format"), path)
        return policy

    def _check(self, version: str | None, path: Path) -> None:
        """Refuse shapes that do not fit together, and unknown settings."""
        if version != FORMAT or self.activation not in ACTIVATIONS or self.output not in OUTPUTS:
            raise DataError(
                f"behaviour policy {path}: format {version}, activation '{self.activation}', output '{self.output}', "
                f"expected format {FORMAT}, one of {ACTIVATIONS} and one of {OUTPUTS}; train it again"
            )
        arrays = (*self.weights, *self.biases, self.mean, self.std, self.log_std)
        if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in arrays) or (self.std <= 0).any():
            raise DataError(f"behaviour policy {path}: expected finite float32 numbers and std > 0; train it again")
        width: tuple[int, ...] = self.mean.shape
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if len(width) != 1 or weight.shape != (*width, *bias.shape):
                raise DataError(
                    f"behaviour policy {path}: got a layer of shape {weight.shape} after width {width}, expected "
                    "(inputs, outputs); train it again"
                )
            width = bias.shape
        if not self.weights or self.log_std.shape != width or self.std.shape != self.mean.shape:
            raise DataError(f"behaviour policy {path}: the widths of its arrays do not agree; train it again")
