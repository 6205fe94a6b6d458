"""The cost of collecting AntMaze data, compared with the simulator alone.

    python benchmarks/collect_antmaze.py [--task antmaze-medium-diverse] [--steps 16000] [--rounds 3]

Alternates, on one core and in one process, between the collector (planner, controller, noise, recording) and the same
environment driven by uniform random actions. Prints steps per processor second of both and their ratio for each round.
"""

from __future__ import annotations

import argparse
import time

import numpy as np


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="antmaze-medium-diverse")
    parser.add_argument("--steps", type=int, default=16_000)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()

    from datamodules.collect.antmaze import AntMazeRecipe, _Recorder
    from dds_lightning.tasks import get_task

    task = get_task(arguments.task)
    recorder = _Recorder(task, 0, arguments.steps, AntMazeRecipe())
    rng = np.random.default_rng(0)

    def collect() -> int:
        return sum(len(episode["actions"]) for number in range(recorder.rounds) for episode in recorder(number))

    def simulate() -> int:
        env = recorder.env()
        for start in range(0, arguments.steps, 1000):
            env.reset(seed=start)
            for action in rng.uniform(-1, 1, (1000, task.action_dim)).astype(np.float32):
                env.step(action)
        return arguments.steps

    rates: dict[str, list[float]] = {"collector": [], "simulator": []}
    for _ in range(arguments.rounds):
        for name, work in (("simulator", simulate), ("collector", collect)):
            started = time.process_time()
            steps = work()
            rates[name].append(steps / (time.process_time() - started))
        collector, simulator = rates["collector"][-1], rates["simulator"][-1]
        print(f"simulator {simulator:,.0f} steps/s, collector {collector:,.0f} steps/s: {collector / simulator:.0%}")


if __name__ == "__main__":
    main()
