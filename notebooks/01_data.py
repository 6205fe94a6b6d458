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
# # 01 · Environments and data
#
# **What you will see:** a maze and its physics, a look at the other environments (an ant that walks, a runner that
# falls, a kitchen), 20,000 steps of data collected on the spot, where those drives went, how they are cut into
# segments, and what happens to broken data: they are refused, with a sentence that says what is wrong and where.
#
# **Time:** less than half a minute on two CPU cores. No network, no GPU, no graphics driver.

# %%
# %matplotlib inline
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import Image
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from datamodules import DataError, Trajectories, check_dataset, collect_pointmaze, describe, load_trajectories
from datamodules.collect.antmaze import collect_antmaze
from dds_lightning import get_task
from dds_lightning.interpret.draw.drawing import draw_starts, draw_trail, draw_walls
from dds_lightning.interpret.draw.gif import CachedBackground, gif_bytes
from dds_lightning.interpret.draw.palette import WALL
from dds_lightning.interpret.draw.strobe import draw_objects
from dds_lightning.interpret.measure.body import body_frames
from dds_lightning.interpret.measure.replay import simulator
from dds_lightning.interpret.measure.states import body_states
from dds_lightning.tasks import task_table

# %% tags=["parameters"] quick={"STEPS": 3000, "ANT_STEPS": 30}
STEPS = 20_000
ANT_STEPS = 300  # half a minute of walking
HORIZON = 10
RUNS = Path("../runs/notebooks/01")  # what this notebook writes lies here

# %% [markdown]
# ## One environment
#
# A task is one row of a table: which environment, from where to where, how long. The ball has mass, so pushing changes
# its *velocity*; a push against a wall costs time and teaches nothing. The evaluation always starts at the star and
# ends in the circle.

# %%
task = get_task("pointmaze-large-diverse")
figure = Figure(figsize=(5.0, 3.9), layout="constrained")
ax = figure.add_subplot()
draw_walls(ax, task)
draw_starts(ax, [task.start_xy()], task.cell_size, size=16)
ax.set_title(f"{task.env_id}: at most {task.max_episode_steps} steps")
figure

# %% [markdown]
# Push to the right for half a second (50 steps of 0.01 s) and watch position and velocity:

# %%
env = task.make_env()
observation, info = env.reset(seed=0)
rows = []
for step in range(51):
    if step % 10 == 0:
        rows.append([step, *observation])
    observation, reward, terminated, truncated, info = env.step(np.array([0.2, 0.0], np.float32))
pd.DataFrame(rows, columns=["step", "x (m)", "y (m)", "vx (m/s)", "vy (m/s)"]).round(2)

# %% [markdown]
# ## The others
#
# The method is not limited to mazes. The table of tasks describes every environment in the same way: how many numbers
# an observation and an action have (O/A), how many steps an episode lasts, and what scores of 0 and 100 mean. Several
# tasks share an environment and differ in their data (`dds tasks` lists them all):

# %%
tasks = task_table()
environments = tasks.drop_duplicates("environment").set_index("environment")
environments.insert(0, "tasks", tasks["environment"].value_counts())
environments[["family", "tasks", "O/A", "steps", "episodes", "score range"]]

# %% [markdown]
# Three of them, drawn from the simulator's own model. The **ant** has four legs with two joints each and must learn to
# walk before it can learn where to go. It is shown every two seconds on its way through AntMaze-UMaze. The **hopper**
# has one leg. Here it gets random torques, and as soon as it leans too far the episode terminates, a fifth of a second
# after it began: a runner's data are full of such endings. The **kitchen** has an arm with seven joints and a hand, and
# four subtasks to do in any order.

# %%
ant_task, hopper, kitchen = get_task("antmaze-umaze-diverse"), get_task("hopper-medium"), get_task("kitchen-mixed")
ant_folder = collect_antmaze(ant_task, ANT_STEPS, 0, RUNS, workers=1, overwrite=True, progress=False)
walk = load_trajectories(f"local:{ant_folder}", ant_task, reward="recorded").episode(0)["observations"]
with simulator(ant_task) as env:
    ant = body_frames(env.unwrapped.model, body_states(ant_task, walk).qpos)
with simulator(hopper) as env:
    env.action_space.seed(0)
    fallen, places = False, [env.unwrapped.data.qpos.copy()]
    while not fallen:
        observation, reward, fallen, truncated, info = env.step(env.action_space.sample())
        places.append(env.unwrapped.data.qpos.copy())
    fall = body_frames(env.unwrapped.model, np.array(places))
with simulator(kitchen) as env:
    arm = body_frames(env.unwrapped.model, env.unwrapped.data.qpos[None])


def draw_limbs(ax, body, t, axes, **line) -> None:
    """The limbs of a body at one moment, seen along the third axis."""
    ax.add_collection(LineCollection(list(body.limbs[t][:, :, axes]), capstyle="round", **line))


