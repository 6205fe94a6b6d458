"""Skills learnt in PointMaze-Medium and reused in PointMaze-Large, against skills learnt there from scratch.

    python benchmarks/reuse_skills.py [--seeds 3] [--out runs/reuse_skills] [--threads 1] [--figures DIR] [--quick]

For each seed, on data collected for the purpose, skills are learnt in Medium; that cost is paid in advance. Large
follows in four ways that differ only in where the skills come from; the policy is always trained from scratch, because
the maze is new:

- nothing: 1,000 steps of skill training, as many as in Medium;
- nothing, in short: the same with 240 steps, as many as the fine-tuning gets;
- reused as they are: no step;
- reused, decoder fine-tuned: 240 steps; encoder and codebook stay the same to the bit.

The agent plays at intervals while the policy learns. Steps count skill training in Large and policy training; seconds
are processor seconds of the two trainings and the relabelling in between, without evaluations, so that a busy machine
gives the same numbers. An interrupted call continues when it is repeated.

Writes `skills-reused.csv` and `skills-reused.png` into --figures and prints a table.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pandas as pd
import torch
from lightning.pytorch.callbacks import Callback
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from datamodules import RelabeledDataModule, SegmentDataModule, collect_pointmaze
from dds_lightning import PolicyModule, SkillModule
from dds_lightning.callbacks import RolloutEvaluation
from dds_lightning.callbacks.rolling import RollingCheckpoint
from dds_lightning.training.stage_cli import quieten
from dds_lightning.training.trainer import trainer_settings

MEDIUM, LARGE = "pointmaze-medium-diverse", "pointmaze-large-diverse"
DATA_STEPS = {MEDIUM: 100_000, LARGE: 60_000}
SKILL = {
    "num_skills": 16, "skill_dim": 64, "hidden_dim": 128, "encoder_layers": 2, "encoder_heads": 4,
    "decoder_blocks": 3, "dropout": 0.0, "lr_schedule": "cosine", "warmup_steps": 50,
}  # fmt: skip
POLICY = {
    "hidden_dims": (128, 128), "fourier_features": 64, "fourier_scale": 2.0, "tau": 0.9, "alpha": 5.0,
    "target_ema": 0.01, "extraction": "joint", "lr": 2e-3, "lr_schedule": "cosine",
}  # fmt: skip


@dataclass(frozen=True)
class Way:
    """Where the skills in Large come from: steps of training there, trained parts of Medium's model, and a colour."""

    name: str
    steps: int
    trainable: str | None
    colour: str


WAYS = (
    Way("nothing", 1000, None, "#d0271a"),
    Way("nothing, in short", 240, None, "#d2764a"),
    Way("reused as they are", 0, "none", "#2779d2"),
    Way("reused, decoder fine-tuned", 240, "decoder", "#10a06f"),
)


