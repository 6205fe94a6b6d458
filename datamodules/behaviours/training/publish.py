"""Publish a training: `python -m datamodules.behaviours.publish NAME [--run FOLDER] [--out checkpoints/behaviours]`.

Scores the snapshots, keeps a ladder from random to expert (for the Ant: the last policy), and writes the card, the
curve and SHA256SUMS. `publish ant --mazes 100` instead lets the shipped Ant walk to the goals of D4RL's mazes, 100
episodes each, and adds the table to its card; `ant-robotics` likewise.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from datamodules.behaviours.policy import MLPPolicy
from datamodules.behaviours.training.evaluation import RunnerScore, score_navigator, score_runner, score_walker
from datamodules.behaviours.training.recipes import RECIPES, Recipe, get_recipe
from dds_lightning.errors import UserError
from dds_lightning.saving.files import sha256, written_whole
from dds_lightning.saving.templates import render
from dds_lightning.tasks import get_task

NOISES = (0.0, 0.1, 0.2)
"""Standard deviations of action noise at which the Ant is scored."""
MAZES = "mazes-{}.csv"
"""Files beside the Ant's policies with their results in mazes, by physics."""


@dataclass(frozen=True)
class Rung:
    """One policy of a ladder: its file name, the policy, and its scores without and with exploration."""

    name: str
    policy: MLPPolicy
    score: RunnerScore
    sampled: RunnerScore


def snapshots(run: Path) -> list[MLPPolicy]:
    """All snapshots of a training, oldest first.

    Raises:
        UserError: There are no snapshots.
    """
    paths = sorted((run / "snapshots").glob("*.safetensors"))
    if not paths:
        raise UserError(f"run: {run} holds no snapshots; train first: python -m datamodules.behaviours.train")
    return [MLPPolicy.load(path) for path in paths]


def choose_rungs(scores: list[float], count: int) -> list[int]:
    """Choose at most `count` snapshots whose scores are spread evenly between the first and the best.

    Args:
        scores: Scores of all snapshots, oldest first.
        count: Number of rungs, including the first and the best.

    Returns:
        Indices with rising scores; the last one is the best.
    """
    best = int(np.argmax(scores))
    chosen = {0, best}
    for target in np.linspace(scores[0], scores[best], count)[1:-1]:
        chosen.add(int(np.argmin([abs(score - target) for score in scores[: best + 1]])))
    return sorted(chosen, key=lambda index: scores[index])


def ladder(recipe: Recipe, run: Path, *, rungs: int = 9, episodes: int = 20) -> list[Rung]:
    """Score a runner's snapshots and choose a ladder of them.

    All are scored on a few episodes, and the chosen ones again on different episodes, so that a snapshot that was
    lucky once does not stay lucky. The three best compete for the last rung.
    """
    policies = snapshots(run)
    first = [score_runner(policy, recipe.name, episodes=10, seed=1_000).score for policy in policies]
    for index in np.argsort(first)[-3:]:
        first[index] = score_runner(policies[index], recipe.name, episodes=episodes, seed=2_000).score
    scored = []
    for index in choose_rungs(first, rungs):
        score = score_runner(policies[index], recipe.name, episodes=episodes, seed=3_000)
        sampled = score_runner(policies[index], recipe.name, episodes=episodes, seed=4_000, sampled=True)
        facts = {**policies[index].metadata, "score": score.as_dict(), "score_sampled": sampled.as_dict()}
        scored.append(Rung("", replace(policies[index], metadata=facts), score, sampled))
    start, *others = scored
    others.sort(key=lambda rung: rung.score.score)
    names = ["000_random", *(f"{10 * rank:03d}" for rank in range(1, len(others))), "expert"]
    return [replace(rung, name=name) for rung, name in zip([start, *others], names, strict=True)]


