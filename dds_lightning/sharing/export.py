"""An agent as one file that acts without this package: `dds export` (torch or ONNX).

```
 observations (B, O) ─┬─► normaliser ─► policy ─► codes where codes < 0      gumbel (B, K)
 codes (B,) ──────────┼───────────────────────────┴─► codes (B,)
 noise (N, B, A) ─────┴─► normaliser ─► codebook, decoder ─► actions (B, A)
```

The file is a function: its caller keeps the clock (code -1 every `horizon` steps, else the code that came
out) and draws the noise. `gumbel` of zeros takes the likeliest code; standard Gumbel noise samples from the policy.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import logging
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError, lacks_extra
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.untrusted import mapping, parse_json

Format = Literal["torch", "onnx"]
INPUTS = ("observations", "codes", "gumbel", "noise")
OUTPUTS = ("actions", "codes_in_use")
SUFFIXES = {"torch": ".pt2", "onnx": ".onnx"}
FACTS = "dds_lightning.json"
"""Name under which a file holds the facts of `describe`."""


class ActingGraph(nn.Module):
    """What an exported file computes; see the module's picture.

    Args:
        agent: With selection `sample`, `greedy` or `argmax_q`.

    Raises:
        UserError: The agent chooses its skills without a policy.
    """

    def __init__(self, agent: DDSAgent) -> None:
        super().__init__()
        if agent.policy is None or agent.selection not in ("sample", "greedy", "argmax_q"):
            raise UserError(
                f"selection is '{agent.selection}': an exported agent chooses by its policy; load it with "
                "selection sample, greedy or argmax_q"
            )
        if not agent.skill.discrete:
            raise UserError("the agent's choices are numbers, not codes: an exported file chooses among codes")
        self.skill, self.policy = agent.skill, agent.policy
        self.by_q, self.temperature = agent.selection == "argmax_q", agent.temperature
        self.noise_scale = agent.noise_scale
        self.eval()

    def forward(self, observations: Tensor, codes: Tensor, gumbel: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Act once.

        Args:
            observations: (B, O) float32, as the environment gives them.
            codes: (B,) int64 codes in use; -1 where a new one is due.
            gumbel: (B, K) float32, zeros or standard Gumbel noise.
            noise: (N, B, A) float32 standard normal; N is the decoder's `draws`.

        Returns:
            Actions (B, A) in the environment's units, and the codes (B,) in use.
        """
        if self.by_q:
            scores = self.policy.q(observations).masked_fill(~self.policy.support_mask, -torch.inf)
        else:
            scores = self.policy.logits(observations) / self.temperature
        codes = torch.where(codes < 0, (scores + gumbel).argmax(dim=-1), codes)
        return self.skill.decode_from(observations, codes, self.noise_scale * noise), codes


def describe(agent: DDSAgent, task: str | None = None) -> dict[str, Any]:
    """Return what a caller of an exported file needs to know; the file holds it as JSON."""
    graph = ActingGraph(agent)
    return {
        "task": task,
        "horizon": agent.horizon,
        "num_skills": agent.num_skills,
        "observation_dim": agent.observation_dim,
        "action_dim": agent.action_dim,
        "draws": agent.skill.draws,
        "noise_scale": graph.noise_scale,
        "selection": agent.selection,
        "temperature": agent.temperature,
    }


def export_agent(agent: DDSAgent, path: str | Path, format: Format = "onnx", *, task: str | None = None) -> Path:
    """Write an agent as one file, whole or not at all.

    Args:
        agent: As `DDSAgent.load` gives it.
        path: The file.
        format: `onnx`, or `torch` for `torch.export.load` (a program, no pickled classes).
        task: Name of the task to store in the file.

    Returns:
        The file.

    Raises:
        UserError: The agent chooses its skills without a policy, the format is unknown or not that of the file's name,
            or a package for it is missing.
    """
    if format not in SUFFIXES:
        raise UserError(f"format is '{format}', expected one of {', '.join(SUFFIXES)}")
    path = Path(path)
    if path.suffix != SUFFIXES[format]:
        raise UserError(f"--out is {path}, expected a name that ends in {SUFFIXES[format]} for the format {format}")
    if format == "onnx":
        _need("onnx", "onnxscript")
    graph, facts = ActingGraph(agent.cpu()), json.dumps(describe(agent, task))
    example = example_inputs(agent, 2)
    batch = torch.export.Dim("batch", min=1)
    shapes = ({0: batch}, {0: batch}, {0: batch}, {1: batch})
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as part, _quietly():
        if format == "torch":
            program = torch.export.export(graph, example, dynamic_shapes=shapes)
            torch.export.save(program, part, extra_files={FACTS: facts})
        else:
            exported = torch.onnx.export(
                graph,
                example,
                input_names=list(INPUTS),
                output_names=list(OUTPUTS),
                dynamic_shapes=shapes,
                dynamo=True,
                external_data=False,
            )
            assert exported is not None, "the dynamo exporter returns a program"
            exported.model.metadata_props[FACTS] = facts
            exported.save(part, external_data=False)
    return path


