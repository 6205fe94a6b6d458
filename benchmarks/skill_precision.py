"""The cost of an optimiser step of the skill model in float32 and in bfloat16, on this machine's processor.

    python benchmarks/skill_precision.py [--hidden 192] [--batch 64] [--steps 10] [--rounds 3] [--threads 1]

Uses random segments with AntMaze's widths, alternates between the two precisions, and prints the median processor
milliseconds per step. Processors with AMX or native bfloat16 products gain; others emulate them and lose.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch

from dds_lightning.skill import SkillModule

OBSERVATIONS, ACTIONS, HORIZON = 29, 8, 10


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden", type=int, default=192)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    hidden = arguments.hidden
    model = SkillModule(
        observation_dim=OBSERVATIONS,
        action_dim=ACTIONS,
        horizon=HORIZON,
        hidden_dim=hidden,
        encoder_layers=2,
        encoder_heads=hidden // 32,
        decoder_blocks=3,
        dropout=0.0,
    )
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4, fused=True)
    batch = {
        "observations": torch.randn(arguments.batch, HORIZON, OBSERVATIONS),
        "actions": torch.rand(arguments.batch, HORIZON, ACTIONS) * 2 - 1,
        "lengths": torch.full((arguments.batch,), HORIZON),
    }

    def step(reduced: bool) -> float:
        started = time.process_time()
        with torch.autocast("cpu", torch.bfloat16, enabled=reduced):
            loss, _, _ = model.loss(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return 1000 * (time.process_time() - started)

    for _ in range(arguments.rounds):
        measured = {}
        for name, reduced in (("float32", False), ("bfloat16", True)):
            step(reduced)
            measured[name] = statistics.median(step(reduced) for _ in range(arguments.steps))
        ratio = measured["float32"] / measured["bfloat16"]
        print(f"float32 {measured['float32']:.1f} ms, bfloat16 {measured['bfloat16']:.1f} ms per step: {ratio:.2f} x")


if __name__ == "__main__":
    main()
