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
# # 07 · Fine-tune from a checkpoint
#
# **What you will see:** the shipped skills, learnt in one maze, in a maze that they have never seen and on another
# driver's data; which part of a skill model can be tuned without losing the policy that uses it, with proof that what
# is frozen does not change by a single bit; a policy that gets a new goal while its skills stay the same; a robot with
# different sensors, and which weights still fit it; and how much all of this saves compared with learning from scratch.
#
# **Time:** four to five minutes on two CPU cores. No network, no GPU, no graphics driver.
#
# Skills determine how a body moves, the policy where it goes. A new maze, goal or driver changes one of the two much
# more than the other, so it should be possible to keep what did not change. Whether it really is has to be measured.

# %%
# %matplotlib inline
import logging
import warnings
from dataclasses import replace
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pandas as pd
import torch
from IPython.display import Image, display
from matplotlib.figure import Figure

from datamodules import RelabeledDataModule, SegmentDataModule, Trajectories, collect_pointmaze, load_trajectories
from dds_lightning import DDSAgent, PolicyModule, SkillModule, get_task
from dds_lightning.callbacks.resume import undisturbed
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw.clip import write_clip
from dds_lightning.interpret.draw.drawing import draw_number, draw_walls
from dds_lightning.interpret.draw.maze import choose_episodes, plot_skills_by_start
from dds_lightning.rollout import Contestant, rollout
from dds_lightning.study.skill_replays import replay_skills

logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
warnings.filterwarnings(
    "ignore", message=".*(does not have many workers|LeafSpec|logging interval|GPU|eval mode|shorter than).*"
)

# %% tags=["parameters"] quick={"CAP": 9, "DATA_STEPS": [2600, 2200, 2000], "TUNING": 2, "POLICY_STEPS": 2}
DATA_STEPS = (100_000, 30_000, 15_000)  # in Large, in Large by another driver, in Medium
TUNING = 300  # steps of a fine-tuning
POLICY_STEPS = 3_000
EPISODES = 12
CAP = 800  # steps an episode may take
CHECKPOINT = "../checkpoints/pointmaze-large"
RUNS = Path("../runs/notebooks/07")  # what this notebook writes lies here

# %% [markdown]
# ## The shipped skills on unfamiliar data
#
# They were learnt from 200,000 steps in PointMaze-**Large**, where a controller drives at 4.5 m/s. Two kinds of data
# are new to them: the same driver in PointMaze-**Medium**, where the walls are elsewhere, and a **careful driver** in
# Large, who keeps to 1.5 m/s.

# %%
large, medium = get_task("pointmaze-large-diverse"), get_task("pointmaze-medium-diverse")
collected = {
    "at home": (large, {}),
    "careful driver": (large, {"speed": 1.5, "dataset_id": "pointmaze-large-careful-v0"}),
    "Medium": (medium, {}),
}
folders, segments = {}, {}
for (name, (task, how)), steps in zip(collected.items(), DATA_STEPS, strict=True):
    folders[name] = collect_pointmaze(task, steps, 1, RUNS, overwrite=True, progress=False, **how)
    recorded = load_trajectories(f"local:{folders[name]}", task)
    segments[name] = SegmentDataModule.from_trajectories(recorded, batch_size=64, validation_fraction=0.1)
shipped = DDSAgent.load(CHECKPOINT, seed=0)
plot_skills_by_start(medium, **replay_skills(medium, shipped, steps=40))

# %% [markdown]
# In Medium they push in the same directions as at home. In numbers: how well does the decoder denoise the actions of
# held-out segments, given the skill that the encoder assigns?
#
# $$\mathcal L_\text{diff} = \mathbb E_{i, \epsilon} \lVert \epsilon - \epsilon_\theta(a_i, i, s, z_k) \rVert^2$$


# %%
def trainer_for(steps, *callbacks, every=None):
    """A Trainer that says nothing and saves nothing."""
    return pl.Trainer(
        max_steps=steps, accelerator="cpu", devices=1, callbacks=list(callbacks), logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
        check_val_every_n_epoch=None, val_check_interval=every or steps, limit_val_batches=8 if every else 0,
    )  # fmt: skip


def loss_of(model, data):
    """The denoising loss on held-out episodes."""
    pl.seed_everything(0, verbose=False)
    return trainer_for(1, every=1).validate(model, datamodule=data, verbose=False)[0]["val/denoising"]