figure = Figure(figsize=(9.5, 3.3), layout="constrained")
left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 0.8, 1.4))
draw_walls(left, ant_task)
left.plot(*ant.root[:101, :2].T, color="black", linewidth=0.8, zorder=2)
for t in range(0, min(len(ant), 101), 20):
    draw_limbs(left, ant, t, (0, 1), color="#2779d2", linewidth=2)
left.set(xlabel="x (m)", ylabel="y (m)")
middle.axhspan(-0.3, 0.0, color=WALL)
for t, colour in ((0, "#f0b7b2"), (len(fall) - 1, "#d0271a")):
    draw_limbs(middle, fall, t, (0, 2), color=colour, linewidth=7)
middle.set(xlim=(-0.8, 0.8), ylim=(-0.1, 1.5), aspect="equal", xlabel="x (m)", ylabel="z (m)")
draw_limbs(right, arm, 0, (0, 2), color="#10a06f", linewidth=6)
draw_objects(right, arm.objects[0][:, [0, 2]], arm.names)
right.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
right.margins(x=0.3, y=0.15)
titles = ("AntMaze, from above", f"Hopper, {len(fall) - 1} steps", "Kitchen, from behind the arm")
for ax, title in zip((left, middle, right), titles, strict=True):
    ax.set_title(title, fontsize=11)
figure

# %% [markdown]
# The same walk as a clip. Nothing in it is animated by hand: every limb is where the recorded observation puts it.

# %%
figure = Figure(figsize=(4.2, 4.2), dpi=80, layout="constrained")
ax = figure.add_subplot()
draw_walls(ax, ant_task)
limbs = LineCollection([], color="#2779d2", linewidth=3, capstyle="round", zorder=3)
ax.add_collection(limbs)
background = CachedBackground(figure, (limbs,))
pictures = []
for t in range(0, len(ant), 3):
    limbs.set_segments(list(ant.limbs[t][:, :, :2]))
    pictures.append(background.frame())
