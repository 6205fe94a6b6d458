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
# # 08 · Your own data: from arrays or files to a trained agent
#
# **What you will see:** a robot that this library does not know, its recordings as plain NumPy arrays, how the checks
# respond to the usual mistakes, the same data as files in D4RL's and Minari's layouts, an agent that learns from them,
# drives, is published and loaded again, and a check that detects actions that are one step off.
#
# **Time:** about two minutes on two CPU cores. No network, no GPU, no graphics driver.
#
# To use it for your own robot, replace the first two sections with your recordings. Everything else stays the same.

# %%
# %matplotlib inline
import logging
import os
import shlex
import shutil
import warnings
from pathlib import Path

import gymnasium as gym
import h5py
import lightning.pytorch as pl
import numpy as np
import pandas as pd
import torch
from IPython.display import Image, display
from matplotlib.figure import Figure

from datamodules import DataError, RelabeledDataModule, SegmentDataModule, Trajectories, describe, load_trajectories
from dds_lightning import DDSAgent, PolicyModule, SkillModule, get_task
from dds_lightning.baselines.behaviour_cloning import BehaviourCloning, CloneActor
from dds_lightning.cli import main
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.interpret.draw.dataset import plot_dataset
from dds_lightning.interpret.draw.drawing import draw_number, draw_starts, draw_trail, draw_walls
from dds_lightning.interpret.draw.maze import choose_episodes, plot_trajectories, plot_value_map
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.rollout import Contestant, rollout
from dds_lightning.study.tables import readable, summary_table
from dds_lightning.tasks import Task

# %% tags=["parameters"] quick={"DATA_STEPS": 3000, "SKILL_STEPS": 20, "POLICY_STEPS": 20, "EPISODES": 2}
DATA_STEPS = 50_000
SKILL_STEPS = 1_000
POLICY_STEPS = 4_000
EPISODES = 20
RUNS = Path("../runs/notebooks/08")  # what this notebook writes lies here

# %% [markdown]
# ## A robot
#
# Yours is real; ours has to be simulated. It is a **cart with two driven wheels** in two rooms with a door between
# them. It receives two motor voltages ten times a second and reports its position and heading. It cannot move sideways:
# to get round a corner it has to turn first.

# %%
ROOMS = (
    "1111111",
    "1001001",
    "1001001",
    "1000001",
    "1001001",
    "1111111",
)  # fmt: skip
RADIUS, VOLTS = 0.18, 6.0  # of the cart, m; most that the motors take


