# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 10 · Explore with skills: online RL in a maze
#
# **What you will see:** how far chance gets in a maze, with skills and with raw actions; any environment turned into
# one whose action is a skill; SAC that learns online to reach a goal it learns about only by reaching it; and
# the same SAC with raw actions, side by side.
#
# **Time:** about five minutes on two CPU cores. No network, no GPU, no graphics driver.
#
# So far everything was learnt from recorded data. Here the agent acts, and learns from what happens. The reward is
# sparse: each step costs a little until the goal is entered. Whoever never comes near the goal learns nothing about it,
# so what counts first is *exploration* (section 5.3 of the paper).

# %%
# %matplotlib inline
import json
import shlex
import subprocess
import sys
import textwrap
import time
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from gymnasium.utils.env_checker import check_env
from IPython.display import Image, display
from matplotlib.figure import Figure

from dds_lightning import DDSAgent, SkillModule, get_task
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.interpret.draw.drawing import draw_walls
from dds_lightning.online.skill_env import SkillEnv
from dds_lightning.rollout import Contestant, rollout

warnings.filterwarnings("ignore", module="gymnasium")  # it finds the bounds of a maze's observations too wide

# %% tags=["parameters"] quick={"BUDGET": 400, "ENV_STEPS": 4200, "EPISODES": 1}
SKILLS = "../checkpoints/pointmaze-large"
BUDGET = 8_000  # environment steps of each wanderer
ENV_STEPS = 40_000  # environment steps of each training
EPISODES = 20
RUNS = Path("../runs/notebooks/10")  # what this notebook writes lies here

# %% [markdown]
# ## An environment whose action is a skill
#
# `SkillEnv` wraps a Gymnasium environment and a skill model. Its action is a code $k$; it plays the skill for $H$ steps
# (each action by five denoising steps, as in notebook 05) and returns once. The rewards of those steps are folded into
# one, $R = \sum_i \gamma^i r_i$, by the same function that relabels recorded data, and `info` says how many steps were
# really taken and by what the next state's value is discounted.

# %%
task = get_task("pointmaze-large-diverse")
skills = SkillModule.load(SKILLS)
env = SkillEnv(task.make_env(), skills, reward_shift=-1.0)
check_env(env, skip_render_check=True, skip_close_check=True)  # a Gymnasium environment like any other
observation, _ = env.reset(seed=0)
after, reward, terminated, truncated, info = env.step(3)
pd.Series(
    {
        "actions": str(env.action_space),
        "where it was": np.round(observation[:2], 2).tolist(),
        "where skill 3 led": np.round(after[:2], 2).tolist(),
        "reward of the skill": round(reward, 3),
        "steps taken": info["steps"],
        "discount of what follows": round(info["discount"], 3),
        "at the goal": info["success"],
    }
).to_frame("one step")

# %% [markdown]
# ## How far does chance get?
#
# Two wanderers have the same number of environment steps and start from the same cell. One draws a new action at every
# step, the other a new skill every ten. Neither has a goal.


# %%
def wander(env, steps, seed=0):
    """Act at random; returns the positions (n, 2), one row for each environment step."""
    rng, seen, taken = np.random.default_rng(seed), [], 0
    env.reset(seed=seed)
    while taken < steps:
        choice = rng.integers(env.action_space.n) if hasattr(env.action_space, "n") else rng.uniform(-1, 1, 2)
        choice = choice if np.isscalar(choice) else choice.astype(np.float32)
        _, _, terminated, truncated, info = env.step(choice)
        seen.append(info["positions"][: info["steps"]])
        taken += info["steps"]
        if terminated or truncated:
            env.reset()
    return np.concatenate(seen)


def cells(positions):
    """Cells of the maze in which they lie."""
    return {tuple(task.xy_to_cell(place)) for place in positions}


paths = {
    "raw actions": wander(SkillEnv(task.make_env()), BUDGET),
    "skills": wander(env, BUDGET),
}
share = len(cells(paths["skills"])) / len(cells(paths["raw actions"]))
figure = Figure(figsize=(9.5, 3.6), layout="constrained")
for ax, (name, path) in zip(figure.subplots(1, 2), paths.items(), strict=True):
    draw_walls(ax, task)
    ax.plot(*path.T, ".", color="#2779d2", markersize=1.5, alpha=0.4)
    ax.set_title(f"{name}: {len(cells(path))} of {len(task.free_cells())} cells", fontsize=10)
    ax.set_axis_off()
figure

# %% [markdown]
# Random pushes cancel each other, so the first one jitters around its start. A skill is ten pushes that belong
# together: it crosses a cell, and a row of random skills goes somewhere. That is all that skills have to do with
# exploration, and it is much.
#
# ## Learn online
#
# `dds online compare` trains one SAC over codes and the same SAC over raw actions: the same networks, the same
# replay, the same number of updates for each environment step. Over codes the expectations in SAC's losses are exact
# sums; over raw actions the policy is a squashed Gaussian. While it learns, the picture shows the latest episodes.


