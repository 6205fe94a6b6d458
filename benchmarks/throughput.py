"""How fast are relabelling and evaluation, beside the plainest way and beside the simulator alone?

    python benchmarks/throughput.py [--agent checkpoints/antmaze-medium-diverse] [--segments 20000] [--steps 300]

Relabelling: segments a second of processor time on one thread, beside a float32 loop that encodes 128 segments at a
time. Evaluation: environment steps a second on the clock, on all cores, while the agent plays, beside the same
environments stepped with actions that are there already. Both in turn, in rounds; the best round counts.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from datamodules.relabel import relabel
from datamodules.trajectories import Trajectories
from dds_lightning.agent import DDSAgent
from dds_lightning.envs.pool import EnvPool
from dds_lightning.nn.precision import fastest_precision
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import Task, get_task

SLOTS = 50


def random_walks(skill: SkillModule, steps: int) -> Trajectories:
    """Episodes of 1,000 steps with numbers of the right widths."""
    rng = np.random.default_rng(0)
    mean, std = skill.normaliser.mean.numpy(), skill.normaliser.std.numpy()
    episodes = [
        {
            "observations": (mean + std * rng.standard_normal((1001, len(mean)))).astype(np.float32),
            "actions": rng.uniform(-1, 1, (1000, skill.hparams.action_dim)).astype(np.float32),
            "rewards": np.zeros(1000, np.float32),
            "terminations": np.zeros(1000, bool),
            "truncations": np.arange(1000) == 999,
        }
        for _ in range(-(-steps // 1000))
    ]
    return Trajectories.from_episodes("random", episodes, action_low=-1, action_high=1)


@torch.no_grad()
def plain_loop(data: Trajectories, skill: SkillModule) -> int:
    """Encode segment after segment, 128 at a time."""
    windows = data.windows(skill.horizon, 1, tail="terminated")
    for first in range(0, len(windows.starts), 128):
        rows = slice(first, first + 128)
        observations = [data.observations[at : at + skill.horizon] for at in windows.observation_starts[rows]]
        actions = [data.actions[at : at + skill.horizon] for at in windows.starts[rows]]
        skill.encode(torch.from_numpy(np.stack(observations)), torch.from_numpy(np.stack(actions)))
    return len(windows.starts)


def compare_relabelling(skill: SkillModule, segments: int, rounds: int) -> None:
    """Print segments a second of both."""
    data, best = random_walks(skill, segments), {"relabel": 0.0, "plain loop": 0.0}
    precision: Any = fastest_precision().precision
    ways: dict[str, Callable[[], int]] = {
        "relabel": lambda: len(relabel(data, skill, precision=precision).codes),
        "plain loop": lambda: plain_loop(data, skill),
    }
    for _ in range(rounds):
        for name, work in ways.items():
            began = time.process_time()
            count = work()
            best[name] = max(best[name], count / (time.process_time() - began))
    ratio = best["relabel"] / best["plain loop"]
    print(f"relabelling in {precision}: {best['relabel']:,.0f} segments/s, {ratio:.1f} times a loop's")


def steps_per_second(task: Task, agent: DDSAgent | None, steps: int) -> float:
    """Environment steps a second of a pool, with the agent or with actions that are there already."""
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (SLOTS, task.action_dim)).astype(np.float32)
    if agent is not None:
        agent.reset(SLOTS, seed=0)
    with EnvPool(task, SLOTS) as pool:
        seen = pool.start([[seed] for seed in range(SLOTS)])["observation"]
        began, played = time.perf_counter(), 0
        for _ in range(steps):
            rows = pool.alive
            if agent is not None:
                actions = agent.act(seen, rows=rows)
            seen = pool.step(actions[: len(rows)])["observation"][np.isin(rows, pool.alive)]
            played += len(rows)
        return played / (time.perf_counter() - began)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", default="checkpoints/antmaze-medium-diverse")
    parser.add_argument("--task", default="antmaze-medium-diverse")
    parser.add_argument("--segments", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    agent, task = DDSAgent.load(asked.agent), get_task(asked.task)
    compare_relabelling(agent.skill, asked.segments, asked.rounds)
    alone = acting = 0.0
    for _ in range(asked.rounds):
        alone = max(alone, steps_per_second(task, None, asked.steps))
        acting = max(acting, steps_per_second(task, agent, asked.steps))
    print(f"evaluation: {acting:,.0f} steps/s, {acting / alone:.0%} of the simulator's {alone:,.0f}")


if __name__ == "__main__":
    main()