class Cart(gym.Env):
    """Observation: x, y (m), cosine and sine of the heading."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gym.spaces.Box(-VOLTS, VOLTS, (2,), np.float32)  # left and right motor

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        here = [*(cart.start_xy() + self.np_random.uniform(-0.2, 0.2, 2)), self.np_random.uniform(-np.pi, np.pi)]
        self.x, self.y, self.heading = (options or {}).get("pose", here)
        self.speed = self.turning = 0.0
        return self.observe()

    def step(self, action):
        left, right = np.clip(action, -VOLTS, VOLTS).tolist()
        self.speed += 0.7 * ((left + right) / 12 - self.speed)  # m/s; the motors need a tenth of a second
        self.turning += 0.7 * ((right - left) / 4 - self.turning)  # rad/s
        self.heading += 0.1 * self.turning
        dx, dy = 0.1 * self.speed * np.cos(self.heading), 0.1 * self.speed * np.sin(self.heading)
        self.x += dx if free(self.x + dx, self.y) else 0.0  # along a wall it scrapes
        self.y += dy if free(self.x, self.y + dy) else 0.0
        observation, info = self.observe()
        return observation, float(info["success"]), info["success"], False, info

    def observe(self):
        pose = [self.x, self.y, np.cos(self.heading), np.sin(self.heading)]
        position = np.array([self.x, self.y])
        docked = bool(np.linalg.norm(position - cart.goal_xy()) <= cart.goal_radius)
        return np.array(pose, np.float32), {"success": docked, "position": position}


def free(x, y):
    """Whether the cart fits there."""
    corners = [(x + a, y + b) for a in (-RADIUS, RADIUS) for b in (-RADIUS, RADIUS)]
    return all(ROOMS[int(3 - v)][int(u + 3.5)] == "0" for u, v in corners)


# %% [markdown]
# ### Describe the robot to the library: one `Task`
#
# Learning needs only arrays. To *evaluate*, the library must know which environment to run, where it starts and ends,
# and how returns become scores: that is a `Task`. The rooms are optional; with them every maze figure works for your
# robot too. All that a `Task` needs is an environment that is registered with Gymnasium and whose `info` contains
# `success` (and, for the figures, `position`).

# %%
if "Cart-v0" not in gym.registry:
    gym.register("Cart-v0", entry_point=Cart)
cart = Task(
    name="cart",
    family="cart",
    env_id="Cart-v0",
    observation_dim=4,
    action_dim=2,
    action_low=-VOLTS,
    action_high=VOLTS,
    max_episode_steps=300,
    step_seconds=0.1,
    maze_map=ROOMS,
    start_cell=(1, 1),
    goal_cell=(1, 5),
    goal_radius=0.5,
    score_min=0.0,  # the return that scores 0 ...
    score_max=1.0,  # ... and 100: the reward is 1 for reaching the charging dock
)

# %% [markdown]
# ## Your recordings
#
# Somebody drives it around with a joystick, from anywhere to anywhere, without the charging dock in mind. (Here a
# controller steers to random places, with noise; now and then it lets go of the stick or plays around.) Everything the
# cart reports is recorded. One episode is five arrays; note the **one extra** observation, the state after the last
# step.


# %%
def anywhere(rng):
    """A random pose, in one of the rooms."""
    side = rng.choice([-1, 1])
    return side * rng.uniform(0.7, 2.3), rng.uniform(-1.8, 1.8), rng.uniform(-np.pi, np.pi)


def steer(observation, target):
    """Voltages towards a place: turn to it, then drive."""
    x, y, cosine, sine = observation
    away = np.arctan2(target[1] - y, target[0] - x) - np.arctan2(sine, cosine)
    away = np.arctan2(np.sin(away), np.cos(away))
    drive, turn = 5.0 * max(np.cos(away), 0.0), 4.0 * away
    return np.clip([drive - turn, drive + turn], -VOLTS, VOLTS)


def record(steps, seed):
    """Episodes of somebody who drives about, at least `steps` in all."""
    rng, env, episodes = np.random.default_rng(seed), Cart(), []
    while steps > 0:
        observation, _ = env.reset(options={"pose": anywhere(rng)})
        seen, taken, rewards, route, whim, left = [observation], [], [], [], np.zeros(2), 0
        length, docked = int(rng.integers(150, 300)), False
        while len(rewards) < length and not docked:
            if not route:  # the next place, through the door if it is in the other room
                place = anywhere(rng)[:2]
                side = np.sign(observation[0])
                route = [place] if side * place[0] > 0 else [(0.8 * side, -0.5), (-0.8 * side, -0.5), place]
            if left == 0 and rng.random() < 0.015:
                left, whim = int(rng.integers(5, 20)), rng.uniform(-VOLTS, VOLTS, 2) * (rng.random() < 0.6)
            left = max(left - 1, 0)
            volts = whim if left else steer(observation, route[0])
            taken.append(np.clip(volts + rng.normal(0, 1, 2), -VOLTS, VOLTS))
            observation, reward, docked, _, _ = env.step(taken[-1])
            seen.append(observation)
            rewards.append(reward)
            if np.linalg.norm(observation[:2] - route[0]) < 0.3:
                route.pop(0)
        if len(rewards) < 10:  # it began beside the dock: too short for a skill, which takes ten steps
            continue
        last = np.arange(len(rewards)) == len(rewards) - 1
        episodes.append(
            {
                "observations": np.stack(seen),
                "actions": np.stack(taken),
                "rewards": np.array(rewards),
                "terminations": last & docked,  # True on the last step if the task ended there
                "truncations": last & (not docked),  # True on the last step if only the recording ended there
            }
        )
        steps -= len(rewards)
    return episodes


RUNS.mkdir(parents=True, exist_ok=True)
episodes = record(DATA_STEPS, seed=0)
print({name: array.shape for name, array in episodes[0].items()})

# %% [markdown]
# Where the *task* ends there is nothing left to earn, and the learner must not look beyond: a **termination**. Where
# only the *recording* ends, the episode would have gone on: a **truncation**. Nothing else in the arrays matters as
# much.
#
# `from_episodes` checks everything and concatenates the episodes. Actions are in your robot's units; the box gives
# their limits, which the agent will never exceed.

# %%
data = Trajectories.from_episodes("cart", episodes, action_low=-VOLTS, action_high=VOLTS)
facts, dimensions = describe(data, task=cart, horizon=10)
pd.Series(facts).drop("fingerprint").to_frame("cart")

# %%
plot_dataset(data, cart)

# %% [markdown]
# Look at such a picture before you train anything. Was every place visited (white: never)? Do the actions fill the box,
# or is something clipped? Do some episodes end in the dock? If none does, nothing can be learnt about it.
#
# ## What is refused
#
# A learner that is trained on broken data fails late and silently, so the checks are strict, and each error names the
# episode, field and value. The usual mistakes, made with our own arrays:

# %%
good = {name: array.copy() for name, array in episodes[0].items()}


def attempt(**changed):
    """Our first two episodes, the second one with other arrays; None leaves one out."""
    second = {name: array for name, array in {**episodes[1], **changed}.items() if array is not None}
    return Trajectories.from_episodes("cart", [good, second], action_low=-VOLTS, action_high=VOLTS)


second = episodes[1]
a_number_lost = second["observations"].copy()
a_number_lost[17, 3] = np.nan
no_end = np.zeros(len(second["rewards"]), bool)
two_in_one = second["terminations"].copy()
two_in_one[[40, -1]] = True
mistakes = {
    "no terminations were recorded": {"terminations": None},
    "no end: all flags are False": {"terminations": no_end, "truncations": no_end},
    "several episodes in one array": {"terminations": two_in_one},
    "the observation after the last step was dropped": {"observations": second["observations"][:-1]},
    "lengths differ: one reward too few": {"rewards": second["rewards"][:-1]},
    "another width: a sensor was added later": {"observations": np.pad(second["observations"], ((0, 0), (0, 1)))},
    "a sensor failed and wrote NaN": {"observations": a_number_lost},
    "actions in PWM counts instead of volts": {"actions": 255 / VOLTS * second["actions"]},
    "rewards as text": {"rewards": second["rewards"].astype(str)},
}  # fmt: skip
refusals = {}
for mistake, changed in mistakes.items():
    try:
        attempt(**changed)
    except DataError as error:
        refusals[mistake] = str(error)
        print(f"{mistake}:\n    {error}\n")

# %% [markdown]
# Actions may exceed the box only by rounding, and nothing is repaired silently: what to do about a lost sensor is your
# decision. Some mistakes look like sound numbers (actions one step late, for example); the last section detects those.
#
# ## Keep them, and look again
#
# One folder, which everything that takes `--data` reads as `arrays:FOLDER`. Every command of this library is one line
# in a terminal; here a small helper runs them.


# %%
def dds(line):
    """Type a command; returns its exit status."""
    print(f"$ dds {line}")
    return main(shlex.split(line))


folder = data.save(RUNS / "cart-data", overwrite=True)
status = dds(f"data check {folder} --horizon 10")

# %%
status = dds(f"data show {folder} --episodes 3 --no_figure")

# %% [markdown]
# (Its last line compares only widths: a point mass in a maze also has four observations and two actions. Ours is not a
# point mass, so no `--task` is given.)
#
# ## The same as a file in D4RL's layout
#
# Flat rows of steps, end to end, in one HDF5 file; many labs record data this way. Row $t$ holds the state before step
# $t$ and the result of the step. With `next_observations` nothing is lost. Without them it is unknown where the last
# step of a truncated episode led, so that step is left out.


# %%
def write_d4rl(path, **more):
    """Our episodes as a file in D4RL's layout."""
    rows = {
        "observations": np.concatenate([episode["observations"][:-1] for episode in episodes]),
        "actions": np.concatenate([episode["actions"] for episode in episodes]),
        "rewards": np.concatenate([episode["rewards"] for episode in episodes]),
        "terminals": np.concatenate([episode["terminations"] for episode in episodes]),
        "timeouts": np.concatenate([episode["truncations"] for episode in episodes]),
        **more,
    }
    with h5py.File(path, "w") as file:
        for name, array in rows.items():
            file[name] = array
    return load_trajectories(f"d4rl:{path}", cart)


