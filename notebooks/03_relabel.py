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
# # 03 · Relabel: from steps to skills
#
# **What you will see:** a drive cut into segments and recoloured by skill, one row of the policy's training table
# checked by hand, what two ways of discounting make of a distant goal, what each code does and what follows it, how
# segments end, and two mistakes at the ends of recordings, one of which ruins everything.
#
# **Time:** about half a minute on two CPU cores. No network, no GPU, no graphics driver.
#
# Between learning skills (notebook 02) and learning when to use them (notebook 04) lies a step in which nothing is
# learnt: the data are rewritten in terms of skills. It looks like bookkeeping, but it decides what can be learnt at
# all.

# %%
# %matplotlib inline
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from datamodules import Trajectories, collect_pointmaze, load_trajectories
from datamodules.relabel import relabel
from dds_lightning import DDSAgent, get_task
from dds_lightning.interpret.draw.charts import plot_transitions
from dds_lightning.interpret.draw.drawing import draw_number, draw_starts, draw_walls, extent, zoom
from dds_lightning.interpret.draw.gif import CachedBackground, gif_bytes
from dds_lightning.interpret.draw.palette import NO_SKILL, skill_colour
from dds_lightning.interpret.measure.statistics import code_segments, transition_matrix

warnings.filterwarnings("ignore", message=".*are shorter than horizon.*")  # an episode or two of a few steps

# %% tags=["parameters"] quick={"DATA_STEPS": 10000}
CHECKPOINT = "../checkpoints/pointmaze-large"
DATA_STEPS = 60_000
GAMMA = 0.99
RUNS = Path("../runs/notebooks/03")  # what this notebook writes lies here

# %% [markdown]
# ## Skills and data
#
# The skills are those of the shipped agent, 16 codes for segments of ten steps. The data are drives between random
# places, as in notebook 01; every step carries the reward of *our* goal, and a drive that enters it ends there.

# %%
task = get_task("pointmaze-large-diverse")
skill = DDSAgent.load(CHECKPOINT).skill
HORIZON, SKILLS = skill.horizon, skill.num_skills
folder = collect_pointmaze(task, DATA_STEPS, seed=1, out=RUNS, workers=1, overwrite=True, progress=False)
data = load_trajectories(f"local:{folder}", task)
last = data.step_offsets[1:] - 1  # the last step of every episode
reached = data.terminations[last]
print(f"{data.num_steps:,} steps in {data.num_episodes} episodes: {reached.sum()} enter the goal, "
      f"{(~reached).sum()} are cut off by time")  # fmt: skip

# %% [markdown]
# ## Cut and name
#
# The encoder of notebook 02 maps a segment $\tau$ of ten states and actions to a point, and the nearest vector of the
# codebook gives the segment its code (equation 11): $k = \arg\min_j \lVert E(\tau) - z_j \rVert$. Here is the longest
# drive that enters the goal, first as a sequence of steps, then, segment by segment, as a sequence of skills.

# %%
segments = code_segments(skill, data)  # one every ten steps, so that they do not overlap
drive = int(np.argmax(np.where(reached, data.lengths, 0)))
path = data.episode(drive)["observations"][:, :2]
of_drive = segments.relabelled.episodes.numpy() == drive
names, lengths = segments.codes[of_drive], segments.lengths[of_drive]
cuts = np.concatenate([[0], np.cumsum(lengths)])  # steps at which a segment begins or ends