class Curve(Callback):
    """The results of each validation, with the steps and the processor seconds of training steps so far."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []
        self.seconds = self.begun = 0.0

    def on_train_batch_start(self, *args: Any) -> None:
        """Start the clock."""
        self.begun = time.process_time()

    def on_train_batch_end(self, *args: Any) -> None:
        """Stop the clock."""
        self.seconds += time.process_time() - self.begun

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Record the results; `RolloutEvaluation` has played already."""
        logged = trainer.callback_metrics
        names = {"rmse": "val/reconstruction_rmse", "success": "rollout/success"}
        row = {name: float(logged[key]) for name, key in names.items() if key in logged}
        self.rows.append({"step": float(trainer.global_step), "seconds": self.seconds, **row})

    def state_dict(self) -> dict[str, Any]:
        """The curve so far, for a training that is resumed."""
        return {"rows": list(self.rows), "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        self.rows, self.seconds = list(state_dict["rows"]), state_dict["seconds"]


class Study:
    """The trainings of one seed, in one folder."""

    def __init__(self, out: Path, seed: int, quick: bool) -> None:
        self.root, self.seed, self.quick = out / f"seed{seed}", seed, quick

    def steps(self, steps: int) -> int:
        """That many steps, or a fiftieth of them in a quick run."""
        return max(steps // 50, 4) if self.quick and steps else steps

    def data(self, task: str) -> str:
        """Collect the data of a task, unless that is done; return SOURCE:NAME."""
        folder = self.root / "data" / task
        if not folder.is_dir():
            collect_pointmaze(task, self.steps(DATA_STEPS[task]), self.seed, folder.parent, 1, dataset_id=task)
        return f"local:{folder}"

    def fit(
        self, name: str, module: pl.LightningModule, data: pl.LightningDataModule, steps: int, *callbacks: Callback
    ) -> tuple[Path, pd.DataFrame]:
        """Train, resume or reuse a finished training; return its checkpoint and its curve."""
        folder, curve = self.root / name, Curve()
        last, table = folder / "last.ckpt", folder / "curve.csv"
        if not table.is_file():
            print(f"seed {self.seed}: {name}", flush=True)
            settings: dict[str, Any] = {
                "default_root_dir": str(folder), "max_steps": steps, "max_epochs": -1, "accelerator": "cpu",
                "devices": 1, "check_val_every_n_epoch": None, "num_sanity_val_steps": 0, "limit_val_batches": 8,
                "val_check_interval": max(steps // 8, 1), "logger": False,
                "enable_progress_bar": False, "enable_model_summary": False,
                "callbacks": [*callbacks, curve],
            }  # fmt: skip
            trainer = pl.Trainer(**trainer_settings(settings, [RollingCheckpoint(str(folder))]))
            if getattr(module, "init_from", None) and not last.is_file():
                trainer.validate(module, data, verbose=False)  # the skills as loaded, before the first step
            trainer.fit(module, data, ckpt_path=last if last.is_file() else None, weights_only=True)
            pd.DataFrame(curve.rows).to_csv(table, index=False)
        return last, pd.read_csv(table)

    def skills(self, name: str, task: str, steps: int, **settings: Any) -> tuple[Path, pd.DataFrame]:
        """Train a skill model on the data of a maze."""
        data = SegmentDataModule(task, self.data(task), batch_size=64, validation_fraction=0.1, seed=self.seed)
        pl.seed_everything(self.seed, verbose=False)
        model = SkillModule(4, 2, **{**SKILL, "lr": 5e-4, **settings})
        return self.fit(name, model, data, self.steps(steps))

    def policy(self, name: str, skill: Path) -> tuple[float, pd.DataFrame]:
        """Relabel Large and train a policy that plays as it learns; return the seconds of relabelling and the curve."""
        data = RelabeledDataModule(LARGE, self.data(LARGE), str(skill), cache=str(self.root / name), seed=self.seed)
        begun, marker = time.process_time(), self.root / name / "relabelling.txt"
        data.prepare_data()
        if not marker.is_file():
            marker.write_text(str(time.process_time() - begun))
        data.setup()
        pl.seed_everything(self.seed, verbose=False)
        policy = PolicyModule(4, SKILL["num_skills"], skill_hash=data.skill_hash, **POLICY)
        playing = RolloutEvaluation(LARGE, 4 if self.quick else 20, seed=self.seed + 1, workers=0)
        return float(marker.read_text()), self.fit(name, policy, data, self.steps(4000), playing)[1]

    def table(self) -> pd.DataFrame:
        """One row per measurement: way, stage, steps and seconds in Large so far, and the results."""
        medium, curve = self.skills("medium-skill", MEDIUM, 1000)
        tables = [curve.assign(way="Medium, paid before", stage="skill")]
        for way in WAYS:
            name, skill = way.name.replace(", ", "-").replace(" ", "-"), medium
            step = seconds = 0.0
            if way.steps:
                start = {"init_from": str(medium), "trainable": way.trainable, "lr": 3e-4} if way.trainable else {}
                skill, curve = self.skills(f"{name}-skill", LARGE, way.steps, **start)
                tables.append(curve.assign(way=way.name, stage="skill"))
                step, seconds = curve[["step", "seconds"]].iloc[-1]
            relabelling, curve = self.policy(f"{name}-policy", skill)
            begun = pd.DataFrame({"step": [0.0], "seconds": [0.0], "success": [0.0]})
            curve = pd.concat([begun, curve])
            curve["step"] += step
            curve["seconds"] += seconds + relabelling
            tables.append(curve.assign(way=way.name, stage="policy"))
        return pd.concat(tables).assign(seed=self.seed)


def plot(table: pd.DataFrame) -> Figure:
    """Plot success over steps and seconds, and the decoder's error over skill training: mean and range over seeds."""
    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    for way in WAYS:
        part = table[table["way"] == way.name]
        _band(panels[0], part[part["stage"] == "policy"], "step", "success", way)
        _band(panels[1], part[part["stage"] == "policy"], "seconds", "success", way)
        _band(panels[2], part[part["stage"] == "skill"], "step", "rmse", way)
    panels[0].set(xlabel="steps in Large, skills and policy", ylabel="success in Large, %")
    panels[1].set(xlabel="seconds of one core in Large")
    panels[2].set(xlabel="steps of skill training in Large", ylabel="error of decoded actions (RMSE)")
    for ax in panels:
        ax.spines[["top", "right"]].set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(WAYS), frameon=False, fontsize=8.5)
    return figure


def _band(ax: Axes, rows: pd.DataFrame, over: str, what: str, way: Way) -> None:
    if rows.empty:
        return
    groups = rows.groupby(rows.groupby("seed").cumcount())  # the same measurement of each seed
    x, y = groups[over].mean(), groups[what]
    ax.plot(x, y.mean(), color=way.colour, marker=".", linewidth=1.4, label=way.name)
    ax.fill_between(x, y.min(), y.max(), color=way.colour, alpha=0.15, linewidth=0)


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """One row per way: mean and standard deviation over seeds at the end, and when three quarters succeed."""
    rows = []
    for way in WAYS:
        part = table[(table["way"] == way.name) & (table["stage"] == "policy")]
        last = part.groupby("seed").last()
        arrived = part[part["success"] >= 75].groupby("seed").first().reindex(last.index)
        rows.append(
            {
                "skills in Large": way.name,
                "success at the end, %": f"{last['success'].mean():.0f} ± {last['success'].std():.0f}",
                "steps in all": f"{last['step'].mean():.0f}",
                "seconds in all": f"{last['seconds'].mean():.0f} ± {last['seconds'].std():.0f}",
                "seeds that reach 75 %": f"{arrived['step'].notna().sum()} of {len(last)}",
                "after steps": f"{arrived['step'].mean():.0f}",
                "after seconds": f"{arrived['seconds'].mean():.0f}",
            }
        )
    return pd.DataFrame(rows)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("runs/reuse_skills"))
    parser.add_argument("--figures", type=Path, help="default: --out")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a fiftieth of all steps, to check that it runs")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    quieten()
    figures = arguments.figures or arguments.out
    figures.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame()
    for seed in range(arguments.seeds):
        table = pd.concat([table, Study(arguments.out, seed, arguments.quick).table()])
        columns = ["seed", "way", "stage", "step", "seconds", "success", "rmse"]
        table[columns].round({"seconds": 1, "success": 1, "rmse": 4}).to_csv(figures / "skills-reused.csv", index=False)
        plot(table).savefig(figures / "skills-reused.png", dpi=110)
    print(summary(table).to_string(index=False))
    before = table[table["way"] == "Medium, paid before"].groupby("seed")["seconds"].max()
    print(f"paid before, in Medium: {before.mean():.0f} seconds of one core for the skills")


if __name__ == "__main__":
    main()
