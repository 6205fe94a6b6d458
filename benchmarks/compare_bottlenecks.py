"""Discrete against continuous skills: same data, steps, sizes, seeds and measurements.

    python benchmarks/compare_bottlenecks.py [--task pointmaze-large-diverse] [--data local:DIR] [--skills 4]
        [--seeds 3] [--steps 2500] [--out runs/bottlenecks]

For each seed, trains a codebook of K skills and a Gaussian bottleneck with as many dimensions, groups the continuous
skills into K clusters, and measures both in the same way on the episodes that the training left out. Prints means over
seeds with standard deviations, and writes `models-K.csv` (one row per model), `table-K.csv` and `comparison-K.png` to
--out. Without --data, 200,000 steps are collected there first. A training takes about three minutes on one core;
finished trainings are reused, and an interrupted one is resumed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from dds_lightning.console.reports import table as text_table
from dds_lightning.interpret import plot_comparison, png_bytes, small_png
from dds_lightning.interpret.atlas.build import CONTINUOUS, DISCRETE
from dds_lightning.saving.run_directory import Done, RunDirectory
from dds_lightning.tasks import Task, get_task

DIM = 64
"""Dimension D of codes and of continuous skills."""
PRECISION = "bf16-mixed"
"""Precision of training: 1.5 times as fast as float32 on a processor with matrix units."""
STATES = 64
"""Number of states from which every code is replayed, and of segments in each code's round trip."""
MEASURES = (
    ("own_accuracy", "found again in own states, %", 100.0),
    ("own_control", "  the same, another code held, %", 100.0),
    ("accuracy", "recovered from any state, %", 100.0),
    ("chance", "  chance, %", 100.0),
    ("told_by_state", "told by the first state of a segment, %", 100.0),
    ("information_in_state", "bits between code and displacement, in a state", 1.0),
    ("information", "bits between code and displacement, over all", 1.0),
    ("most", "  possible", 1.0),
    ("decoded", "error of decoded actions under codes", 1.0),
    ("decoded_own", "  under each segment's own vector", 1.0),
)
"""Columns of `compare_recovery`, their names in the table, and a factor."""


def data_of(run: RunDirectory, task: Task, data: str | None) -> tuple[str, list[Done]]:
    """The given data, or newly collected data, as SOURCE:NAME."""
    if data is not None:
        return data, []

    def work(folder: Path, resuming: bool) -> dict[str, Any]:
        from datamodules.collect.collectors import collect

        return {"data": collect(task, 200_000, 0, folder, dataset_id=task.name, overwrite=True)}

    done = run.do("data", f"data: 200,000 steps of {task.name}", {"task": task.name}, [], work)
    return f"local:{done.outputs['data']}", [done]


def train(
    run: RunDirectory, name: str, task: Task, spec: str, reads: list[Done], settings: list[str], steps: int
) -> Path:
    """Train one model, unless that is already done; return its checkpoint."""
    from dds_lightning.training.stage_cli import command

    args = [*settings, f"--data.task={task.name}", f"--data.data={spec}", f"--model.skill_dim={DIM}"]
    args += [f"--trainer.max_steps={steps}", f"--trainer.precision={PRECISION}"]

    def work(folder: Path, resuming: bool) -> dict[str, Any]:
        folders = [f"--checkpoint.dirpath={folder}", f"--trainer.default_root_dir={folder}"]
        last = folder / "last.ckpt"
        resume = [f"--ckpt_path={last}"] if resuming and last.is_file() else []
        fit = ["fit", "--config", f"{task.family}/skill.yaml", *args, *folders, "--trainer.enable_model_summary=false"]
        return {"checkpoint": Path(command("skill", [*fit, *resume])().data["checkpoint"])}

    done = run.do(name, f"{name}: {steps:,} steps", {"words": sorted(args)}, reads, work)
    return done.outputs["checkpoint"]


def measure(task: Task, spec: str, seed: int, skills: int, checkpoints: dict[str, Path], console: Console) -> Any:
    """Measure both models of a seed on the episodes that neither was trained on; one row per model."""
    from datamodules import SegmentDataModule
    from dds_lightning.interpret.measure.comparison import compare_recovery
    from dds_lightning.skill import SkillModule

    models = [(name, SkillModule.load(path)) for name, path in checkpoints.items()]
    data = SegmentDataModule(task.name, spec, seed=seed)
    data.setup()
    held_out = data.trajectories.select(data.validation_episodes)
    table = compare_recovery(
        task, held_out, models, skills, STATES, seed, lambda name: console.print(f"measuring seed {seed}: {name}")
    )
    return table.assign(seed=seed)


def summary(models: pd.DataFrame) -> pd.DataFrame:
    """One row per measure, one column per kind: mean over seeds, and standard deviation if there are several."""
    rows = []
    for column, name, factor in MEASURES:
        row = {"measure": name}
        for model, part in models.groupby("model", sort=False):
            values = factor * part[column].dropna()
            spread = f" ± {values.std(ddof=1):.3g}" if len(values) > 1 else ""
            row[str(model)] = f"{values.mean():.3g}{spread}" if len(values) else "–"
        rows.append(row)
    return pd.DataFrame(rows)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="pointmaze-large-diverse")
    parser.add_argument("--data", help="SOURCE:NAME (default: collect data)")
    parser.add_argument("--skills", type=int, default=4, help="K")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--out", type=Path, default=Path("runs/bottlenecks"))
    arguments = parser.parse_args()
    task, console = get_task(arguments.task), Console(stderr=True)
    run = RunDirectory(arguments.out, console)
    spec, reads = data_of(run, task, arguments.data)
    parts = []
    for seed in range(arguments.seeds):
        seeds = [f"--seed_everything={seed}", f"--data.seed={seed}"]
        kinds = {
            DISCRETE: (f"vq{arguments.skills}", ["--model.bottleneck=vq", f"--model.num_skills={arguments.skills}"]),
            CONTINUOUS: ("gaussian", ["--model.bottleneck=gaussian"]),
        }
        checkpoints = {
            kind: train(run, f"{name}-seed{seed}", task, spec, reads, [*seeds, *settings], arguments.steps)
            for kind, (name, settings) in kinds.items()
        }
        parts.append(measure(task, spec, seed, arguments.skills, checkpoints, console))
    models = pd.concat(parts, ignore_index=True)
    table = summary(models)
    models.to_csv(arguments.out / f"models-{arguments.skills}.csv", index=False)
    table.to_csv(arguments.out / f"table-{arguments.skills}.csv", index=False)
    title = f"{task.name}: K = {arguments.skills}, D = {DIM}, {arguments.steps:,} steps, {arguments.seeds} seeds"
    Console().print(text_table(table, title))
    path = arguments.out / f"comparison-{arguments.skills}.png"
    path.write_bytes(small_png(png_bytes(plot_comparison(models))))
    print(path)


if __name__ == "__main__":
    main()