def recolouring() -> bytes:
    """The drive in grey, then one segment after the other in the colour of its code."""
    figure = Figure(figsize=(4.6, 3.7), dpi=80, layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    ax.set(xlabel=" ", ylabel="", xticks=[], yticks=[])
    ax.plot(*path.T, color=NO_SKILL, linewidth=1.2, zorder=1.5)
    draw_starts(ax, [path[0]], task.cell_size, size=12)
    trail = LineCollection([], linewidths=4, zorder=2, capstyle="butt")
    ax.add_collection(trail)
    (marks,) = ax.plot(
        [], [], "o", markersize=3.2, color="white", markeredgecolor="black", markeredgewidth=0.6, zorder=3
    )
    caption = figure.text(0.02, 0.015, "", fontsize=10, family="monospace")
    background = CachedBackground(figure, (trail, marks, caption))
    pictures = []
    for done in range(len(names) + 1):
        trail.set_segments([path[cuts[i] : cuts[i + 1] + 1] for i in range(done)])
        trail.set_color([skill_colour(int(code)) for code in names[:done]])
        marks.set_data(*path[cuts[: done + 1]].T)
        caption.set_text(f"{cuts[done]:3d} of {len(path) - 1} steps, {done:2d} skills")
        pictures.append(background.frame())
    return gif_bytes(pictures, fps=6)


clip = recolouring()
Image(data=clip, format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## One row of the table
#
# What remains of a segment is one row of a much shorter table (section 4.2): *in state $s_t$ skill $k$ was used, it
# earned $R$ and led to $s_{t+h}$*, with
#
# $$R = \sum_{i=1}^{h} \gamma^{\,i-1}\, r_{t+i-1}$$
#
# Such a process, in which one decision lasts several steps, is called a *semi-MDP*. Every step costs 0.1 here until the
# goal is entered, so a whole skill costs $0.1 \cdot (1 + \gamma + \dots + \gamma^9) = 0.956$. The end of our drive:

# %%
convention = {"reward_scale": task.reward_scale, "reward_shift": task.reward_shift}  # 0.1 * (r - 1)
table = relabel(data, skill, gamma=GAMMA, stride=HORIZON, **convention)
own = table.episodes == drive
pd.DataFrame(
    {
        "step": cuts[:-1], "x": table.observations[own, 0], "y": table.observations[own, 1],
        "skill k": table.codes[own], "steps h": lengths, "R": table.rewards[own],
        "x'": table.next_observations[own, 0], "y'": table.next_observations[own, 1], "goal": table.dones[own].bool(),
    }
).tail(6).round(3)  # fmt: skip

# %% [markdown]
# The last segment is shorter, because the goal ended it. Where a segment may begin is a choice: every ten steps
# (`stride=10`, as the paper says), or at every step (`stride=1`), which cuts the same drives in ten overlapping ways
# and gives the learner ten times as many rows. From here on, a segment begins at every step:

# %%
table = relabel(data, skill, gamma=GAMMA, **convention)
windows = data.windows(HORIZON, tail="terminated")  # where those segments are
learning_reward = task.reward_scale * (data.rewards + task.reward_shift)


def sum_of_rewards(windows) -> np.ndarray:
    """R of every segment, by the formula above."""
    total = np.zeros(len(windows))
    for i in range(HORIZON):
        inside = i < windows.lengths
        total[inside] += GAMMA**i * learning_reward[windows.starts[inside] + i]
    return total


difference = np.abs(sum_of_rewards(windows) - table.rewards.numpy()).max()
print(f"{len(table):,} transitions; our own sums of rewards differ from theirs by at most {difference:.0e}")

# %% [markdown]
# ## Two ways to discount
#
# How much does what comes *after* a skill count? The value of the next state is multiplied by a number, and there are
# two reasonable choices:
#
# * `per_skill`: by $\gamma$, once per decision. This is the paper's formula (equation 8).
# * `per_step`: by $\gamma^h$, once per step, as if there were no skills. Ten steps make $0.99^{10} = 0.904$.
#
# It looks like a detail, but it decides how far a learner can see. Left: the value of a state that is $n$ skills away
# from the goal. Right: how much better it is to be one skill nearer, which is all that a policy can go by.

# %%
away = np.arange(1, 81)  # skills to the goal
cost = table.rewards.min().item()  # of a skill that does not get there
figure = Figure(figsize=(9.5, 2.9), layout="constrained")
left, right = figure.subplots(1, 2)
for factor, name, colour in ((GAMMA, "per_skill, 0.99", "#2779d2"), (GAMMA**HORIZON, "per_step, 0.904", "#d0271a")):
    value = cost * (1 - factor**away) / (1 - factor)
    left.plot(away, value, color=colour, label=name)
    right.plot(away[1:], -np.diff(value), color=colour, label=name)
left.set(xlabel="skills to the goal", ylabel="V(s)")
right.set(xlabel="skills to the goal", ylabel="gained by one skill", yscale="log")
left.legend(frameon=False)
for ax in (left, right):
    ax.axvspan(35, 45, color="#d9dde3", zorder=0)
    ax.spines[["top", "right"]].set_visible(False)
right.text(40, 5e-4, "our start", ha="center")
figure

# %% [markdown]
# From our start the goal is 35 to 45 skills away. `per_step` leaves a difference of about 0.02 between a good skill and
# a bad one there, and a network that must learn values down to -10 easily errs by more. In this maze the paper's single
# $\gamma$ is what works.
#
# ## What the codes stand for
#
# One row per code: how much of the data it covers, what it earns, how far the body moves under it, and how often it
# enters the goal.

# %%
summary = table.summary()
summary.set_index("code").round(2)

# %% [markdown]
# Mean displacements `dx`, `dy` are near zero although the body moves a third of a metre: *where it goes* in a tenth of
# a second is determined by the velocity that it already has, and a code is used at every velocity. What a code stands
# for is a *push*, a change of velocity. The discs on the right are the codes, each at its mean push: they form a wheel
# with a hub of small corrections.

# %%
pushes = pd.DataFrame((table.next_observations - table.observations)[:, 2:4].numpy(), columns=["x", "y"])
mean_push = pushes.groupby(table.codes.numpy()).mean()
figure = Figure(figsize=(9.5, 3.9), layout="constrained")
left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
left.bar(summary["code"], 100 * summary["share"], color=[skill_colour(k) for k in range(SKILLS)])
left.axhline(100 / SKILLS, color="black", linewidth=0.8, linestyle="--")
left.set(xlabel="code", ylabel="% of the segments", xticks=range(SKILLS), title="how often each is used")
for code, push in mean_push.iterrows():
    right.plot([0, push["x"]], [0, push["y"]], color=skill_colour(code), linewidth=1.5, zorder=1)
    draw_number(right, push.to_numpy(), code, size=9)
right.set(xlabel="change of vx (m/s)", ylabel="change of vy (m/s)", aspect="equal", title="where each pushes")
right.margins(0.12)
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
figure

# %% [markdown]
# ## How long they last, and how they end
#
# Nearly all segments have ten steps. The few shorter ones end in the goal: a drive that enters it yields one segment
# each of 1, 2, ... 9 and 10 steps that contains the arrival (on the right: where they begin). One of the 23 drives has
# only five steps in all, so 225 rows enter the goal and not 230. They are fewer than one in a hundred, and they are the
# *only* rows that say that anything good ever happens.

# %%
figure = Figure(figsize=(9.5, 3.0), layout="constrained")
left, right = figure.subplots(1, 2, width_ratios=(1.6, 1.0))
counts = np.bincount(windows.lengths, minlength=HORIZON + 1)[1:]
bars = left.bar(range(1, HORIZON + 1), counts, color="#2779d2")
left.bar_label(bars, labels=[f"{count:,}" for count in counts], fontsize=9)
left.set(xlabel="steps h of a segment", ylabel="segments (logarithmic)", yscale="log", xticks=range(1, HORIZON + 1))
left.margins(y=0.15)
left.spines[["top", "right"]].set_visible(False)
draw_walls(right, task)
ending = table.dones.bool()
colours = [skill_colour(int(code)) for code in table.codes[ending]]
right.scatter(*table.observations[ending, :2].T, s=12, c=colours, zorder=3)
zoom(right, task, task.goal_xy(), 1.3)
right.set_title("segments that enter the goal")
figure

# %% [markdown]
# ## What follows what
#
# If skills are words, a drive is a sentence. Row: the code of a segment; column: the code of the next one, in per cent
# of the row. The diagonal is a push that continues, four times as often as by chance. A strong push is followed by a
# weaker one in the same direction (15 by 7, 12 by 2, 8 by 3), and hardly ever by its opposite (15 by 10, 12 by 8).

# %%
follows = transition_matrix(segments)
again = float(np.nansum(segments.share * np.diag(follows)))
print(f"the same skill again: {again:.0%} of the time; by chance it would be {np.square(segments.share).sum():.0%}")
plot_transitions(follows)

# %% [markdown]
# ## Two mistakes at the ends
#
# A recording ends for one of two reasons. It **terminates**: the goal is entered, nothing more can be earned, and the
# learner must not look beyond (`goal` above; $V$ of the next state counts nothing). Or it is **truncated**: the
# recording merely stopped, and nothing is known about the missing steps of the last segment, so that segment is left
# out. There are two easy ways to get this wrong:
#
# 1. **Whole segments only.** Short ones are inconvenient (arrays need one length), so drop them all.
# 2. **An end is an end.** Write `done = terminated or truncated`, as old environments and files do.
#
# To see the effect of each we need no network. Divide the maze into squares of half a metre, and let every square look
# up how things went from there: the expectile 0.9 (notebook 04 says why) of $R + \gamma V(s')$ over its segments, two
# hundred times in turn.

# %%
(WEST, EAST), (SOUTH, NORTH) = extent(task)
COLUMNS, ROWS = round(2 * (EAST - WEST)), round(2 * (NORTH - SOUTH))


def square_of(observations) -> np.ndarray:
    """Number of the square in which a body is."""
    column, row = np.floor(2 * (observations[:, :2] - (WEST, SOUTH))).astype(int).T
    return row * COLUMNS + column


def look_up_values(data: Trajectories, tail: str) -> np.ndarray:
    """V of each square, (ROWS, COLUMNS) with NaN where no segment begins."""
    windows = data.windows(HORIZON, tail=tail)
    here = square_of(data.observations[windows.observation_starts])
    there = square_of(data.observations[windows.observation_starts + windows.lengths])
    goes_on = 1 - data.terminations[windows.starts + windows.lengths - 1]
    earned, size = sum_of_rewards(windows), ROWS * COLUMNS
    values = np.zeros(size)
    for _ in range(200):
        target = earned + GAMMA * goes_on * values[there]
        weight = np.where(target > values[here], 0.9, 0.1)
        total = np.bincount(here, weight, size)
        values = np.bincount(here, weight * target, size) / np.where(total > 0, total, 1)
    return np.where(total > 0, values, np.nan).reshape(ROWS, COLUMNS)


ends_are_ends = replace(data, terminations=data.terminations | data.truncations)
maps = {
    "as it should be": look_up_values(data, "terminated"),
    "whole segments only": look_up_values(data, "full"),
    "an end is an end": look_up_values(ends_are_ends, "terminated"),
}
figure = Figure(figsize=(9.5, 2.6), layout="constrained")
for ax, (name, values) in zip(figure.subplots(1, 3), maps.items(), strict=True):
    draw_walls(ax, task)
    image = ax.imshow(values, origin="lower", extent=(WEST, EAST, SOUTH, NORTH), cmap="viridis", zorder=0.5)
    draw_starts(ax, [task.start_xy()], task.cell_size, size=9)
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="", title=name)
    figure.colorbar(image, ax=ax, shrink=0.75)
figure


# %%
def at(values, xy) -> float:
    """The value at a place in metres."""
    return float(values.flat[square_of(np.asarray([xy]))[0]])


right_values = maps["as it should be"]
report = []
for name, values in maps.items():
    both = np.isfinite(values) & np.isfinite(right_values)
    report.append(
        {
            "ends": name,
            "V at the start": at(values, task.start_xy()),
            "best V": np.nanmax(values),
            "agrees with the right one (correlation)": np.corrcoef(values[both], right_values[both])[0, 1],
        }
    )
report = pd.DataFrame(report).set_index("ends")
report.round(2)

# %% [markdown]
# *Whole segments only* loses nine of ten rows that enter the goal, and with them the last half metre: the best place in
# the maze now costs four skills. The path to it is still right, so in this maze the mistake is hard to notice. For a
# runner it is not: there a termination is a *fall*, and without those rows falling costs next to nothing.
#
# *An end is an end* is fatal. Every step costs 0.1, so wherever a recording happened to stop, the costs stopped, and
# such places look like goals. The learner is taught to go to the nearest one and wait for the recording to end.
#
# ## What you should see

# %% tags=["check"]
checks = pd.DataFrame(
    [
        ("transitions, % of the steps", 100 * len(table) / data.num_steps, 95, 100),
        ("R of ten steps that do not enter the goal", cost, -0.957, -0.955),
        ("difference of R from our own sums", difference, 0, 1e-5),
        ("codes in use", (summary["segments"] > 0).sum(), 14, 16),
        ("share of the commonest code, %", 100 * summary["share"].max(), 7, 25),
        ("segments shorter than ten steps, %", 100 * (windows.lengths < HORIZON).mean(), 0.1, 1.0),
        ("terminations for each drive that enters the goal", table.dones.sum().item() / reached.sum(), 8, 10),
        ("the same skill again, %", 100 * again, 15, 60),
        ("V at the start", report.loc["as it should be", "V at the start"], -42, -25),
        ("the same, an end is an end", report.loc["an end is an end", "V at the start"], -10, -1),
        ("its agreement with the right values", report.iloc[2, 2], -0.5, 0.5),
        ("size of the clip, kB", len(clip) / 1e3, 20, 600),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(3)

# %% [markdown]
# ## Exercises
#
# 1. Relabel with the skills that you learnt in notebook 02 (eight codes, a small model). Does a skill follow itself
#    more or less often? Which of the two tables would you rather learn from?
# 2. Let `look_up_values` discount with `GAMMA**HORIZON`. Find the square where two neighbours first differ by less than
#    0.05. How far is it from the start?
# 3. Replace the expectile 0.9 by 0.5 (the mean over all drives, wherever they were headed). Does the map still lead
#    from the start to the goal?
#
# <details>
# <summary>Answers</summary>
#
# 1. The codes of notebook 02 follow themselves more often, 38 % of the time against 29 %, but with eight codes chance
#    gives more, too: 2.5 times as often as by chance against 4.1 times. The table with sixteen codes is the better one
#    to learn from: its rows say more precisely what was done.
# 2. Going back from the goal along the shortest way, 6.5 m from the goal and 9.5 m from the start. With one $\gamma$
#    per skill no two neighbours on that way differ by less than 0.05.
# 3. It does: climbing from square to square still ends beside the goal. But V at the start is -83 instead of -33,
#    because most drives went elsewhere first, and its agreement with the right map falls to a correlation of 0.68.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds relabel checkpoints/pointmaze-large local:data/pointmaze-large-diverse-v0 \
#     --task pointmaze-large-diverse --out runs/relabelled.safetensors
# ```
#
# Next: [04 · IQL and AWR](04_iql_awr.ipynb).