# %%
def curves():
    """Success of the latest 20 episodes, so far."""
    figure = Figure(figsize=(7, 2.6), layout="constrained")
    ax = figure.subplots()
    for name, colour in (("discrete skills", "#0072b2"), ("raw actions", "#d55e00")):
        logs = sorted((RUNS / "compare" / name.replace(" ", "-") / "0").glob("logs/version_*/metrics.csv"))
        curve = pd.read_csv(logs[-1]) if logs and logs[-1].stat().st_size else pd.DataFrame()
        if "online/success" in curve:
            curve = curve.dropna(subset="online/success")
            ax.plot(curve["online/env_steps"], curve["online/success"], color=colour, label=name)
    ax.set(xlim=(0, ENV_STEPS), ylim=(-3, 103), xlabel="environment steps", ylabel="success, latest episodes (%)")
    if ax.lines:
        ax.legend(frameon=False, loc="upper left")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def dds(line, draw, every=3.0):
    """Run a command; while it works, redraw a picture. Returns what it printed."""
    print(" \\\n    ".join(textwrap.wrap(f"$ dds {line}", 110, break_on_hyphens=False)))
    handle = display(draw(), display_id=True)
    with (RUNS / "terminal.txt").open("w") as file:
        words = [sys.executable, "-m", "dds_lightning", *shlex.split(line)]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=file, text=True)  # noqa: S603 - our own
        while process.poll() is None:
            time.sleep(every)
            handle.update(draw())
        printed, _ = process.communicate()
    if process.returncode:
        raise RuntimeError((RUNS / "terminal.txt").read_text()[-2000:])
    handle.update(draw())
    return printed


RUNS.mkdir(parents=True, exist_ok=True)
told = json.loads(
    dds(
        f"online compare {task.name} --skill {SKILLS} --seeds 1 --env_steps {ENV_STEPS} --episodes {EPISODES} "
        f"--out {RUNS / 'compare'} --json",
        curves,
    )
)
results = pd.DataFrame(told["table"])
results.round(1)

# %% [markdown]
# The table says how the trained agents do when they play by themselves, beside their latest episodes while learning.
# The command has also drawn where the trainings went:

# %%
Image(told["figure"])

# %% [markdown]
# For a long time nothing happens: every skill costs the same, whatever is done. But visited places become *worse* in
# the critics' eyes than places never seen, whose value is still near 0: the policy is drawn to where it has not been.
# That is what finds the goal. Then $Q$ learns backwards from it, one skill at a time, and a maze that takes 400 steps
# is only 40 decisions long. For raw actions it is 400, each worth next to nothing.
#
# This is one seed and a small budget. With 150,000 steps and three seeds the figures are in
# [online/README.md](../dds_lightning/online/README.md).
#
# ## The agent
#
# The result is an agent like any other: it plays, is published, exported and drawn by the same commands.

# %%
agent = DDSAgent.load(RUNS / "compare/discrete-skills/0-played/agent", seed=0)
played = rollout(task, [Contestant("SAC over skills", agent, 4)], seed=1, workers=1, record=True)
clip = write_clip(RUNS / "episode.gif", task, played.paths["SAC over skills", 0], title="SAC over skills")
display(Image(clip))
played.episodes[["episode", "success", "length"]]

# %% [markdown]
# ## What you should see

# %% tags=["check"]
rows = results.set_index("variant")
ways = rows["cells"]
checks = pd.DataFrame(
    [
        ("cells that random skills reach, for each that raw actions reach", share, 1.5, 10),
        ("success of SAC over skills, %", rows.loc["discrete skills", "success"], 80, 100),
        ("success of SAC over raw actions, %", rows.loc["raw actions", "success"], 0, 20),
        ("cells that SAC visits, over skills", ways["discrete skills"], 15, 46),
        ("cells that SAC visits, over raw actions", ways["raw actions"], 1, 25),
        ("steps to the goal (mean of those that arrive)", played.episodes["length"].mean(), 200, 500),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# From the top of the repository, three seeds and 150,000 environment steps (about an hour):
#
# ```bash
# dds online compare pointmaze-large-diverse --skill checkpoints/pointmaze-large --seeds 3 --out runs/online
# ```
#
# 1. CleanRL's discrete SAC aims at an entropy of $0.98 \log K$; here it is $0.3 \log K$. Train with
#    `--set '["--model.target_entropy=0.98"]'`. What does the agent do after it has found the goal?
# 2. Give it recorded data as well (`--data local:DIR` of notebook 04's data, relabelled on the fly). When does it find
#    the goal now?
# 3. Start from the policy of `dds policy fit` (`--policy`, with `--data`). What is left to learn online?
#
# <details><summary>Answers</summary>
#
# 1. An entropy of 0.98 log K is nearly that of a policy that draws codes at random, and the temperature rises until the
#    policy has it: it finds the goal, and can hardly decide to go there again.
# 2. Half of every batch comes from the recordings, some of which pass the goal: the critics know where it is before
#    the agent has been there.
# 3. Little, in this maze: the offline policy already arrives. What remains is to become faster, and to correct
#    what the critics believe about skills that the recordings never tried.
#
# </details>
#
# Next: [11 · Compare settings](11_compare_settings.ipynb).
