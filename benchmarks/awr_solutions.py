"""AWR by regression against AWR in closed form, on the same critic: which policy results, and how well it does.

    python benchmarks/awr_solutions.py runs/antmaze-large-diverse --alphas 3 10 30 --episodes 20

Takes a finished `dds run`, keeps its skills, transitions and critic, and trains only the actor again: by regression
with weights exp(alpha A), clipped at 100 and at 1000, and, once for all alphas, as the policy of the data that the
closed form multiplies by exp(alpha A). Then all policies play the same episodes, greedy and sampled.
"""

from __future__ import annotations

import argparse
import copy
import math
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from datamodules.semi_mdp import Relabelled
from dds_lightning import DDSAgent, PolicyModule, SkillModule, losses
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.play import rollout
from dds_lightning.study.findings import Findings


def learn_actor(policy: PolicyModule, features: Tensor, codes: Tensor, weights: Tensor, steps: int) -> float:
    """Fit the policy's actor to codes (N,) at features (N, F) with weights (N,); return the mean of the last 100."""
    torch.manual_seed(0)
    for layer in policy.actor:
        if isinstance(layer, torch.nn.Linear):
            layer.reset_parameters()
    adam = torch.optim.Adam(policy.actor.parameters(), lr=1e-3)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    last = []
    for _ in range(steps):
        rows = torch.randint(len(codes), (512,))
        log_pi = policy.actor(features[rows]).log_softmax(dim=-1).gather(-1, codes[rows, None]).squeeze(-1)
        loss = losses.awr(log_pi, weights[rows] / weights.mean())
        adam.zero_grad()
        loss.backward()
        adam.step()
        cosine.step()
        last = [*last[-99:], loss.item()]
    return math.fsum(last) / len(last)


def solutions(policy: PolicyModule, table: Relabelled, alphas: list[float], steps: int) -> dict[str, PolicyModule]:
    """Policies on one critic, by name: for each alpha, regression with two clips and the closed form."""
    with torch.no_grad():
        features = torch.cat([policy.embed(part) for part in table.observations.split(20_000)])
        q = torch.cat([policy.q(part) for part in table.observations.split(20_000)])
        v = torch.cat([policy.v(part) for part in table.observations.split(20_000)])
    codes = table.codes.long()
    advantages = q.gather(-1, codes[:, None]).squeeze(-1) - v
    policies = {}
    data = copy.deepcopy(policy)
    data.hparams.awr = "closed_form"
    learn_actor(data, features, codes, torch.ones_like(advantages), steps)
    for alpha in alphas:
        for clip in (100.0, 1000.0):
            weights = losses.awr_weights(advantages, alpha, clip)
            regressed = copy.deepcopy(policy)
            regressed.hparams.awr = "regression"
            learn_actor(regressed, features, codes, weights, steps)
            share = 100 * losses.effective_sample_size(weights).item()
            policies[f"regression, alpha {alpha:g}, clip {clip:g} ({share:.0f} % of the samples count)"] = regressed
        exact = copy.deepcopy(data)
        exact.hparams.alpha = alpha
        policies[f"closed form, alpha {alpha:g}"] = exact
    return policies


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--alphas", type=float, nargs="+", default=[3.0, 10.0, 30.0])
    parser.add_argument("--steps", type=int, default=8000, help="training steps of each actor")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--out", type=Path, help="also write the table to this CSV file")
    arguments = parser.parse_args()
    files = sorted((arguments.run / "relabel").glob("*.safetensors"))
    if not files:
        parser.exit(2, f"{arguments.run} has no relabelled data: finish `dds run` there first\n")
    task = Findings.read(arguments.run).task
    skill = SkillModule.load(arguments.run / "skill/last.ckpt")
    policy = PolicyModule.load(arguments.run / "policy/last.ckpt")
    policies = solutions(policy, Relabelled.load(files[-1]), arguments.alphas, arguments.steps)
    contestants = [
        Contestant(f"{name}, {selection}", DDSAgent(skill, one, selection), arguments.episodes)
        for name, one in policies.items()
        for selection in ("greedy", "sample")
    ]
    summary: pd.DataFrame = rollout(task, contestants, seed=arguments.seed).summary()
    print(summary[["actor", "episodes", "score", "score_error", "length"]].round(1).to_string(index=False))
    if arguments.out:
        summary.to_csv(arguments.out, index=False)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(f"{error}") from error
