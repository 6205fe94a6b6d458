"""The behaviour policies in checkpoints/behaviours: whole, small, and as good as their cards say."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from datamodules.behaviours import AntController, load_ladder
from datamodules.behaviours.shipped import SHIPPED
from datamodules.behaviours.training.evaluation import RunnerScore
from datamodules.behaviours.training.publish import MAZES, NOISES, Rung, ant_card, publish_mazes, runner_card
from datamodules.behaviours.training.recipes import get_recipe
from dds_lightning.envs.antmaze import D4RLAntMazeEnv
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError


@pytest.mark.parametrize("folder", sorted(path.name for path in SHIPPED.glob("*") if path.is_dir()))
def test_shipped_files_are_whole_and_small(folder):
    lines = (SHIPPED / folder / "SHA256SUMS").read_text(encoding="utf-8").splitlines()
    sums = dict(reversed(line.split("  ")) for line in lines)
    files = {path.name: path for path in (SHIPPED / folder).iterdir() if path.name != "SHA256SUMS"}
    assert set(sums) == set(files)
    for name, path in files.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == sums[name], name
    assert sum(path.stat().st_size for path in files.values()) < (1.0e6 if folder == "ant" else 1.5e6)
    assert "README.md" in files


@pytest.mark.parametrize("behaviour", sorted(path.name for path in SHIPPED.glob("*") if path.name != "ant"))
def test_ladders_rise_from_random_to_expert(behaviour):
    policies = load_ladder(behaviour)
    names = list(policies)
    assert (names[0], names[-1]) == ("000_random", "expert")
    scores = [policy.metadata["score"]["score"] for policy in policies.values()]
    assert scores[0] < 10
    assert scores[-1] == max(scores)
    assert any(0.3 * scores[-1] < score < 0.55 * scores[-1] for score in scores)  # a medium


@pytest.mark.parametrize(("physics", "steps"), [("d4rl", 60), ("robotics", 120)])
def test_the_shipped_ant_walks_where_it_is_told(physics, steps):
    ant = D4RLAntMazeEnv(("0",), (0, 0), (0, 0)) if physics == "d4rl" else build_env("Ant-v4").unwrapped
    controller = AntController(physics)
    for heading in np.linspace(-np.pi, np.pi, 5)[:-1] + 0.4:
        ant.reset(seed=1, options={"noise": False})
        for _ in range(steps):
            observation = np.concatenate([ant.data.qpos, ant.data.qvel])
            action = controller.act(observation[None], [heading])[0]
            ant.step(action)
        way = ant.data.qpos[:2] @ [np.cos(heading), np.sin(heading)]
        assert way > 1.5 * 6.0, f"{way:.1f} m in 6 s at heading {heading:.2f}"


def test_the_cards_are_what_publishing_writes():
    assert ant_card(SHIPPED / "ant") == (SHIPPED / "ant" / "README.md").read_text(encoding="utf-8")
    rungs = [
        Rung(name, policy, *(RunnerScore(**policy.metadata[key]) for key in ("score", "score_sampled")))
        for name, policy in load_ladder("hopper").items()
    ]
    note = "Training was stopped after 778,272 of the recipe's 1,200,000 steps."
    assert runner_card(get_recipe("hopper"), rungs, note) == (SHIPPED / "hopper" / "README.md").read_text("utf-8")


def test_paths_are_the_repositorys():
    assert Path(__file__).resolve().parents[2] / "checkpoints" / "behaviours" == SHIPPED


@pytest.mark.parametrize("physics", ["d4rl", "robotics"])
def test_the_shipped_ant_walks_to_the_goals_of_mazes_and_its_card_tells(physics, tmp_path):
    shutil.copytree(SHIPPED / "ant", tmp_path / "ant")
    folder = publish_mazes(physics, 1, tmp_path)
    walks = pd.read_csv(folder / MAZES.format(physics))
    assert walks["maze"].tolist() == [maze for maze in ("umaze", "medium", "large") for _ in NOISES]
    assert walks["cap"].tolist() == [700] * 3 + [1000] * 6
    assert walks["reached"].sum() >= 7, walks
    median = walks.loc[0, "median_steps"]
    assert f"| umaze | 0 | 100 % | {median:.0f} | 700 |" in (folder / "README.md").read_text()
    assert MAZES.format(physics) in (folder / "SHA256SUMS").read_text()
    with pytest.raises(UserError, match="holds no controller"):
        publish_mazes(physics, 1, tmp_path / "elsewhere")