followed = np.concatenate([episode["observations"][1:] for episode in episodes])
d4rl = write_d4rl(RUNS / "cart.hdf5", next_observations=followed)
shorter = write_d4rl(RUNS / "cart-without.hdf5")
lost = data.num_steps - shorter.num_steps
print(f"with next_observations: the same bytes as our arrays? {d4rl.fingerprint() == data.fingerprint()}")
print(f"without: {lost} steps fewer; {facts['truncated episodes']} episodes were truncated")

# %% [markdown]
# ## And as a Minari data set
#
# Written with Minari itself, read without it: no code that a data set names is ever executed. For that reason a data
# set that names an environment is accepted if the environment is in the table of `dds tasks`, or if you name your
# robot's task file (`--task robot.yaml`). Without either, write it without an environment, and give the two spaces:

# %%
os.environ["MINARI_DATASETS_PATH"] = str((RUNS / "minari").resolve())  # Minari wants a whole path
shutil.rmtree(RUNS / "minari", ignore_errors=True)
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # that no author and no link were given
    import minari
    from minari.data_collector import EpisodeBuffer

    minari.create_dataset_from_buffers(
        "cart/joystick-v0",
        [EpisodeBuffer(id=number, **episode) for number, episode in enumerate(episodes)],
        observation_space=Cart.observation_space,
        action_space=Cart.action_space,
    )
