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
# # 02 · Learn skills
#
# **What you will see:** what vector quantisation does to a cloud of points, a small skill model that learns eight
# skills before your eyes, with the health of its codebook next to the loss, the same training without any care for the
# codebook, and what the skills came to mean: each of them replayed from eight starts.
#
# **Time:** one to two minutes on two CPU cores. No network, no GPU, no graphics driver.

# %%
# %matplotlib inline
import logging
import warnings
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pandas as pd
import torch
from IPython.display import Image, display
from matplotlib.figure import Figure

from datamodules import SegmentDataModule, collect_pointmaze, load_trajectories
from datamodules.relabel import relabel
from dds_lightning import DDSAgent, SkillModule, get_task
from dds_lightning.interpret.draw.clip import replay_clip
from dds_lightning.interpret.draw.drawing import draw_number
from dds_lightning.interpret.draw.maze import plot_skills_by_start, plot_starts_by_skill
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.nn.codebook import Codebook
from dds_lightning.study.skill_replays import replay_skills

logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
warnings.filterwarnings("ignore", message=".*(does not have many workers|LeafSpec|logging interval|GPU).*")

# %% tags=["parameters"] quick={"STEPS": 4, "DATA_STEPS": 3000, "REPLAY_STEPS": 10}
STEPS = 800
DATA_STEPS = 20_000
REPLAY_STEPS = 50
HORIZON, SKILLS = 10, 8
RUNS = Path("../runs/notebooks/02")  # what this notebook writes lies here

# %% [markdown]
# ## What vector quantisation does
#
# An encoder turns a segment of ten steps into a point $E(\tau)$. The **codebook** holds $K$ vectors $z_1 \dots z_K$,
# and the segment's skill is simply the nearest of them (equation 11):
#
# $$k = \arg\min_j \lVert E(\tau) - z_j \rVert$$
#
# Here are 600 points in the plane, in eight clumps, and a codebook of eight vectors that starts by k-means. A colour is
# a code, and a numbered disc is its vector. The start need not be perfect (one vector may serve two clumps and another
# get what is left); what matters is that every vector has some points.

# %%
torch.manual_seed(0)
centres = torch.tensor([3.0, 1.5]) * torch.randn(8, 2)
points = centres[torch.randint(8, (600,))] + 0.35 * torch.randn(600, 2)
codebook = Codebook(SKILLS, 2, init="kmeans")
codebook.start_from(points)
codes = codebook.nearest(points)

figure = Figure(figsize=(6.5, 4.2), layout="constrained")
ax = figure.add_subplot()
ax.scatter(*points.T, s=7, c=[skill_colour(int(k)) for k in codes], alpha=0.6)
for k, vector in enumerate(codebook.vectors.detach().numpy()):
    draw_number(ax, vector, k, size=11)
ax.set(xlabel="first dimension of E(τ)", ylabel="second dimension", aspect="equal")
ax.spines[["top", "right"]].set_visible(False)
figure

# %% [markdown]
# "Nearest" has no gradient: a small move of a point changes nothing, until suddenly another code is nearer. Two tricks
# make it trainable (equations 13 and 14):
#
# * **Straight through.** In the forward pass the decoder gets $z_k$; in the backward pass its gradient is handed to
#   $E(\tau)$ as if nothing had happened in between.
# * **Two pulls.** The codebook term $\lVert \mathrm{sg}[E(\tau)] - z_k \rVert^2$ pulls the vector to its points, the
#   commitment term $\beta \lVert E(\tau) - \mathrm{sg}[z_k] \rVert^2$ pulls the points to their vector. ($\mathrm{sg}$
#   stops the gradient.)

# %%
encoding = points[:1].clone().requires_grad_()
quantised = codebook(encoding)
(quantised.vectors @ torch.tensor([3.0, -1.0])).sum().backward()  # a "decoder" whose gradient is (3, -1)
print("what the decoder gets:    ", quantised.vectors.detach().numpy().round(2), "= vector", int(quantised.codes[0]))
print("gradient at the encoding: ", encoding.grad.numpy(), "straight through")
print(f"pulls: codebook {quantised.terms['codebook'].value:.3f}, commitment {quantised.terms['commitment'].value:.3f}")

# %% [markdown]
# ## The data
#
# 20,000 steps of drives between random places, as in notebook 01, cut into segments of ten steps.

# %%
task = get_task("pointmaze-large-diverse")
folder = collect_pointmaze(task, DATA_STEPS, 0, RUNS, workers=1, overwrite=True, progress=False)
data = load_trajectories(f"local:{folder}", task)
segments = SegmentDataModule.from_trajectories(data, horizon=HORIZON, batch_size=128, validation_fraction=0.1)
segments.setup()
batch = next(iter(segments.train_dataloader()))
print({name: tuple(batch[name].shape) for name in ("observations", "actions")})

