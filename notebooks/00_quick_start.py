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
# # 00 · Quick start: watch a trained agent
#
# **What you will see:** the shipped agent loaded in three lines, one of its episodes as a clip, its paths through the
# maze coloured by the skill in use, and its score over 20 episodes beside an agent that chooses skills at random.
#
# **Time:** less than half a minute on two CPU cores. No network, no GPU, no graphics driver.
#
# The task is **PointMaze-Large**: a ball is pushed with a force of two components through a maze, from the lower left
# to the upper right. The agent has never practised in the maze. It learnt from logged drives between random places,
# hardly any of which goes all the way, so it has to stitch pieces of them together.

# %%
# %matplotlib inline
from pathlib import Path

import pandas as pd
from IPython.display import Image

from dds_lightning import DDSAgent, get_task
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.interpret.draw.maze import choose_episodes, plot_trajectories
from dds_lightning.rollout import Contestant, rollout

# %% tags=["parameters"] quick={"EPISODES": 2}
CHECKPOINT = "../checkpoints/pointmaze-large"
EPISODES = 20
RUNS = Path("../runs/notebooks/00")  # what this notebook writes lies here

# %% [markdown]
# ## Load and act
#
# Three lines. The observation is position and velocity, `(x, y, vx, vy)`; the goal is not in it, because the task has
# one goal and the policy has learnt where that is.

# %%
task = get_task("pointmaze-large-diverse")
agent = DDSAgent.load(CHECKPOINT, seed=0)
observation, info = task.make_env().reset(seed=0)

print("observation:", observation.round(2))
print("action:     ", agent.act(observation).round(2), f"  by skill {agent.codes[0]} of {agent.num_skills}")

# %% [markdown]
# Inside `act` two networks take turns (section 4.4 of the paper):
#
# 1. Every $H = 10$ steps the **policy** chooses a skill, a number $k \sim \pi(k \mid s)$ out of $K = 16$.
# 2. At every step the **decoder**, a small diffusion model, draws the action $a \sim p(a \mid z_k, s)$, where $z_k$ is
#    the codebook's vector for skill $k$.
#
# So the policy makes few, large decisions, and the decoder fills in the movement. Here is the same loop by hand, for
# three decisions:

# %%
env = task.make_env()
observation, info = env.reset(seed=0)
agent.reset(num_envs=1, seed=0)
decisions = []
for step in range(30):
    action = agent.act(observation)
    if agent.decided[0]:
        decisions.append({"step": step, "skill": agent.codes[0], "x": observation[0], "y": observation[1]})
    observation, reward, terminated, truncated, info = env.step(action)
pd.DataFrame(decisions).round(2)

# %% [markdown]
# ## Let it play
#
# `rollout` plays many episodes side by side. Every contestant gets the same starts, so the comparison is fair.
# `agent.variant("random")` shares the networks but picks skills at random: the difference shows what the policy adds to
# the skills.

# %%
contestants = [
    Contestant("the agent", agent, EPISODES),
    Contestant("random skills", agent.variant("random"), EPISODES),
]
result = rollout(task, contestants, seed=1, workers=0, record=True)  # workers=0: all in this process
table = result.summary().set_index("actor")
table[["episodes", "success", "score", "length_success"]].rename(
    columns={"success": "success %", "length_success": "steps when successful"}
).round(1)

# %% [markdown]
# The normalised score is $100 \cdot (R - R_{min}) / (R_{max} - R_{min})$. Here the return is 1 for reaching the goal
# and 0 otherwise, so the score is the share of episodes that reach it. A failed episode ends after 800 steps.
#
# ## One episode as a clip
#
# The number on the ball is the skill in use. The clip is drawn by matplotlib, so it needs no graphics driver.

# %%
episode = choose_episodes(result, "the agent")[0]  # of median length
clip = write_clip(RUNS / "episode.gif", task, result.paths["the agent", episode], title="PointMaze-Large")
Image(data=clip.read_bytes(), format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## Its paths, coloured by skill
#
# Long stretches alternate between a few skills, and the set of skills changes at the corners. This is the *stitching*
# of figure 4 (d and h) in the paper.

# %%
plot_trajectories(task, result, "the agent")

# %% [markdown]
# Random skills from the same start. Each skill moves sensibly, but without a policy they cancel each other out:

# %%
plot_trajectories(task, result, "random skills", numbered=0)

# %% [markdown]
# ## What you should see
#
# The numbers below allow some tolerance: floating-point results differ a little from machine to machine, and 20
# episodes are few.

# %% tags=["check"]
measured = table.loc[["the agent", "random skills"], "success"]
checks = pd.DataFrame(
    [
        ("success of the agent, %", measured.iloc[0], 90, 100),
        ("success of random skills, %", measured.iloc[1], 0, 20),
        ("steps of its successful episodes", table.loc["the agent", "length_success"], 300, 500),
        ("size of the clip, kB", clip.stat().st_size / 1e3, 20, 1500),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(1)

# %% [markdown]
# ## Exercises
#
# 1. `agent.variant("greedy")` always takes the likeliest skill. Add it as a third contestant. Is it faster? Why can a
#    little chance be useful in a maze?
# 2. Load with `noise_scale=0.0`: the decoder then draws without noise. What happens to the paths?
# 3. `agent.variant("fixed", fixed_codes=[3])` plays one skill for ever. How far does it get, and which skill gets
#    farthest from the start?
#
# <details>
# <summary>Answers</summary>
#
# 1. A little: both reach the goal in 20 of 20 episodes, greedy after 363 steps on average, sampled after 376. But a
#    deterministic choice repeats itself as long as the state does: pressed against a wall it would press for ever, and
#    chance leads away from there (notebook 04 shows an agent that lacks it).
# 2. All 20 still arrive, after 376 steps on average. The decoder then gives the same force whenever state and skill are
#    the same; what is left of chance is the choice of the skill.
# 3. None reaches the goal. Skill 9, which does different things in different places, gets farthest: 4.9 m from the
#    start as the crow flies. Eight others come 2.5 to 2.8 m far, three 1.5 m, and skills 6, 7, 14 and 15 only 0.6 m.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds evaluate checkpoints/pointmaze-large --episodes 100
# ```
#
# Next: [01 · Environments and data](01_data.ipynb).