recorded = load_trajectories("minari:cart/joystick-v0")
print(f"{recorded.name}: the same bytes as our arrays? {recorded.fingerprint() == data.fingerprint()}")

# %% [markdown]
# ## Learn: skills
#
# From here on it does not matter where the data came from. Ten steps are one second of driving; eight skills. The
# picture is redrawn while it learns (notebook 02 explains its numbers).

# %%
logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
warnings.filterwarnings("ignore", message=".*(does not have many workers|LeafSpec|logging interval|GPU).*")
torch.set_num_threads(1)  # small networks: a second thread costs more than it brings


class Watch(pl.Callback):
    """Redraw some measures every few steps."""

    def __init__(self, names, every):
        self.names, self.every, self.rows, self.handle = names, every, [], None

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        if trainer.global_step % self.every and trainer.global_step != trainer.max_steps:
            return
        known = {name: float(trainer.callback_metrics[f"train/{name}"]) for name in self.names}
        self.rows.append({"step": trainer.global_step, **known})
        table = pd.DataFrame(self.rows)
        figure = Figure(figsize=(3.1 * len(self.names), 2.2), layout="constrained")
        for ax, name in zip(figure.subplots(1, len(self.names), squeeze=False)[0], self.names, strict=True):
            ax.plot(table["step"], table[name], color="#2779d2", marker=".")
            ax.set(xlabel="step", title=name.replace("_", " "), xlim=(0, trainer.max_steps))
            ax.spines[["top", "right"]].set_visible(False)
        if self.handle is None:
            self.handle = display(figure, display_id=True)
        else:
            self.handle.update(figure)