def example_inputs(agent: DDSAgent, batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return inputs of the right shapes: observations spread as the data's, every code due, random noise."""
    stream = torch.Generator().manual_seed(seed)
    units = agent.skill.normaliser  # far from the data, rounding errors grow with the distance
    return (
        units.mean + units.std * torch.randn(batch, agent.observation_dim, generator=stream),
        torch.full((batch,), -1),
        torch.zeros(batch, agent.num_skills),
        torch.randn(agent.skill.draws, batch, agent.action_dim, generator=stream),
    )


def load_exported(path: str | Path) -> tuple[Callable[..., tuple[NDArray[Any], ...]], dict[str, Any]]:
    """Open an exported file as a function of NumPy arrays, and its facts.

    Raises:
        UserError: There is no such file, it is damaged, or a package for it is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no file {path}: make one with `dds export`")
    try:
        return _load_onnx(path) if path.suffix == ".onnx" else _load_torch(path)
    except UserError:
        raise
    except Exception as error:  # neither format promises which errors a damaged file raises
        raise UserError(f"{path} is not an exported agent, or damaged: {str(error).splitlines()[0]}") from error


def _load_onnx(path: Path) -> tuple[Callable[..., Any], dict[str, Any]]:
    _need("onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # one observation is too little to share
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    facts = mapping(parse_json(session.get_modelmeta().custom_metadata_map[FACTS], path), path)

    def call(*arrays: NDArray[Any]) -> Any:
        return tuple(session.run(list(OUTPUTS), dict(zip(INPUTS, arrays, strict=True))))

    return call, facts


def _load_torch(path: Path) -> tuple[Callable[..., Any], dict[str, Any]]:
    extra = {FACTS: ""}
    with _quietly():
        module = torch.export.load(path, extra_files=extra).module()

    @torch.inference_mode()
    def call(*arrays: NDArray[Any]) -> Any:
        return tuple(output.numpy() for output in module(*map(torch.from_numpy, arrays)))

    return call, mapping(parse_json(extra[FACTS], path), path)


def latency(call: Callable[..., Any], arrays: tuple[NDArray[Any], ...], calls: int = 200) -> dict[str, float]:
    """Return milliseconds of one call, `median` and `p95`, after ten warm-up calls."""
    times = []
    for number in range(10 + calls):
        start = time.perf_counter()
        call(*arrays)
        if number >= 10:
            times.append(1e3 * (time.perf_counter() - start))
    times.sort()
    return {"median": statistics.median(times), "p95": times[int(0.95 * (len(times) - 1))]}


def check_exported(agent: DDSAgent, path: str | Path) -> dict[str, Any]:
    """Compare an exported file with its agent and time both for one observation.

    Returns:
        `difference` (largest, of actions for fixed noise, see below), `file_ms` and `agent_ms` (see `latency`).

    Raises:
        UserError: The file does not act like the agent: codes differ, or actions do by more than 1e-5 (by 1e-5 of half
            an action's range where that is larger).
    """
    call, _ = load_exported(path)
    graph = ActingGraph(agent)
    box = agent.skill.action_box
    half = (0.5 * (box.high - box.low)).clamp_min(1.0).numpy()  # (A,)
    difference = 0.0
    for batch in (1, 2, 16):
        inputs = example_inputs(agent, batch, seed=batch)
        with torch.inference_mode():
            actions, codes = (output.numpy() for output in graph(*inputs))
        answer = call(*(tensor.numpy() for tensor in inputs))
        if not np.array_equal(answer[1], codes):
            raise UserError(f"{path} chooses other codes than the agent: export it again")
        difference = max(difference, float((np.abs(answer[0] - actions) / half).max()))
    if difference > 1e-5:
        raise UserError(f"{path}: actions differ from the agent's by {difference:g}, expected at most 1e-5")
    arrays = tuple(tensor.numpy() for tensor in example_inputs(agent, 1))
    agent.reset(seed=0)
    return {
        "difference": difference,
        "file_ms": latency(call, arrays),
        "agent_ms": latency(lambda: agent.act(arrays[0][0]), ()),
    }


def _need(*packages: str) -> None:
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise lacks_extra(f"ONNX needs {' and '.join(missing)}", "export")


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Silence the exporters, which print notes for their developers."""
    noisy = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "torch.export", "onnx_ir")]
    levels = [logger.level for logger in noisy]
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for logger in noisy:
            logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for logger, level in zip(noisy, levels, strict=True):
                logger.setLevel(level)