# %% [markdown]
# ## Learn, and watch
#
# The whole model in one sentence: a transformer encodes a segment, the codebook assigns it a code, and a diffusion
# **decoder** must reproduce every action of the segment from $z_k$ and the state alone. It never sees the other
# actions, so whatever they have in common has to go through the code: that is why a code becomes a *skill*. The loss
# (equation 14) is
#
# $$L = \underbrace{\lVert \epsilon - \epsilon_\theta(a_t, s, z_k, t) \rVert^2}_{\text{denoising}}
#   + \underbrace{\lVert \mathrm{sg}[E] - z_k \rVert^2}_{\text{codebook}}
#   + \beta \underbrace{\lVert E - \mathrm{sg}[z_k] \rVert^2}_{\text{commitment}}$$
#
# The picture below is redrawn while the model learns. On the right is the share of each code over the last few dozen
# batches. *Perplexity* $e^{H}$ is the effective number of codes in use: eight when all are used equally, one after a
# collapse.


# %%
class Watch(pl.Callback):
    """Redraw loss and codebook every few steps."""

    def __init__(self, every: int) -> None:
        self.every, self.rows, self.handle = every, [], None

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        if trainer.global_step % self.every and trainer.global_step != trainer.max_steps:
            return
        usage = module.bottleneck.usage
        perplexity = module.bottleneck.health()["perplexity"]
        terms = {name: value.item() for name, value in module.terms.items()}
        self.rows.append({"step": trainer.global_step, "perplexity": perplexity.item(), **terms})
        picture = self.draw((usage / usage.sum()).tolist(), trainer.max_steps)
        if self.handle is None:
            self.handle = display(picture, display_id=True)
        else:
            self.handle.update(picture)

    def draw(self, share, steps):
        table = pd.DataFrame(self.rows)
        figure = Figure(figsize=(9.5, 2.7), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        left.plot(table["step"], table["denoising"], color="#2779d2", label="denoising")
        left.plot(table["step"], table["commitment"], color="#d0271a", label="commitment")
        left.set(xlabel="step", ylabel="loss", xlim=(0, steps), ylim=(0, None))
        left.legend(frameon=False)
        middle.plot(table["step"], table["perplexity"], color="#10a06f")
        middle.set(xlabel="step", ylabel="perplexity", xlim=(0, steps), ylim=(0, SKILLS * 1.04))
        right.bar(range(len(share)), share, color=[skill_colour(k) for k in range(len(share))])
        right.axhline(1 / len(share), color="black", linewidth=0.8, linestyle="--")
        right.set(xlabel="code", ylabel="share of the data", xticks=range(len(share)))
        for ax in (left, middle, right):
            ax.spines[["top", "right"]].set_visible(False)
        return figure


def learn(steps: int, **settings) -> tuple[SkillModule, pl.Trainer, Watch]:
    """Train a small skill model on our segments."""
    pl.seed_everything(0, verbose=False)
    model = SkillModule(
        segments.observation_dim, segments.action_dim, HORIZON, SKILLS, skill_dim=16,
        hidden_dim=64, encoder_layers=1, encoder_heads=4, decoder_blocks=2, dropout=0.0,
        lr=2e-3, lr_schedule="cosine", warmup_steps=20, **settings,
    )  # fmt: skip
    watch = Watch(every=max(steps // 16, 1))
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    trainer = pl.Trainer(max_steps=steps, accelerator="cpu", devices=1, callbacks=[watch], limit_val_batches=0, **quiet)
    trainer.fit(model, datamodule=segments)
    return model, trainer, watch


model, trainer, watch = learn(STEPS)

# %% [markdown]
# How well does it do on held-out episodes? `reconstruction_rmse` compares sampled with true actions; guessing zero
# every time would give the number below it.

# %%
tester = pl.Trainer(accelerator="cpu", devices=1, logger=False, enable_progress_bar=False, enable_model_summary=False)
health = tester.validate(model, datamodule=segments, verbose=False)[0]
health = {name.removeprefix("val/"): value for name, value in health.items()}
guess = float(np.sqrt(np.square(data.actions).mean()))
pd.Series({**health, "rmse of guessing zero": guess}).round(3).to_frame("held-out episodes")

# %% [markdown]
# ## The same without care
#
# Codebooks are known to **collapse**: a vector that is never the nearest gets no gradient, and so never becomes the
# nearest. Two measures prevent it here: the codebook starts at the centres of the first encodings (k-means), and a dead
# code is restarted at a point that is far from every vector. Now without either, from random normal vectors, for just
# as many steps:

# %%
careless, _, careless_watch = learn(STEPS, codebook_init="normal", restart_threshold=0.0)
collapsed = tester.validate(careless, datamodule=segments, verbose=False)[0]
print(f"with care:    {health['codes_used']:.0f} of {SKILLS} codes in use, perplexity {health['perplexity']:.1f}")
print(f"without care: {collapsed['val/codes_used']:.0f} of {SKILLS} codes in use, "
      f"perplexity {collapsed['val/perplexity']:.1f}")  # fmt: skip

# %% [markdown]
# ## What do the codes mean?
#
# Assign every segment its code, and look at what its ten steps did on average. The model was never given directions: it
# discovered that the push is what the actions of a segment have in common. On the left the codes tile the space of
# pushes; on the right they are mixed, because what the body was doing before is in the state, which the decoder sees
# anyway.

# %%
labelled = relabel(data, model)
starts = labelled.starts.numpy()
span = np.minimum(starts[:, None] + np.arange(HORIZON), data.num_steps - 1)  # few segments end early
mean_action = data.actions[span].mean(axis=1)
codes = labelled.codes.numpy()
used = np.unique(codes)
shown = np.random.default_rng(0).permutation(len(codes))[:1500]
figure = Figure(figsize=(9.5, 4.1), layout="constrained")
left, right = figure.subplots(1, 2)
velocity = labelled.observations.numpy()[:, 2:]
for ax, values, what in ((left, mean_action, "mean push of the segment"), (right, velocity, "velocity at its start")):
    ax.scatter(*values[shown].T, s=4, c=[skill_colour(int(k)) for k in codes[shown]], alpha=0.5)
    for k in used:
        draw_number(ax, values[codes == k].mean(axis=0), int(k), size=10)
    ax.set(xlabel="in x", ylabel="in y", aspect="equal", title=what)
    ax.spines[["top", "right"]].set_visible(False)
figure

# %%
labelled.summary().drop(columns=["reward", "terminations"]).round(2)

# %% [markdown]
# ## Replay them
#
# Now the other way round: put the body at rest somewhere, hold one code, and let the decoder act for 50 steps. First
# one panel per skill (as in figure 4 of the paper); the stars mark the eight starts. A skill does much the same from
# each of them, until it meets a wall. Some hardly move a body at rest: they are small corrections for one that is on
# its way.

# %%
agent = DDSAgent(model, selection="random")
replays = replay_skills(task, agent, steps=REPLAY_STEPS)
plot_starts_by_skill(task, **replays)

# %% [markdown]
# Then one panel per start, with all the skills: a star of directions to choose from. Choosing well is the job of the
# policy, in notebook 04.

# %%
plot_skills_by_start(task, **replays)

# %% [markdown]
# One skill in motion, the one that carries farthest, from all eight starts at once:

# %%
ends = np.array([p[a.sum()] - p[0] for p, a in zip(replays["positions"], replays["alive"], strict=True)])
distance = pd.Series(np.linalg.norm(ends, axis=1), name="distance")
farthest = int(distance.groupby(replays["codes"]).mean().idxmax())
clip = replay_clip(task, replays["positions"][replays["codes"] == farthest], farthest, size=4.2)
Image(data=clip, format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## What you should see
#
# "Explained by the code" is the share of the variance of the mean push that lies between codes rather than within them:
# 0 if the codes had nothing to do with pushes, 1 if they determined them. With eight codes for two dimensions of push
# *and* two of velocity it cannot be 1.

# %% tags=["check"]
means = np.stack([mean_action[codes == k].mean(axis=0) if (codes == k).any() else np.zeros(2) for k in range(SKILLS)])
explained = 1 - np.square(mean_action - means[codes]).sum() / np.square(mean_action - mean_action.mean(axis=0)).sum()
checks = pd.DataFrame(
    [
        ("codes in use", health["codes_used"], SKILLS - 1, SKILLS),
        ("perplexity", health["perplexity"], 5, SKILLS),
        ("rmse, as a share of guessing zero", health["reconstruction_rmse"] / guess, 0.3, 0.85),
        ("push explained by the code", explained, 0.4, 0.95),
        ("farthest a skill carries in 50 steps, m", distance.max(), 0.8, 3.5),
        ("codes in use without care", collapsed["val/codes_used"], 1, SKILLS - 2),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. Set `SKILLS = 4`, then 16. How do perplexity, reconstruction and the panels change? Four skills are enough to go
#    anywhere; what are more of them good for?
# 2. `learn(STEPS, decoder="mlp")` replaces diffusion by plain regression. Which one draws the same action twice in the
#    same state? Compare the two on segments that begin at a junction.
# 3. Bring back only one of the two measures (`codebook_init="kmeans"`, or `restart_threshold=0.1`). Which does more?
#
# <details>
# <summary>Answers</summary>
#
# 1. With 4, 8 and 16 skills: perplexity 3.5, 7.1 and 13.8, error of the actions 0.45, 0.40 and 0.37. Four pushes take a
#    ball anywhere, but more of them copy the data more closely: finer directions, and corrections.
# 2. The MLP draws the same action every time; two draws of the diffusion decoder differ by 0.24 on average. The MLP's
#    error is smaller (0.33 against 0.40), because a mean is the best single guess. Where drives part, though, the mean
#    of left and right is a way that nobody took.
# 3. With this seed each is enough by itself: all eight codes stay in use, at perplexity 7.3 with k-means alone and 6.9
#    with restarts alone, against 4 codes and 3.3 with neither.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds skill fit --config pointmaze/skill.yaml --data.task pointmaze-large-diverse \
#     --data.data local:data/pointmaze-large-diverse-v0 --checkpoint.dirpath runs/skill
# ```
#
# Next: [03 · Relabel](03_relabel.ipynb).
