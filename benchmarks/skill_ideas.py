"""Held-out denoising loss that ideas for faster skill training reach in the same processor time.

    python benchmarks/skill_ideas.py walker2d-medium-expert d4rl:FILE [--minutes 2] [--seeds 0] [--ideas adam muon ...]

Trains the skill model of the task's preset once for each idea and seed, without Lightning, on one thread. What counts
is the thread's own time, so another program on the machine changes little. Every run takes averaged weights (decay
0.999), as the presets do, and is judged on the same held-out segments with the same noise at a quarter, half and all of
its time. Appends the rows to --out; those that are there are not measured again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor, nn

from datamodules.segments import SegmentDataModule
from dds_lightning.configs import find
from dds_lightning.nn.precision import fastest_precision
from dds_lightning.saving.untrusted import read_yaml
from dds_lightning.skill import START_BATCHES, SkillModule
from dds_lightning.tasks import get_task

Optimisers = Callable[[SkillModule, float], list[torch.optim.Optimizer]]


def adam(model: SkillModule, lr: float) -> list[torch.optim.Optimizer]:
    """What the presets use."""
    return [torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr, fused=True)]


def muon(model: SkillModule, lr: float) -> list[torch.optim.Optimizer]:
    """Muon for matrices of hidden layers, with steps as long as Adam's; Adam for the rest."""
    hidden = [
        p
        for name, p in model.named_parameters()
        if p.ndim == 2
        and not any(part in name for part in ("embedding", "positions", "bottleneck", "net.input", "output"))
    ]
    chosen = {id(p) for p in hidden}
    rest = [p for p in model.parameters() if p.requires_grad and id(p) not in chosen]
    return [
        torch.optim.Muon(hidden, lr, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"),
        torch.optim.Adam(rest, lr, fused=True),
    ]


def soap(model: SkillModule, lr: float) -> list[torch.optim.Optimizer]:
    """SOAP of the package pytorch-optimizer."""
    from pytorch_optimizer import SOAP  # type: ignore[import-not-found]

    return [SOAP([p for p in model.parameters() if p.requires_grad], lr, weight_decay=0.0, precondition_frequency=10)]


def schedule_free(model: SkillModule, lr: float) -> list[torch.optim.Optimizer]:
    """Schedule-free Adam of the package schedulefree; its own average takes the place of ours."""
    from schedulefree import AdamWScheduleFree  # type: ignore[import-not-found]

    optimiser = AdamWScheduleFree([p for p in model.parameters() if p.requires_grad], lr, warmup_steps=200)
    optimiser.train()
    return [optimiser]


@dataclass(frozen=True)
class Idea:
    """A way of training.

    Attributes:
        model: Settings of the module that differ from the preset.
        batch: Segments in a batch; None takes the preset's.
        optimisers: Makes them.
        steps: Steps of each segment that are denoised in an update; None takes all H.
        draws: Times that each of them is denoised, with noise of its own.
        frozen_after: Share of the time after which encoder and codebook stand still and only the decoder learns.
    """

    model: dict[str, Any] = field(default_factory=dict)
    batch: int | None = None
    optimisers: Optimisers = adam
    steps: int | None = None
    draws: int = 1
    frozen_after: float = 1.0


IDEAS = {
    "adam": Idea(),
    "ema codebook": Idea({"codebook_ema": 0.99}),
    "5 of 10 steps": Idea(steps=5),
    "5 of 10 steps, batch 96": Idea(steps=5, batch=96),
    "2 draws": Idea(draws=2),
    "batch 32": Idea(batch=32),
    "batch 128": Idea(batch=128),
    "batch 128, lr 7e-4": Idea({"lr": 7e-4}, batch=128),
    "lr 1e-3": Idea({"lr": 1e-3}),
    "width 96": Idea({"hidden_dim": 96, "encoder_heads": 3}),
    "width 192": Idea({"hidden_dim": 192, "encoder_heads": 6}),
    "1 encoder layer": Idea({"encoder_layers": 1}),
    "1 encoder layer, lr 1e-3": Idea({"encoder_layers": 1, "lr": 1e-3}),
    "1 encoder layer, lr 2e-3": Idea({"encoder_layers": 1, "lr": 2e-3}),
    "2 decoder blocks": Idea({"decoder_blocks": 2}),
    "decoder alone after half": Idea(frozen_after=0.5),
    "muon": Idea(optimisers=muon),
    "muon, lr 1e-3": Idea({"lr": 1e-3}, optimisers=muon),
    "soap": Idea(optimisers=soap),
    "soap, lr 1e-3": Idea({"lr": 1e-3}, optimisers=soap),
    "schedule-free": Idea(optimisers=schedule_free),
    "schedule-free, lr 2e-3": Idea({"lr": 2e-3}, optimisers=schedule_free),
}


def loss_of(model: SkillModule, batch: dict[str, Tensor], idea: Idea, frozen: bool) -> Tensor:
    """The loss of `SkillModule.loss`, with the idea's choice of steps and draws; unbiased for any of them."""
    observations, actions = batch["observations"], batch["actions"]
    horizon = actions.shape[1]
    if frozen:
        with torch.no_grad():
            skill = model.encode_segments(observations, actions)
    else:
        skill = model.encode_segments(observations, actions)
    if idea.steps is not None:
        chosen = torch.rand(actions.shape[:2]).argsort(dim=1)[:, : idea.steps]
        rows = torch.arange(len(actions))[:, None]
        observations, actions = observations[rows, chosen], actions[rows, chosen]
    taken = actions.shape[1]
    flat = (
        model.action_box.to_unit(actions).flatten(0, 1).repeat(idea.draws, 1),
        model.normaliser(observations).flatten(0, 1).repeat(idea.draws, 1),
        skill.vectors.repeat_interleave(taken, dim=0).repeat(idea.draws, 1),
    )
    total = model.decoder.loss(*flat).mean() * (horizon * actions.shape[-1])
    if not frozen:
        for term in skill.terms.values():
            total = total + term.weight * term.value
    return total


@torch.no_grad()
def held_out(model: SkillModule, batches: list[dict[str, Tensor]]) -> tuple[float, int]:
    """Denoising loss and codes used on fixed segments with fixed noise."""
    model.eval()
    total, codes = 0.0, set()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for batch in batches:
            _, terms, skill = model.loss(batch)
            total += float(terms["denoising"]) / len(batches)
            codes.update(skill.codes.tolist() if skill.codes is not None else ())
    model.train()
    return total, len(codes)


def train(name: str, task: str, data: str, seed: int, seconds: float, precision: str) -> list[dict[str, Any]]:
    """Train one idea and judge it at three moments."""
    idea = IDEAS[name]
    preset = read_yaml(find(f"{get_task(task).family}/skill.yaml"))
    settings = {**preset["model"], "lr_schedule": "constant", **idea.model}
    lr, warmup = settings["lr"], settings["warmup_steps"]
    torch.manual_seed(seed)
    segments = SegmentDataModule(
        task, data, preset["data"]["horizon"], batch_size=idea.batch or preset["data"]["batch_size"], seed=seed
    )
    segments.setup()
    model = SkillModule(segments.observation_dim, segments.action_dim, segments.horizon, **settings)
    units = segments.statistics()
    model.normaliser.fit(units["observation_mean"], units["observation_std"])
    model.action_box.fit(units["action_low"], units["action_high"])
    judged = [batch for batch, _ in zip(segments.val_dataloader(), range(40), strict=False)]
    loader = segments.train_dataloader()
    stream = iter(loader)
    model.bottleneck.start(lambda: model._encodings_of([next(stream) for _ in range(START_BATCHES)]))
    optimisers = idea.optimisers(model, lr)
    own_average = idea.optimisers is schedule_free
    weights = [p for p in model.parameters() if p.requires_grad]
    average = [p.detach().clone() for p in weights]
    rows: list[dict[str, Any]] = []
    spent, step, moments, frozen = 0.0, 0, [0.25, 0.5, 1.0], False
    while moments:
        started = time.thread_time()
        batch = next(stream, None)
        if batch is None:
            stream = iter(loader)
            batch = next(stream)
        frozen = frozen or spent > idea.frozen_after * seconds
        with torch.autocast("cpu", torch.bfloat16, enabled=precision != "32-true"):
            loss = loss_of(model, batch, idea, frozen)
        loss.backward()
        step += 1
        for optimiser in optimisers:
            if not own_average:
                for group in optimiser.param_groups:
                    group["lr"] = lr * min(1.0, step / max(warmup, 1))
            optimiser.step()
            optimiser.zero_grad()
        if step % 100 == 0 and spent < 0.7 * seconds and not frozen:
            model._batch = batch
            generator = torch.Generator().manual_seed(step)
            model.bottleneck.revive(
                lambda: model._encodings_of([model._batch]), model.hparams.restart_threshold, generator
            )
        if not own_average:
            keep = min(0.999, (1.0 + step) / (10.0 + step))
            torch._foreach_lerp_(average, [p.detach() for p in weights], 1.0 - keep)
        spent += time.thread_time() - started
        if spent >= moments[0] * seconds:
            moments.pop(0)
            learning = [p.detach().clone() for p in weights]
            if own_average:
                optimisers[0].eval()  # type: ignore[attr-defined]
            else:
                _copy(weights, average)
            loss_now, used = held_out(model, judged)
            if own_average:
                optimisers[0].train()  # type: ignore[attr-defined]
            else:
                _copy(weights, learning)
            rows.append(
                {"idea": name, "task": task, "seed": seed, "seconds": round(spent), "steps": step}
                | {"denoising": loss_now, "codes": used, "precision": precision}
            )
    return rows


@torch.no_grad()
def _copy(weights: list[nn.Parameter], values: list[Tensor]) -> None:
    for weight, value in zip(weights, values, strict=True):
        weight.copy_(value)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("data")
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--ideas", nargs="+", default=list(IDEAS), choices=list(IDEAS), metavar="IDEA")
    parser.add_argument("--out", type=Path, default=Path("skill_ideas.csv"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    precision = fastest_precision().precision
    done = pd.read_csv(arguments.out) if arguments.out.is_file() else pd.DataFrame(columns=["idea", "task", "seed"])
    for seed in arguments.seeds:
        for name in arguments.ideas:
            if ((done["idea"] == name) & (done["task"] == arguments.task) & (done["seed"] == seed)).any():
                continue
            rows = pd.DataFrame(train(name, arguments.task, arguments.data, seed, 60 * arguments.minutes, precision))
            rows.to_csv(arguments.out, mode="a", header=not arguments.out.is_file(), index=False)
            print(rows.to_string(index=False, header=False), flush=True)


if __name__ == "__main__":
    main()