clip = gif_bytes(pictures, fps=10, colours=64)
Image(data=clip, format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## Collect
#
# Back to the ball. Offline learning needs drives recorded by somebody else. Here a planner finds a path through the
# cells and a controller follows it, always to **random goals**, never deliberately to ours. It is also deliberately
# noisy: it strays from the middle of the path, makes bursts of random pushes, and sometimes brakes and rests. Without
# walls, dead ends and rest in the data the learner would have to guess there, and it guesses too optimistically.

# %%
folder = collect_pointmaze(task, steps=STEPS, seed=0, out=RUNS, workers=1, overwrite=True, progress=False)
recorded = load_trajectories(f"local:{folder}", task, reward="recorded")
print(f"{recorded.num_steps:,} steps in {recorded.num_episodes} episodes, in the format of Minari: {folder.name}")

# %% [markdown]
# ## Look at them
#
# On the left six episodes, one colour each; on the right how often each place was visited. White means never.

# %%
figure = Figure(figsize=(9.5, 3.9), layout="constrained")
left, right = figure.subplots(1, 2)
for number in range(min(6, recorded.num_episodes)):
    positions = recorded.episode(number)["observations"][:, :2]
    draw_trail(left, positions, number, linewidth=1.2)
    draw_starts(left, [positions[0]], task.cell_size, size=9)
left.set_title("six drives to random goals")
x, y = recorded.observations[:, :2].T
right.hist2d(x, y, bins=(48, 36), range=((-6, 6), (-4.5, 4.5)), cmin=1, cmap="viridis", norm="log")
right.set_title("visits, dark to bright (logarithmic)")
for ax in (left, right):
    draw_walls(ax, task)
figure

# %% [markdown]
# ## The reward of our goal
#
# The drives had other goals, so their recorded rewards are of no use. `load_trajectories` gives every step the reward
# of *this* task: 1 on entering the goal circle, 0 elsewhere. The episode **terminates** there (there is nothing left to
# earn), and what follows becomes a separate episode. Where the recording merely stopped, we speak of a **truncation**:
# the episode would have gone on, and the learner may look beyond it. Confusing the two is a classic mistake. (Steps
# that stay in the circle after a success are left out.)

# %%
data = load_trajectories(f"local:{folder}", task)
facts, dimensions = describe(data, task=task, horizon=HORIZON)
before, _ = describe(recorded, horizon=HORIZON)
pd.DataFrame({"as recorded": before, "for our goal": facts}).drop("fingerprint").fillna("")

# %% [markdown]
# What the learner gets to see, column by column (observation 0 to 3 are $x, y, v_x, v_y$):

# %%
dimensions.round(2)

# %% [markdown]
# ## Segments
#
# Skills are learnt from segments $\tau = (s_1, a_1, \dots, s_H, a_H)$ of $H = 10$ steps. None crosses the end of an
# episode, so every step of an episode starts one except the last nine: an episode of $T$ steps has $T - 9$ segments,
# and the data above have 19,889 - 9 · 45 = 19,484. A tenth of a second is short: in this maze a skill is a push, not a
# route.

# %%
windows = data.windows(HORIZON)
first = windows.observation_starts
moved = np.linalg.norm(data.observations[first + HORIZON, :2] - data.observations[first, :2], axis=1)
speed = np.linalg.norm(data.observations[first, 2:], axis=1)
figure = Figure(figsize=(9.5, 2.6), layout="constrained")
left, right = figure.subplots(1, 2)
left.hist(moved, bins=40, color="#2779d2")
left.set(xlabel="distance covered in a segment (m)", ylabel="segments")
right.hist(speed, bins=40, color="#10a06f")
right.set(xlabel="speed at its start (m/s)")
for ax in (left, right):
    ax.spines[["top", "right"]].set_visible(False)
figure

# %% [markdown]
# ## What a refusal looks like
#
# File formats accept almost anything, and a learner trained on broken data fails late and silently. So everything is
# checked on the way in, and the error names the data set, episode, field and value. Six ways to go wrong:

# %%
good = data.episode(0)


def broken(field: str, change) -> Trajectories:
    """Our first episode with one field changed."""
    episode = {name: array.copy() for name, array in good.items()}
    episode[field] = change(episode[field])
    return Trajectories.from_episodes("my data", [episode])


def with_nan(observations):
    observations[42, 2] = np.nan
    return observations


def mislabelled() -> dict:
    """A copy of the data whose own description says that it comes from another maze."""
    copy = RUNS / "mislabelled"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    file = copy / "data" / "metadata.json"
    metadata = json.loads(file.read_text())
    metadata["env_spec"] = metadata["env_spec"].replace("PointMaze_Large-v3", "PointMaze_Medium-v3")
    file.write_text(json.dumps(metadata))
    return check_dataset(f"local:{copy}", task)


def damaged() -> dict:
    """A copy of the data cut off in the middle, as a full disk leaves it."""
    copy = RUNS / "damaged"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    file = copy / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return check_dataset(f"local:{copy}", task)


attempts = {
    "a value that is not a number": lambda: broken("observations", with_nan),
    "the last observation is missing": lambda: broken("observations", lambda o: o[:-1]),
    "actions in newtons, not in the box": lambda: broken("actions", lambda a: 100 * a),
    "an episode without an end": lambda: broken("truncations", lambda t: t & False),
    "the data of another maze": mislabelled,
    "a file cut off half-way": damaged,
}
refusals = {}
for mistake, attempt in attempts.items():
    try:
        attempt()
    except DataError as error:
        refusals[mistake] = str(error)
        print(f"{mistake}:\n    {error}\n")

# %% [markdown]
# ## What you should see

# %% tags=["check"]
checks = pd.DataFrame(
    [
        ("steps collected", recorded.num_steps, STEPS, STEPS),
        ("free cells visited", len(np.unique(task.xy_to_cell(data.observations[:, :2]), axis=0)), 44, 46),
        ("episodes that reach our goal", facts["episodes that reach the goal"], 3, 40),
        ("segments", len(windows), 0.95 * STEPS, STEPS),
        ("median distance in a segment, m", np.median(moved), 0.25, 0.45),
        ("refusals", len(refusals), 6, 6),
        ("how far the ant walked, m", np.linalg.norm(np.diff(ant.root[:, :2], axis=0), axis=1).sum(), 10, 120),
        ("steps to the hopper's fall", len(fall) - 1, 5, 100),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. Collect with `action_noise=0, burst_probability=0`. Which parts of the picture of visits become white, and what is
#    the share of segments that start at less than 0.2 m/s?
# 2. Collect `pointmaze-large-play` instead: its drives run between ten hand-picked cells. Plot them. How many reach our
#    goal now?
# 3. Bring your own: write two episodes as plain arrays and give them to `Trajectories.from_episodes`. Leave out
#    `terminations`; what does the error say?
#
# <details>
# <summary>Answers</summary>
#
# 1. The squares along the walls: 139 of them are visited instead of 190. Segments that start at less than 0.2 m/s
#    become rare, 0.2 % instead of 3.3 %, so a learner would know next to nothing about a ball at rest.
# 2. Five episodes reach our goal; with the diverse drives it is six. Neither steers to it deliberately.
# 3. "'terminations' is missing; expected observations, actions, rewards, terminations, truncations, found ...". Nothing
#    is guessed, because the arrays alone cannot say whether an end was an arrival or merely the end of the recording.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds data collect pointmaze-large-diverse --steps 200000 --out data
# dds data check data/pointmaze-large-diverse-v0 --task pointmaze-large-diverse
# ```
#
# Next: [02 · Learn skills](02_learn_skills.ipynb).