untuned = {name: loss_of(shipped.skill, data) for name, data in segments.items()}
speeds = {name: float(np.linalg.norm(data.trajectories.observations[:, 2:], axis=1).mean())
          for name, data in segments.items()}  # fmt: skip
pd.DataFrame({"denoising loss, shipped skills": untuned, "speed in the data, m/s": speeds}).round(2)

# %% [markdown]
# A number alone says little: a careful driver's actions are smaller, and all of them contain unpredictable noise.
# Tuning shows how much there is to gain.
#
# ## Which part may learn?
#
# `init_from` starts a **new** training from the weights of a checkpoint; in Python that is `starting_from`. (Resuming
# an interrupted training is something else: `ckpt_path`.) `trainable` says which part learns:
#
# | `trainable` | encoder $E(\tau)$ | codebook $z_k$ | decoder $p(a \mid z_k, s)$ | good for |
# | --- | :-: | :-: | :-: | --- |
# | `decoder` | stays | stays | learns | the same skills, played another way |
# | `codebook` | stays | learns | stays | moving skills to where the new data are |
# | `encoder` | learns | stays | stays | sorting new segments into the old skills |
# | `all` | learns | learns | learns | new skills that begin as the old ones |
#
# Two more variants let everything learn. During skill training, codes that are hardly used are **restarted** from the
# data every 100 steps; `restart_threshold=0` leaves them alone. And **discriminative rates** slow parts down:
# `lr_scale={"encoder": 0.1, "codebook": 0.1}` gives encoder and codebook a tenth of the rate. The seventh variant
# starts from scratch. All get the careful driver's data and 300 steps. Then each plays in Large under the shipped
# **policy**, which does not know that the skills have changed:

# %%
ways = {
    "decoder": {"trainable": "decoder"},
    "codebook": {"trainable": "codebook"},
    "encoder": {"trainable": "encoder"},
    "all": {"trainable": "all"},
    "all, no restarts": {"restart_threshold": 0.0},
    "the same, slowly": {"restart_threshold": 0.0, "lr_scale": {"encoder": 0.1, "codebook": 0.1}},
    "from nothing": None,
}
COLOURS = dict(zip(ways, ("#10a06f", "#c3b352", "#67ccf9", "#501593", "#c257a8", "#2779d2", "#d0271a"), strict=True))
own_settings = dict(shipped.skill.hparams)
for name in ("trainable", "lr_scale", "refit_normaliser"):
    own_settings.pop(name)  # they say how that one was made


class Losses(pl.Callback):
    """Keep the validation loss."""

    def __init__(self) -> None:
        self.rows = []

    def on_validation_end(self, trainer, module):
        self.rows.append((trainer.global_step, float(trainer.callback_metrics["val/denoising"])))


def draw_losses(curves, colours, steps):
    figure = Figure(figsize=(8.5, 3.1), layout="constrained")
    ax = figure.add_subplot()
    for name, rows in curves.items():
        ax.plot(*np.transpose(rows), "o-", markersize=3, color=colours[name], label=name)
    ax.set(xlabel="step", ylabel="denoising loss (held out)", xlim=(-0.02 * steps, 1.02 * steps))
    ax.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    ax.spines[["top", "right"]].set_visible(False)
    return figure


