"""Draws the figures of shipped checkpoints again.

    python benchmarks/draw_figures.py [CHECKPOINT ...] [--data runs/figures/data] [--steps 100000]
        [--out notebooks/figures] [--episodes 5]

Runs `dds atlas` for each checkpoint folder (default: all in checkpoints/) and writes its pictures as small PNG files,
NAME-PICTURE.png, and its page as runs/figures/NAME.html. The data of a task are expected in the folder --data, under
the task's name for collected data. If they are missing, they are collected there, by the same recipe as the
checkpoint's data but with fewer steps.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

PAGES = Path("runs/figures")
KEPT = (
    *("starts-by-skill", "skills-by-start", "strobe", "rendered", "stitching", "values"),
    *("trip", "recovery", "effects", "transitions", "diversity", "where"),
)
"""Pictures that go to --out; the page shows all."""


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="*", type=Path, metavar="CHECKPOINT")
    parser.add_argument("--data", type=Path, default=PAGES / "data")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=Path("notebooks/figures"))
    parser.add_argument("--episodes", type=int, default=5)
    arguments = parser.parse_args()

    from datamodules.collect.collectors import collect
    from dds_lightning.cli import main as dds
    from dds_lightning.saving.published import load_published
    from dds_lightning.tasks import get_task

    for place in arguments.checkpoints or sorted(path.parent for path in Path("checkpoints").glob("*/config.yaml")):
        task = get_task(load_published(place).config["task"])
        data = arguments.data / task.data_ids.get("local", task.name)
        if not data.is_dir():
            data = collect(task, arguments.steps, out=arguments.data)
        name, folder = place.resolve().name, PAGES / place.resolve().name
        args = ["atlas", str(place), "--data", f"local:{data}", "--out", str(PAGES / f"{name}.html")]
        status = dds([*args, "--episodes", str(arguments.episodes), "--figures", str(folder)])
        if status:
            sys.exit(status)
        arguments.out.mkdir(parents=True, exist_ok=True)
        for picture in KEPT:
            if (folder / f"{name}-{picture}.png").is_file():
                shutil.copy(folder / f"{name}-{picture}.png", arguments.out)


if __name__ == "__main__":
    main()
