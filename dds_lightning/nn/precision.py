"""Which precision is faster here, by a short measurement: bfloat16 is 2 to 6 times as fast on some processors."""

import time
from typing import NamedTuple

import torch
from torch import nn

WIDTH, ROWS, REPEATS = 128, 640, 9
WORTH = 1.2
"""How much faster bfloat16 must be to be chosen."""


class Choice(NamedTuple):
    """A precision as `Trainer` takes it, and how much faster bfloat16 was than float32."""

    precision: str
    speedup: float


def fastest_precision(use_gpu: bool = False) -> Choice:
    """Time one feed-forward layer of a transformer in both precisions, forwards and backwards.

    The layer's size is that of the presets, whatever is trained, so that equal machines choose alike. The random
    streams stay untouched.

    Args:
        use_gpu: Whether the training runs on a CUDA device; there the device's support decides, without measuring.

    Returns:
        ``bf16-mixed`` or ``32-true``.
    """
    if use_gpu:
        return Choice("bf16-mixed", float("nan")) if torch.cuda.is_bf16_supported() else Choice("32-true", float("nan"))
    with torch.random.fork_rng(devices=[]):
        layer = nn.Sequential(nn.Linear(WIDTH, 4 * WIDTH), nn.ReLU(), nn.Linear(4 * WIDTH, WIDTH))
        x = torch.randn(ROWS, WIDTH)
    best = {True: float("inf"), False: float("inf")}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # with this thread's own time: other programs must not decide
    try:
        for _ in range(REPEATS):
            for lower in best:
                started = time.thread_time()
                with torch.autocast("cpu", torch.bfloat16, enabled=lower):
                    loss = layer(x).float().square().mean()
                loss.backward()
                best[lower] = min(best[lower], time.thread_time() - started)
    finally:
        torch.set_num_threads(threads)
    speedup = best[False] / best[True]
    return Choice("bf16-mixed" if speedup > WORTH else "32-true", speedup)