def train(model, batches, steps, *names):
    """Train a model with Lightning, on the CPU, and show how it goes."""
    quiet = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    watch = Watch(names, every=max(steps // 15, 1))
    trainer = pl.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", devices=1, callbacks=[watch], limit_val_batches=0, **quiet
    )
    trainer.fit(model, datamodule=batches)
    return trainer


pl.seed_everything(0, verbose=False)
segments = SegmentDataModule.from_trajectories(data, horizon=10, batch_size=64)
skill = SkillModule(
    segments.observation_dim, segments.action_dim, horizon=10, num_skills=8, skill_dim=16,
    hidden_dim=64, encoder_layers=1, encoder_heads=4, decoder_blocks=2, dropout=0.0,
    lr=2e-3, lr_schedule="cosine", warmup_steps=20,
)  # fmt: skip
trainer = train(skill, segments, SKILL_STEPS, "denoising", "commitment", "perplexity")
trainer.save_checkpoint(RUNS / "skill.ckpt")

# %% [markdown]
# ## Relabel
#
# Each segment becomes one row: in this state that skill was used, it earned so much and led there. The robot is not in
# the table of tasks, so we have to say ourselves how rewards are scaled: $0.1\,(r - 1)$, as in the mazes. Every step
# costs 0.1 until the dock is reached, so the learner is in a hurry.

# %%
transitions = RelabeledDataModule.from_trajectories(
    data, str(RUNS / "skill.ckpt"), reward_scale=0.1, reward_shift=-1.0, batch_size=256
)
table = transitions.relabel_into(transitions.cache_file())
span = np.minimum(table.starts.numpy()[:, None] + np.arange(10), data.num_steps - 1)  # few segments end early
left, right = data.actions[span].mean(axis=1).T
codes = table.codes.numpy()
pd.DataFrame({"skill": codes, "drive, V": (left + right) / 2, "turn, V": (right - left) / 2}).groupby("skill").agg(
    segments=("drive, V", "size"), drive=("drive, V", "mean"), turn=("turn, V", "mean")
).round(1)

# %% [markdown]
# Did it discover anything? On the left the mean voltages of each segment, coloured by its skill: the model had no prior
# notion of a curve. On the right all eight skills for two seconds, from one pose (facing up, at rest).

# %%
figure = Figure(figsize=(9.0, 3.9), layout="constrained")
plane, room = figure.subplots(1, 2)
shown = np.random.default_rng(0).permutation(len(codes))[:2500]
for code in range(skill.num_skills):
    mine = shown[codes[shown] == code]
    plane.scatter((right - left)[mine] / 2, (left + right)[mine] / 2, s=5, color=skill_colour(code), alpha=0.5)
for code in np.unique(codes):
    mine = codes == code
    draw_number(plane, np.array([(right - left)[mine].mean() / 2, (left + right)[mine].mean() / 2]), int(code), size=10)
plane.invert_xaxis()  # to the left is left
plane.set(
    xlabel="turn to the left: (right - left) / 2, V",
    ylabel="drive: (left + right) / 2, V",
    title="segments of the data",
)
plane.spines[["top", "right"]].set_visible(False)

carts = [Cart() for _ in range(skill.num_skills)]
seen = np.stack([one.reset(options={"pose": (1.5, 0.0, np.pi / 2)})[0] for one in carts])
alone = DDSAgent(skill, selection="fixed", fixed_codes=np.arange(skill.num_skills), noise_scale=0.5, seed=0)
trails = [seen[:, :2]]
for _ in range(20):
    seen = np.stack([one.step(action)[0] for one, action in zip(carts, alone.act(seen), strict=True)])
    trails.append(seen[:, :2])
trails = np.stack(trails, axis=1)  # (K, 21, 2)
draw_walls(room, cart)
for code, trail in enumerate(trails):
    draw_trail(room, trail, code, linewidth=2)
    draw_number(room, trail[-1], code)
draw_starts(room, [trails[0, 0]], cart.cell_size, size=14)
room.set(xlim=(0, 3.5), ylim=(-2, 2.5), title="each skill for two seconds")
figure

# %% [markdown]
# ## Learn: when to use which
#
# Notebooks 03 and 04 explain what happens here. `fourier_features` let the value and policy networks see walls;
# `fourier_seen=2` says that they are computed from the first two observations, the position.

# %%
pl.seed_everything(0, verbose=False)
policy = PolicyModule(
    transitions.observation_dim, transitions.num_skills, hidden_dims=(128, 128), skill_hash=transitions.skill_hash,
    fourier_features=32, fourier_scale=1.0, fourier_seen=2, tau=0.9, alpha=5.0, target_ema=0.02,
    extraction="joint", lr=2e-3, lr_schedule="cosine",
)  # fmt: skip
trainer = train(policy, transitions, POLICY_STEPS, "v_mean", "q_loss", "effective_sample_size")
trainer.save_checkpoint(RUNS / "policy.ckpt")

# %% [markdown]
# What it believes: how good it is to be at a place, averaged over all headings. From the other room the dock is far,
# because the way leads through the door.


# %%
def worth(places):
    """V of a cart at rest, the mean over eight headings."""
    values = 0.0
    for heading in np.arange(8) * np.pi / 4:
        states = places.copy()
        states[:, 2:4] = np.cos(heading), np.sin(heading)
        with torch.inference_mode():
            values = values + policy.v(torch.from_numpy(states)).numpy() / 8
    return values


figure = plot_value_map(cart, worth)
figure.axes[0].set_title("V of a cart at rest, mean over its headings")
figure

# %% [markdown]
# ## Does it drive?
#
# Against two baselines: the same skills chosen at random, and **behaviour cloning**, a network that copies the joystick
# without skills. Its loss hardly falls: at any given place the joystick went in all directions, and a mean of
# directions leads nowhere.

# %%
pl.seed_everything(0, verbose=False)
clone = BehaviourCloning(4, 2)
single_steps = SegmentDataModule.from_trajectories(data, horizon=1, batch_size=512)
trainer = train(clone, single_steps, POLICY_STEPS // 2, "loss")

# %% [markdown]
# All play the same twenty starts:

# %%
agent = DDSAgent(skill, policy, "sample", seed=0)
result = rollout(
    cart,
    [
        Contestant("AWR, sampled", agent, EPISODES),
        Contestant("AWR, greedy", agent.variant("greedy"), EPISODES),
        Contestant("random skills", agent.variant("random"), EPISODES),
        Contestant("behaviour cloning", CloneActor(clone), EPISODES),
    ],
    seed=1, workers=0, record=True,
)  # fmt: skip
summary = summary_table(result.episodes)
readable(summary, cart)

# %%
plot_trajectories(cart, result, "AWR, sampled")

# %%
plot_trajectories(cart, result, "behaviour cloning", numbered=0)

# %%
episode = choose_episodes(result, "AWR, sampled")[0]  # of median length
clip = write_clip(RUNS / "cart.gif", cart, result.paths["AWR, sampled", episode], title="the cart goes to its dock")
Image(data=clip.read_bytes(), format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## On the robot
#
# Four lines run on the robot, and they need neither the data nor the trainer. Call `reset` when a run begins and `act`
# ten times a second:

# %%
robot = Cart()
observation, info = robot.reset(seed=5)
agent.reset(num_envs=1, seed=5)
ticks, docked = 0, False
while ticks < 300 and not docked:
    observation, reward, docked, _, info = robot.step(agent.act(observation))
    ticks += 1
print(f"in the dock after {ticks / 10:g} s" if docked else "not in the dock after 30 s")

# %% [markdown]
# ## Publish it, load it again
#
# One folder with weights, settings, a card and hashes. It is verified before it is put in place, and nothing in it is
# ever executed.

# %%
place = RUNS / "cart-agent"
status = dds(f"publish - {place} --replace --skill {RUNS}/skill.ckpt --policy {RUNS}/policy.ckpt")

# %%
again = DDSAgent.load(place, seed=7)
again.reset(num_envs=64, seed=7)
agent.reset(num_envs=64, seed=7)
differ = float(np.abs(agent.act(data.observations[:64]) - again.act(data.observations[:64])).max())
print(f"the loaded agent's actions differ by at most {differ:g} V")
pd.Series({file.name: f"{file.stat().st_size / 1e3:.0f} kB" for file in sorted(place.iterdir())}).to_frame("size")

# %% [markdown]
# ## If your robot is one of the table's: replay
#
# For Hoppers, Ants, point masses and so on, `dds data check --task NAME --replay N` finds what cannot be seen in the
# numbers: it puts the simulator into recorded states, takes the recorded actions, and compares where they lead. Here
# are 1,500 steps of a point mass in a maze, driven by a PD controller, and the same with a very common mistake: each
# action is recorded **one step late**.

# %%
point = get_task("pointmaze-umaze-diverse")
env, rng, runs = point.make_env(), np.random.default_rng(0), []
for number in range(10):
    observation, _ = env.reset(seed=number)
    seen, taken = [observation], []
    for step in range(150):
        if step % 30 == 0:
            target = point.start_xy() + rng.uniform(-0.4, 1.4, 2)
        push = 1.5 * (target - observation[:2]) - 0.8 * observation[2:]
        taken.append(np.clip(push + rng.normal(0, 0.2, 2), -1, 1).astype(np.float32))
        observation = env.step(taken[-1])[0]
        seen.append(observation)
    end = np.arange(150) == 149
    runs.append({"observations": np.stack(seen), "actions": np.stack(taken), "rewards": np.zeros(150),
                 "terminations": end & False, "truncations": end})  # fmt: skip
late = [{**run, "actions": np.roll(run["actions"], 1, axis=0)} for run in runs]
for name, recording in {"right": runs, "late": late}.items():
    Trajectories.from_episodes(name, recording).save(RUNS / f"point-{name}", overwrite=True)
fits = dds(f"data check {RUNS}/point-right --task {point.name} --replay 200")

# %%
misfits = dds(f"data check {RUNS}/point-late --task {point.name} --replay 200")

# %% [markdown]
# The exit status is 0 for data that match and 1 for data that do not, for use in scripts. For such data `dds run TASK
# --data arrays:FOLDER` does everything that this notebook did, in one command.
#
# ## What you should see

# %% tags=["check"]
success = summary.set_index("contestant")["success"]
baseline = max(success["random skills"], success["behaviour cloning"])
read = (d4rl, recorded)
checks = pd.DataFrame(
    [
        ("refusals", len(refusals), len(mistakes), len(mistakes)),
        ("layouts that give the same bytes", sum(one.fingerprint() == data.fingerprint() for one in read), 2, 2),
        ("skills in use", len(np.unique(codes)), 6, 8),
        ("success of the agent, sampled, %", success["AWR, sampled"], 65, 100),
        ("success of the agent, greedy, %", success["AWR, greedy"], 65, 100),
        ("better than the better baseline by, %", success["AWR, sampled"] - baseline, 40, 100),
        ("difference after publishing and loading, V", differ, 0, 1e-6),
        ("exit status of data that fit", fits, 0, 0),
        ("exit status of actions that are one step late", misfits, 1, 1),
    ],
    columns=["what", "found", "at least", "at most"],
)  # fmt: skip
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. Move the dock (`goal_cell=(4, 1)`). Which parts have to be learnt again, and which rows change? (`reward` and
#    `terminations` say where the dock was; the skills do not care.)
# 2. Record without the playing around (`rng.random() < 0.0`). What happens to the skills that drive backwards, and to
#    an agent that stands in front of a wall?
# 3. Mark every truncation as a termination. What does the value map look like, and why?
#
# <details>
# <summary>Answers</summary>
#
# 1. The skills stay; relabelling and the policy are made anew. `rewards` and `terminations` of the steps that enter the
#    new dock or entered the old one change, and a drive that enters the new dock ends there.
# 2. Without it not one segment drives backwards (2.4 % with it), so no skill can, and hardly any segment stands still
#    for its whole second (0.1 % instead of 3.0 %). An agent in front of a wall is then in a state that the data never
#    show, with skills that only go forwards.
# 3. As in notebook 03: wherever a recording happened to stop, the costs stop, and such places look like docks. Expect a
#    map that is bright wherever drives ended, and no way to the dock in it.
#
# </details>
#
# ## The same at full size
#
# Stage by stage, with your arrays in a folder; no task is named, so widths come from the data:
#
# ```bash
# dds data check runs/notebooks/08/cart-data --horizon 10
# dds skill fit --config pointmaze/skill.yaml --data.data arrays:runs/notebooks/08/cart-data \
#     --checkpoint.dirpath runs/cart-skill
# dds policy fit --config pointmaze/policy.yaml --data.data arrays:runs/notebooks/08/cart-data \
#     --data.skill runs/cart-skill/last.ckpt --data.reward_scale 0.1 --data.reward_shift=-1 \
#     --model.fourier_seen 2 --checkpoint.dirpath runs/cart-policy
# dds publish - shared/cart --skill runs/cart-skill/last.ckpt --policy runs/cart-policy/last.ckpt
# dds checkpoints verify shared/cart
# dds export shared/cart --out cart.onnx
# ```
#
# Next: [09 · Reproduce a row of the paper](09_reproduce_a_row.ipynb).