models, curves = {}, {}
handle = display(Figure(figsize=(8.5, 3.1)), display_id=True)
for name, settings in ways.items():
    pl.seed_everything(0, verbose=False)
    if settings is None:
        model = SkillModule(**{**own_settings, "lr": 2e-3, "warmup_steps": 10})
    else:
        model = SkillModule.starting_from(CHECKPOINT, lr=2e-3, warmup_steps=10, **settings)
    watch = Losses()
    trainer = trainer_for(TUNING, watch, every=max(TUNING // 4, 1))
    if settings is not None:  # what was brought, before the first step
        trainer.validate(model, datamodule=segments["careful driver"], verbose=False)
    trainer.fit(model, datamodule=segments["careful driver"])
    models[name], curves[name] = model.eval(), watch.rows
    handle.update(draw_losses(curves, COLOURS, TUNING))


# %%
def play(task, agents, seed=5):
    """Success and speed of some agents, side by side."""
    task = replace(task, max_episode_steps=min(CAP, task.max_episode_steps))
    players = [Contestant(name, agent, EPISODES) for name, agent in agents.items()]
    result = rollout(task, players, seed=seed, record_observations=True, progress=False)
    rows = {}
    for name in agents:
        paths = [path for (who, _), path in result.paths.items() if who == name]
        speed = float(np.concatenate([np.linalg.norm(path.observations[:, 2:], axis=1) for path in paths]).mean())
        rows[name] = {"success, %": 100 * float(result.episodes[result.episodes["actor"] == name]["success"].mean())}
        rows[name]["speed, m/s"] = speed
    return pd.DataFrame(rows).T


tuned = {"as shipped": shipped.skill, **models}
outcome = play(large, {name: DDSAgent(skill, shipped.policy) for name, skill in tuned.items()})
batches = list(segments["careful driver"].val_dataloader())


def codes_of(model):
    """The skill that the model names for every held-out segment."""
    with torch.no_grad():
        return torch.cat([model.encode(batch["observations"], batch["actions"]) for batch in batches])


outcome["denoising loss"] = [loss_of(skill, segments["careful driver"]) for skill in tuned.values()]
outcome["segments that keep their code, %"] = [
    100 * float((codes_of(skill) == codes_of(shipped.skill)).float().mean()) for skill in tuned.values()
]
vectors = {name: skill.bottleneck.vectors.detach() for name, skill in tuned.items()}
strayed = {name: (own - vectors["as shipped"]).norm(dim=1) for name, own in vectors.items()}
outcome["codes restarted"] = [
    int((strayed[name] > 0.7 * vectors["as shipped"].norm(dim=1)).sum()) if name != "from nothing" else None
    for name in tuned
]
outcome.round(2)

# %% [markdown]
# * **The decoder alone** gains most of what there is to gain, and the policy never notices: code 7 is still code 7.
# * **Encoder alone** does not change what a code *does*, so the policy plays as before, up to chance in its draws.
# * **Restarts make it a lottery** (`codebook`, `all`), and the loss does not show it. The careful driver hardly uses
#   some of the codes that this policy depends on. They count as dead, are restarted from the new data, and mean
#   something else from then on. Above, that cost `codebook` and `all` the policy; with three other seeds of `all` it
#   reached the goal in 25, 60 and 80 % of 20 episodes.
# * **Without restarts** everything can learn, and the same three seeds reach it in 100, 95 and 100 %.
# * **From scratch** the codes have nothing to do with this policy.
#
# So: to keep a policy, tune the decoder or set `restart_threshold=0`. Let codes restart if you are going to train the
# policy again on top (relabel first). A policy's checkpoint records which skills it was trained on, and the library
# refuses a pair that it knows not to match.

# %% [markdown]
# ## What is frozen stays, bit for bit
#
# No gradient, no dropout, no running averages, no restart of dead codes: a frozen part ends exactly as it began. Here
# is how far each part moved, in per cent of its norm, $100 \cdot \lVert w' - w \rVert / \lVert w \rVert$. A zero is not
# a small number but exactly zero: `torch.equal` on every tensor.

# %%
PARTS = {"encoder": "encoder.", "codebook": "bottleneck.vectors", "decoder": "decoder.net"}
before = shipped.skill.state_dict()
rows = {}
for name in list(ways)[:-1]:
    after = models[name].state_dict()
    rows[name] = {}
    for part, prefix in PARTS.items():
        keys = [key for key in before if key.startswith(prefix)]
        old, new = (torch.cat([state[key].flatten() for key in keys]) for state in (before, after))
        rows[name][f"{part} moved, %"] = 100 * float((new - old).norm() / old.norm())
        rows[name][f"{part}: same bits"] = all(torch.equal(before[key], after[key]) for key in keys)
moved = pd.DataFrame(rows).T
moved.infer_objects().round(2)

# %% [markdown]
# ## A new goal: the policy learns, the skills stay
#
# Back in Large. The goal moves from the upper right to the lower right corner; for the learner that is a new reward. A
# task is a row of a table, and a copy of it with another goal is also a task:

# %%
new_goal = replace(large, name="pointmaze-large-new-goal", goal_cell=(7, 10))
towards = load_trajectories(f"local:{folders['at home']}", new_goal)  # the rewards of the new goal
skill_before = shipped.skill.fingerprint()
transitions = RelabeledDataModule.from_trajectories(
    towards, CHECKPOINT, cache=str(RUNS), reward_scale=large.reward_scale, reward_shift=large.reward_shift
)
transitions.prepare_data()
transitions.setup()


class Play(pl.Callback):
    """Let the agent play at intervals, without disturbing the training; `draw` shows what is known so far."""

    def __init__(self, task, skill, every, draw) -> None:
        self.task, self.skill, self.every, self.draw, self.rows = task, skill, every, draw, []

    def play(self, step, policy):
        with undisturbed(policy):
            players = [Contestant("agent", DDSAgent(self.skill, policy, "greedy"), EPISODES)]
            task = replace(self.task, max_episode_steps=min(CAP, self.task.max_episode_steps))
            self.result = rollout(task, players, seed=5, workers=0, record=True, progress=False)
        self.rows.append((step, float(self.result.summary()["success"].iloc[0])))
        self.draw()

    def on_train_start(self, trainer, module):
        self.play(0, module)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        if trainer.global_step % self.every == 0:
            self.play(trainer.global_step, module)


def draw_success(plays, colours):
    """Success of each contestant over its steps."""
    figure = Figure(figsize=(7.5, 2.9), layout="constrained")
    ax = figure.add_subplot()
    for name, one in plays.items():
        ax.plot(*np.transpose(one.rows), "o-", markersize=4, color=colours[name], label=name)
    ax.set(xlabel="steps of the policy", ylabel="success at the new goal, %", ylim=(-4, 104))
    ax.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    ax.spines[["top", "right"]].set_visible(False)
    return figure


learning = {"lr": 2e-3, "lr_schedule": "cosine", "skill_hash": transitions.skill_hash}
policies = {
    "from the old policy": PolicyModule.starting_from(CHECKPOINT, **learning),
    "from nothing": PolicyModule(**{**shipped.policy.hparams, **learning}),
}
POLICY_COLOURS = {"from the old policy": "#2779d2", "from nothing": "#d0271a"}
handle = display(Figure(figsize=(7.5, 2.9)), display_id=True)
plays = {}
for name, policy in policies.items():
    pl.seed_everything(0, verbose=False)
    plays[name] = Play(
        new_goal, shipped.skill, max(POLICY_STEPS // 3, 1), lambda: handle.update(draw_success(plays, POLICY_COLOURS))
    )
    trainer_for(POLICY_STEPS, plays[name]).fit(policy, datamodule=transitions)
print("the skills are the same, bit for bit:", shipped.skill.fingerprint() == skill_before)

# %% [markdown]
# The skills did not have to learn anything, and a minute of policy training is enough. But the **old policy is no head
# start; here it is even a handicap**: after 3,000 steps it is behind the one from scratch. What it knows best is the
# value of a place, and that is wrong now; every target of its critic is built on its old beliefs, so they fade slowly.
# Bright is near the goal, each map on its own scale; numbers are the likeliest skill. The new goal's own cell stays
# dark although all around it is brighter: an episode ends on entering the circle, so no row of the table begins inside
# it, and what the network says there is what it extrapolates. No decision depends on it.

# %%
free = np.array(large.free_cells())
centres = np.zeros((len(free), 4), np.float32)
centres[:, :2] = large.cell_to_xy(free)


def draw_belief(ax, task, policy, title):
    """The value of every free cell, and the likeliest skill there, for a body at rest."""
    draw_walls(ax, task)
    with torch.no_grad():
        value = policy.v(torch.from_numpy(centres)).numpy()
        likeliest = policy.codes(torch.from_numpy(centres), "greedy").numpy()
    grid = np.full((len(task.maze_map), len(task.maze_map[0])), np.nan)
    grid[free[:, 0], free[:, 1]] = value
    box = {"xlim": ax.get_xlim(), "ylim": ax.get_ylim()}
    ax.imshow(grid, extent=(*box["xlim"], *box["ylim"]), cmap="viridis", zorder=0.5)
    for centre, code in zip(centres, likeliest, strict=True):
        draw_number(ax, centre[:2], int(code), size=6)
    ax.set(xticks=[], yticks=[], xlabel="", ylabel="", title=title, **box)


figure = Figure(figsize=(9.5, 3.7), layout="constrained")
left, right = figure.subplots(1, 2)
draw_belief(left, large, shipped.policy, "the shipped policy, the old goal")
draw_belief(right, new_goal, policies["from the old policy"].eval(), f"after {POLICY_STEPS:,} steps, the new goal")
figure

# %% [markdown]
# And the agent on its way to a goal that it never had before:

# %%
result = plays["from the old policy"].result
clip = write_clip(RUNS / "new-goal.gif", new_goal, result.paths["agent", choose_episodes(result, "agent")[0]],
                  title="old skills, new goal")  # fmt: skip
Image(data=clip.read_bytes(), format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## A robot with other sensors
#
# Now the robot also reports its previous push, so an observation has six numbers instead of four. A network with a
# different input cannot be loaded whole. What fits is loaded, and the rest is listed:

# %%
episodes = []
at_home = segments["at home"].trajectories
for number in range(at_home.num_episodes):
    episode = at_home.episode(number)
    pushed = np.concatenate([np.zeros((1, 2), np.float32), episode["actions"]])
    episodes.append({**episode, "observations": np.concatenate([episode["observations"], pushed], axis=1)})
wider = SegmentDataModule.from_trajectories(
    Trajectories.from_episodes("six numbers", episodes), batch_size=64, validation_fraction=0.1
)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    adapted = SkillModule.starting_from(CHECKPOINT, observation_dim=6, lr=1e-3, warmup_steps=10)
told = str(caught[0].message)
anew = told.partition("here): ")[2].count(";") + 1
print(told.replace("; ", ";\n    ").replace("here): ", "here):\n    "))

# %% [markdown]
# Only the first layers start from scratch (so do the statistics, which are taken from the new data). A frozen part must
# not be random, so a combination that cannot work is refused:

# %%
try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        SkillModule.starting_from(CHECKPOINT, observation_dim=6, trainable="codebook")
    refusal = ""
except UserError as error:
    refusal = str(error)
print(refusal)

# %% [markdown]
# Does it help to load what fits? The same 150 steps, on the original data:

# %%
pl.seed_everything(0, verbose=False)
fresh = SkillModule(**{**own_settings, "observation_dim": 6, "lr": 1e-3, "warmup_steps": 10})
sensors = {}
SENSOR_COLOURS = {"what fits is brought": "#2779d2", "from nothing": "#d0271a"}
for name, model in zip(SENSOR_COLOURS, (adapted, fresh), strict=True):
    pl.seed_everything(0, verbose=False)
    watch = Losses()
    trainer_for(TUNING // 2, watch, every=max(TUNING // 6, 1)).fit(model, datamodule=wider)
    sensors[name] = watch.rows
draw_losses(sensors, SENSOR_COLOURS, TUNING // 2)

# %% [markdown]
# **It does not.** The loaded weights sit behind first layers that are random: at first everything looks alike to the
# encoder, only three or four codes stay in use (from scratch about ten), and what was known is relearnt rather than
# kept. Loading weights pays where the beginning of the network fits.
#
# ## What does it save?
#
# Learn PointMaze-**Large**, with skills learnt from scratch or with skills learnt in **Medium** before.
# `benchmarks/reuse_skills.py` did this with three seeds; its measurements are stored next to this notebook. Bands are
# the range over the seeds. The right panel shows time instead of steps, because a step of skill training costs about
# ten times as much as a step of policy training.

# %%
study = pd.read_csv("figures/skills-reused.csv")
STUDY_COLOURS = {"nothing": "#d0271a", "nothing, in short": "#d2764a", "reused as they are": "#2779d2",
                 "reused, decoder fine-tuned": "#10a06f"}  # fmt: skip
figure = Figure(figsize=(9.5, 3.4), layout="constrained")
panels = figure.subplots(1, 2, sharey=True)
for name, colour in STUDY_COLOURS.items():
    own = study[(study["way"] == name) & (study["stage"] == "policy")]
    groups = own.groupby(own.groupby("seed").cumcount())
    for ax, over in zip(panels, ("step", "seconds"), strict=True):
        x, y = groups[over].mean(), groups["success"]
        ax.plot(x, y.mean(), ".-", color=colour, label=name)
        ax.fill_between(x, y.min(), y.max(), color=colour, alpha=0.15, linewidth=0)
panels[0].set(xlabel="steps in Large, skills and policy", ylabel="success in Large, %")
panels[1].set(xlabel="seconds of one core in Large")
for ax in panels:
    ax.spines[["top", "right"]].set_visible(False)
figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
figure

# %%
rows = []
for name in STUDY_COLOURS:
    own = study[(study["way"] == name) & (study["stage"] == "policy")]
    last = own.groupby("seed").last()
    there = own[own["success"] >= 75].groupby("seed").first().reindex(last.index)
    rows.append(
        {
            "skills in Large": name,
            "success at the end, %": last["success"].mean(),
            "± over seeds": last["success"].std(),
            "seeds that reach 75 %": int(there["step"].notna().sum()),
            "after steps": there["step"].mean(),
            "after seconds": there["seconds"].mean(),
        }
    )
gain = pd.DataFrame(rows).set_index("skills in Large")
gain.round(0)

# %% [markdown]
# * **What is saved is the skill training.** Three quarters of the episodes succeed after 21 seconds with the reused
#   skills and after 83 with skills from scratch (the average over the seeds, all of which get there).
# * **The final result is no better.** In the end all four are equal within the spread of three seeds: older skills do
#   not lead to a better policy.
# * **A short training from scratch comes close.** A quarter of the skill training, from scratch, takes 38 seconds:
#   pushing a ball is quickly learnt. The saving grows with the cost of the skills.
#
# ## What you should see

# %% tags=["check"]
stayed = [moved.loc[name, f"{part} moved, %"] for name in ("decoder", "codebook", "encoder")
          for part in PARTS if part != name]  # fmt: skip
gain_of = {
    name: float(outcome.loc[name, "denoising loss"] / outcome.loc["as shipped", "denoising loss"]) for name in ways
}
checks = pd.DataFrame(
    [
        ("loss after tuning the decoder, against before", gain_of["decoder"], 0.85, 1.0),
        ("loss from nothing, against before", gain_of["from nothing"], 1.0, 2.0),
        ("the old policy on a tuned decoder, success in %", outcome.loc["decoder", "success, %"], 85, 100),
        ("codes that were restarted when all was tuned", outcome.loc["all", "codes restarted"], 2, 8),
        ("codes that were restarted without restarts", outcome.loc["all, no restarts", "codes restarted"], 0, 0),
        ("the old policy when all was tuned without restarts", outcome.loc["all, no restarts", "success, %"], 75, 100),
        ("the same, slowly", outcome.loc["the same, slowly", "success, %"], 75, 100),
        ("the old policy on skills from nothing, success in %", outcome.loc["from nothing", "success, %"], 0, 20),
        ("most that anything frozen moved, %", max(stayed), 0, 0),
        (
            "segments that keep their code on a tuned decoder, %",
            outcome.loc["decoder", "segments that keep their code, %"],
            100,
            100,
        ),
        ("success at the new goal before the first step, %", plays["from the old policy"].rows[0][1], 0, 30),
        ("success at the new goal, from the old policy, %", plays["from the old policy"].rows[-1][1], 40, 100),
        ("success at the new goal, from nothing, %", plays["from nothing"].rows[-1][1], 40, 100),
        ("tensors that start anew with six numbers", anew, 4, 4),
        (
            "six numbers: loss with what fits, against from nothing",
            sensors["what fits is brought"][-1][1] / sensors["from nothing"][-1][1],
            0.85,
            1.2,
        ),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
assert refusal
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. Tune all with restarts, with other seeds. Which codes are restarted, and which of them does the policy use?
# 2. Tune the decoder on 3,000 steps of the careful driver. When does the held-out loss rise again?
# 3. `PolicyModule.starting_from(CHECKPOINT, trainable="actor")` keeps the old critic. What can it learn about the new
#    goal, and what can it not?
#
# <details>
# <summary>Answers</summary>
#
# 1. Those that the careful driver hardly uses. Codes 5, 10, 12, 13 and 14 have 0.2 to 0.7 % of his segments, where a
#    uniform share is 6.2 %, but together 37 % of this policy's decisions. Which of them die in 300 steps is a matter of
#    the seed.
# 2. Watch the held-out loss: with so few segments expect the decoder to learn their noise by heart, so that it rises
#    while the loss of the training still falls. Keep the checkpoint at its lowest point, or give it more data.
# 3. Nothing about the goal: rewards reach the policy only through the critic, and a frozen critic still believes in the
#    old goal. The actor can only sharpen what follows from those beliefs, on the states of the new data.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds data collect pointmaze-medium-diverse --steps 200000 --out data
# dds skill fit --config pointmaze/skill.yaml --model.init_from checkpoints/pointmaze-large --model.trainable decoder \
#     --model.lr 1e-3 --data.task pointmaze-medium-diverse --data.data local:data/pointmaze-medium-diverse-v0 \
#     --checkpoint.dirpath runs/skill-tuned
# dds policy fit --config pointmaze/policy.yaml --data.task pointmaze-medium-diverse \
#     --data.data local:data/pointmaze-medium-diverse-v0 --data.skill runs/skill-tuned/last.ckpt \
#     --checkpoint.dirpath runs/policy-medium
# ```
#
# Next: [08 · Your own data](08_own_data.ipynb).