def publish(recipe: Recipe, run: Path, out: Path, note: str = "") -> Path:
    """Write `out/<behaviour>`; the Ant's two physics share a folder.

    Args:
        recipe: What was trained.
        run: The training's folder.
        out: The parent folder.
        note: A further sentence for the card, for example where this training departed from the recipe.

    Returns:
        The folder.

    Raises:
        UserError: The training has no snapshots.
    """
    ant = recipe.world.startswith("ant:")
    folder = out / ("ant" if ant else recipe.name)
    folder.mkdir(parents=True, exist_ok=True)
    curve = pd.read_csv(run / "curve.csv")
    if ant:
        physics = recipe.world.removeprefix("ant:")
        policy = snapshots(run)[-1]
        scores = [score_walker(policy.act, physics, action_noise=noise) for noise in NOISES]
        facts = {**policy.metadata, "scores": [score.as_dict() for score in scores], "note": note}
        replace(policy, metadata=facts).save(folder / f"{physics}.safetensors")
        draw_curve(curve, "speed", "speed, with all noise (m/s)", folder / f"curve-{physics}.png")
        card = ant_card(folder)
    else:
        for path in folder.glob("*.safetensors"):
            path.unlink()
        built = ladder(recipe, run)
        for rung in built:
            rung.policy.save(folder / f"{rung.name}.safetensors")
        draw_curve(curve, "return", "return (with exploration)", folder / "curve.png")
        card = runner_card(recipe, built, note)
    return write_card(folder, card)


def write_card(folder: Path, text: str) -> Path:
    """Write README.md and then SHA256SUMS of all other files; returns the folder."""
    with written_whole(folder / "README.md") as part:
        part.write_text(text, encoding="utf-8")
    files = sorted(path for path in folder.iterdir() if path.name != "SHA256SUMS" and not path.name.startswith("."))
    with written_whole(folder / "SHA256SUMS") as part:
        part.write_text("".join(f"{sha256(path)}  {path.name}\n" for path in files), encoding="utf-8")
    return folder


def draw_curve(curve: pd.DataFrame, column: str, label: str, path: Path) -> None:
    """Draw a column of the curve as a small picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 2.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(curve["steps"] / 1e6, curve[column], color="#0072b2", linewidth=1.2)
    axes.set_xlabel("environment steps (millions)", fontsize=8)
    axes.set_ylabel(label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)
    with written_whole(path) as part:
        figure.savefig(part, dpi=90, format="png")


def ant_card(folder: Path) -> str:
    """The card of the Ant's controllers, from the metadata in their files and the tables of mazes that there are."""
    policies = {path.stem: MLPPolicy.load(path).metadata for path in sorted(folder.glob("*.safetensors"))}
    tables = {physics: folder / MAZES.format(physics) for physics in policies}
    walks = {physics: pd.read_csv(table) for physics, table in tables.items() if table.is_file()}
    return render("datamodules.behaviours.training", "ant_card.md.jinja", {"policies": policies, "walks": walks})


def publish_mazes(physics: str, episodes: int, out: Path) -> Path:
    """Let a shipped Ant controller walk through D4RL's mazes and add the table to its card.

    Args:
        physics: "d4rl" or "robotics".
        episodes: Number of episodes for each maze and noise.
        out: The parent of the folder `ant`.

    Returns:
        The folder.

    Raises:
        UserError: The folder has no controller for this physics.
    """
    folder = out / "ant"
    if not (folder / f"{physics}.safetensors").is_file():
        raise UserError(f"out: {folder} holds no controller for {physics} physics; publish one first, without --mazes")
    walks = score_navigator(physics, NOISES, episodes=episodes)
    with written_whole(folder / MAZES.format(physics)) as part:
        walks.to_csv(part, index=False)
    return write_card(folder, ant_card(folder))


def runner_card(recipe: Recipe, rungs: list[Rung], note: str) -> str:
    """The card of a runner's ladder."""
    values = {"name": recipe.name, "task": get_task(f"{recipe.name}-medium"), "rungs": rungs, "note": note}
    return render("datamodules.behaviours.training", "runner_card.md.jinja", values)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        "python -m datamodules.behaviours.publish",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("behaviour", choices=RECIPES)
    parser.add_argument("--run", type=Path, help="the training's folder (default: runs/behaviours/NAME)")
    parser.add_argument("--out", type=Path, default=Path("checkpoints/behaviours"))
    parser.add_argument("--note", default="", help="a further sentence for the card")
    parser.add_argument("--mazes", type=int, metavar="EPISODES", help="only play the shipped Ant in D4RL's mazes")
    arguments = parser.parse_args()
    recipe = get_recipe(arguments.behaviour)
    body, _, physics = recipe.world.partition(":")
    if arguments.mazes is not None and (arguments.mazes < 1 or body != "ant"):
        parser.error("--mazes is for the ant, and takes a number of episodes of at least 1")
    try:
        if arguments.mazes is not None:
            print(publish_mazes(physics, arguments.mazes, arguments.out))
            return
        print(publish(recipe, arguments.run or Path("runs/behaviours") / recipe.name, arguments.out, arguments.note))
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
