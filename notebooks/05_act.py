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
# # 05 · Act and evaluate in MuJoCo (video)
#
# **What you will see:** noise turning into an action in five steps, the clock that changes skills, a Hopper and an Ant
# on video, one agent acting in seven ways, with confidence intervals, what the evaluation counts and why, how long one
# action takes, and where the Ant fails.
#
# **Time:** about two minutes on two CPU cores. No network, no GPU. With a graphics driver MuJoCo renders the Hopper's
# video; without one it is a stick figure.
#
# Nothing is trained here: three agents that ship with the package act.

# %%
# %matplotlib inline
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from IPython.display import Image, display
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image as Picture
from PIL import ImageDraw

from dds_lightning import DDSAgent, get_task
from dds_lightning.cli import main
from dds_lightning.interpret.draw.drawing import draw_walls
from dds_lightning.interpret.draw.gif import CachedBackground, gif_bytes
from dds_lightning.interpret.draw.maze import choose_episodes, plot_failures, plot_trajectories
from dds_lightning.interpret.draw.palette import skill_colour
from dds_lightning.interpret.draw.rendering import render_frames
from dds_lightning.interpret.draw.stitching import draw_timeline
from dds_lightning.interpret.draw.strobe import body_clip, plot_strobes
from dds_lightning.interpret.measure.body import body_frames
from dds_lightning.interpret.measure.replay import simulator
from dds_lightning.interpret.measure.states import body_states
from dds_lightning.rollout import Contestant, RolloutResult, rollout
from dds_lightning.study.tables import readable, summary_table, wilson

# %% tags=["parameters"] quick={"EPISODES": 2, "CAP": 40, "RUN": 60, "REPEATS": 2, "RENDER": false}
CHECKPOINTS = Path("../checkpoints")
EPISODES = 12  # of each way of acting
CAP = 700  # most steps of an Ant's episode, as its task has it
RUN = 1_000  # steps of the Hopper
REPEATS = 60  # of each timing
RENDER = True  # False: stick figures everywhere
RUNS = Path("../runs/notebooks/05")  # what this notebook writes lies here

# %% [markdown]
# ## Three agents
#
# A ball in a maze, an Ant in a maze, and a leg that hops. Observations and actions differ; the parts of the agent are
# the same.

# %%
RUNS.mkdir(parents=True, exist_ok=True)
torch.set_num_threads(1)  # small networks: a second thread costs more than it brings
tasks = {
    "pointmaze-large": get_task("pointmaze-large-diverse"),
    "antmaze-umaze-diverse": get_task("antmaze-umaze-diverse"),
    "hopper-medium-expert": get_task("hopper-medium-expert"),
}
agents = {name: DDSAgent.load(CHECKPOINTS / name, seed=0) for name in tasks}
pd.DataFrame(
    [
        {
            "checkpoint": name,
            "environment": tasks[name].env_id,
            "observations": agent.observation_dim,
            "actions": agent.action_dim,
            "skills": agent.num_skills,
            "H": agent.horizon,
            "a step is": f"{1000 * tasks[name].step_seconds:g} ms",
            "chooses": agent.selection,
        }
        for name, agent in agents.items()
    ]
)

# %% [markdown]
# ## One action: from noise in five steps
#
# Every $H$ steps the policy picks a skill $k$, and the codebook turns it into a vector $z_k$. Then, at *every* step,
# the decoder generates an action (section 4.4 of the paper): it draws Gaussian noise $x_5$ and removes part of it five
# times. The network $\epsilon_\psi$ predicts which part of $x_t$ is noise, given the state and the skill; this gives an
# estimate of the clean action,
#
# $$\hat x_0 = \frac{x_t - \sqrt{1 - \bar\alpha_t}\; \epsilon_\psi(x_t, t, s, z_k)}{\sqrt{\bar\alpha_t}}$$
#
# which is clipped to the box $[-1, 1]$. The next $x_{t-1}$ lies between $x_t$ and this estimate, with a little fresh
# noise (the posterior of DDPM); the last estimate is the action. Here is the whole loop, written out:


# %%
def denoise(decoder, noise, states, skills):
    """Every x on the way from noise to action.

    Args:
        decoder: of a skill model.
        noise: (5, B, A), the first is x_5, the others are fresh.
        states: (B, O), normalised.
        skills: (B, D) vectors of the codebook.
    """
    way = [noise[0]]
    for t in range(decoder.diffusion_steps, 0, -1):
        x, i = way[-1], t - 1
        epsilon = decoder.predict_noise(x, torch.full((len(x),), i), states, skills)
        alpha = decoder.alpha_bars[i]
        guess = ((x - (1 - alpha).sqrt() * epsilon) / alpha.sqrt()).clamp(-1, 1)
        if t > 1:
            beta, before = decoder.betas[i], decoder.alpha_bars[i - 1]
            mean = (before.sqrt() * beta * guess + (1 - beta).sqrt() * (1 - before) * x) / (1 - alpha)
            fresh = noise[decoder.diffusion_steps - i]
            way.append(mean + (beta * (1 - before) / (1 - alpha)).sqrt() * fresh)
    return [*way, guess]


# %% [markdown]
# An action of the ball is a force with two components, so it can be drawn. The ball stands at the start. We take the
# policy's likeliest skill there and the one that pushes most differently, and let both begin with the *same* 400 draws
# of noise. The black rings follow one of these draws under both skills.

# %%
ball, maze = agents["pointmaze-large"], tasks["pointmaze-large"]
observation, info = maze.make_env().reset(seed=0)
with torch.inference_mode():
    likeliest = int(ball.policy.codes(torch.from_numpy(observation)[None], "greedy"))
    everyone = torch.arange(ball.num_skills)
    pushes = ball.skill.decode(torch.from_numpy(np.tile(observation, (len(everyone), 1))), everyone, noise_scale=0.0)
    two = [likeliest, int((pushes - pushes[likeliest]).norm(dim=1).argmax())]
    decoder, states = ball.skill.decoder, torch.from_numpy(np.tile(observation, (400, 1)))
    noise = torch.randn(ball.skill.draws, 400, ball.action_dim, generator=torch.Generator().manual_seed(0))
    clouds, apart = {}, 0.0
    for code in two:
        codes = torch.full((400,), code)
        clouds[code] = denoise(decoder, noise, ball.skill.normaliser(states), ball.skill.bottleneck.lookup(codes))
        library = ball.skill.decode_from(states, codes, noise)
        apart = max(apart, float((ball.skill.action_box.from_unit(clouds[code][-1]) - library).abs().max()))
print(f"by hand and by the library: at most {apart:.1g} apart")

figure = Figure(figsize=(8.0, 5.3), layout="constrained")
panels = figure.subplots(2, 3, sharex=True, sharey=True)
for t, ax in zip(range(5, -1, -1), panels.flat, strict=True):
    for code in two:
        ax.scatter(*clouds[code][5 - t].T, s=6, color=skill_colour(code), alpha=0.5, label=f"skill {code}")
        ax.plot(*clouds[code][5 - t][0], "o", markersize=9, markerfacecolor="none", markeredgecolor="black")
    ax.plot([-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1], color="grey", linewidth=0.8)
    kept = 1.0 if t == 0 else float(decoder.alpha_bars[t - 1])
    title = {5: "noise $x_5$", 0: "action $x_0$"}.get(t, f"$x_{t}$")
    ax.set_title(f"{title},  $\\bar\\alpha$ = {kept:.2g}", fontsize=11)
    ax.set(xlim=(-2.6, 2.6), ylim=(-2.6, 2.6), aspect="equal")
    ax.spines[["top", "right"]].set_visible(False)
panels[1, 2].legend(loc="upper left", fontsize=10, markerscale=2, frameon=False)
for ax in panels[1]:
    ax.set_xlabel("force along x")
for ax in panels[:, 0]:
    ax.set_ylabel("force along y")
figure

# %% [markdown]
# $\bar\alpha_t$ is the share of the action in $x_t$: almost nothing at first (both skills begin with the same cloud),
# all of it at the end. The grey square is the box of allowed actions. One cloud of noise, two skills, two pushes, each
# with some width: the decoder has learnt a *distribution*, as wide as the data were in such states.
#
# The **noise scale** multiplies every draw. With 0 the decoder always starts in the middle and returns the same action;
# with 1 it reproduces the spread of the data.

# %%
figure = Figure(figsize=(8.0, 2.6), layout="constrained")
for scale, ax in zip((0.0, 0.5, 1.0), figure.subplots(1, 3, sharex=True, sharey=True), strict=True):
    for code in two:
        with torch.inference_mode():
            actions = ball.skill.decode_from(states, torch.full((400,), code), scale * noise).numpy()
        ax.scatter(*actions.T, s=12 if scale == 0 else 4, color=skill_colour(code), alpha=0.6, label=f"skill {code}")
    ax.plot([-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1], color="grey", linewidth=0.8)
    ax.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", title=f"noise scale {scale:g}", xlabel="force along x")
    ax.spines[["top", "right"]].set_visible(False)
figure.axes[0].set_ylabel("force along y")
figure.axes[0].legend(fontsize=9, frameon=False, loc="center", markerscale=1.5)
figure

# %% [markdown]
# ## When the skill changes
#
# The agent keeps a clock for each environment. It chooses at the first step and then every $H = 10$, whatever happens
# in between. When an environment begins a new episode, the agent is informed (`restarted`), and only *that* clock is
# reset. Below, three mazes side by side; the second one is reset after 17 steps.

# %%
envs = [maze.make_env() for _ in range(3)]
seen = np.stack([env.reset(seed=number)[0] for number, env in enumerate(envs)])
ball.reset(num_envs=3, seed=0)
restarted = np.zeros(3, bool)
used, chosen = [], []
for step in range(50):
    actions = ball.act(seen, restarted)
    used.append(ball.codes)
    chosen += [(step, number) for number in np.flatnonzero(ball.decided)]
    seen = np.stack([env.step(action)[0] for env, action in zip(envs, actions, strict=True)])
    restarted[:] = False
    if step == 16:
        seen[1], restarted[1] = envs[1].reset(seed=9)[0], True

figure = Figure(figsize=(8.0, 2.1), layout="constrained")
ax = figure.add_subplot()
draw_timeline(ax, list(np.stack(used).T), ["maze 0", "maze 1", "maze 2"])
for step, number in chosen:
    ax.plot([step, step], [number - 0.45, number + 0.45], color="black", linewidth=1.5)
ax.set_title("the skill in use; a black line where the policy was asked", fontsize=10)
figure

# %% [markdown]
# ## The Hopper runs
#
# This is the loop that any robot needs. Here it also records the simulator's state for drawing.

# %%
hopper, leg = agents["hopper-medium-expert"], tasks["hopper-medium-expert"]
env = leg.make_env()
observation, info = env.reset(seed=0)
hopper.reset(num_envs=1, seed=0)
rewards, codes, actions, qpos = [], [], [], [env.unwrapped.data.qpos.copy()]
terminated = truncated = False
while len(codes) < RUN and not (terminated or truncated):
    action = hopper.act(observation)
    observation, reward, terminated, truncated, info = env.step(action)
    rewards.append(reward)
    codes.append(hopper.codes[0])
    actions.append(action)
    qpos.append(env.unwrapped.data.qpos.copy())
qpos, codes, actions = np.stack(qpos), np.array(codes), np.stack(actions)
score = float(leg.normalised_score(sum(rewards)))
print(f"{len(codes)} steps, {qpos[-1, 0]:.1f} m, return {sum(rewards):.0f}, normalised score {score:.1f}")

# %% [markdown]
# The score is D4RL's: $100 \cdot (R - R_{min}) / (R_{max} - R_{min})$, where 0 is a random policy and 100 an expert.
# The three torques below oscillate with the hops; the colours behind them are the skills, which change *within* a hop.

# %%
first = len(codes) // 4  # well under way
shown = slice(first, first + 160)
figure = Figure(figsize=(9.5, 3.4), layout="constrained")
upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 0.22])
for number, (joint, colour) in enumerate((("thigh", "black"), ("leg", "#2779d2"), ("foot", "#d0271a"))):
    upper.plot(actions[shown, number], linewidth=1.4, label=joint, color=colour)
for step, code in enumerate(codes[shown]):
    upper.axvspan(step, step + 1, color=skill_colour(int(code)), alpha=0.18, linewidth=0)
upper.set(ylabel="torque", ylim=(-1.1, 1.5))
upper.legend(ncols=3, loc="upper right", fontsize=9, frameon=False)
upper.spines[["top", "right"]].set_visible(False)
draw_timeline(lower, [codes[shown]], ["skill"])
lower.set_xlabel(f"steps of 8 ms after step {first}")
figure

# %% [markdown]
# What each skill did the first time it was chosen after that, drawn from the positions of the limbs:

# %%
H = hopper.horizon
pieces = {}
with simulator(leg) as inside:
    for start in range(-(-first // H) * H, len(codes) - H + 1, H):
        if int(codes[start]) not in pieces and len(pieces) < 4:
            piece = qpos[start : start + H + 1].copy()
            piece[:, 0] -= piece[0, 0]  # each from x = 0
            pieces[int(codes[start])] = body_frames(inside.unwrapped.model, piece)
plot_strobes(leg, pieces, every=5, title="Hopper: ten steps (80 ms) of each skill, a body every five")

# %% [markdown]
# And the video, at half speed. The strip below shows the skill in use over the whole clip.


# %%
def film(task, qpos, codes, every, fps=15):
    """A piece of an episode as a GIF, rendered by MuJoCo where that is possible: (bytes, whether it is)."""
    moments = range(0, len(codes), every)
    pictures = render_frames(task, qpos[moments], width=240, height=180) if RENDER else None
    if pictures is None:
        with simulator(task) as inside:
            body = body_frames(inside.unwrapped.model, qpos)
        return body_clip(task, body, int(np.bincount(codes).argmax()), frames=len(moments), fps=fps), False
    frames = []
    for picture, now in zip(pictures, moments, strict=True):
        frame = Picture.new("RGB", (240, 196))
        frame.paste(Picture.fromarray(picture))
        pen = ImageDraw.Draw(frame)
        for pixel in range(240):
            code = int(codes[pixel * len(codes) // 240])
            pen.line((pixel, 180, pixel, 196), fill=skill_colour(code))
        cursor = now * 240 // len(codes)
        pen.rectangle((cursor - 1, 180, cursor + 1, 196), fill="white", outline="black")
        pen.text((4, 4), f"skill {codes[now]}   {now * task.step_seconds:.2f} s", fill="white")
        frames.append(np.asarray(frame))
    return gif_bytes(frames, fps, colours=96), True


clip, rendered = film(leg, qpos[first : first + 241], codes[first : first + 240], every=4)
(RUNS / "hopper.gif").write_bytes(clip)
print("rendered by MuJoCo" if rendered else "no graphics driver: the same moments as a stick figure of one colour")
Image(data=clip, format="png")  # a GIF all the same: pages that know only "png" then play it too

# %% [markdown]
# ## The Ant in seven ways
#
# One set of networks can act in several ways:
#
# | way | skill | action |
# | --- | --- | --- |
# | greedy | the likeliest, $\arg\max_k \pi(k \mid s)$ | drawn |
# | sampled | drawn from $\pi$ | drawn |
# | temperature 0.5 | drawn from $\pi^{1/0.5}$, renormalised: nearer to greedy | drawn |
# | noise 0.5, no noise | the likeliest | drawn with half of the noise, or none |
# | argmax-Q | the best by the critic, $\arg\max_k Q(s, k)$ | drawn |
# | random | any | drawn |
#
# What temperature does to one choice, in the state in which the Ant starts:

# %%
ant, yard = agents["antmaze-umaze-diverse"], replace(tasks["antmaze-umaze-diverse"], max_episode_steps=CAP)
start = torch.from_numpy(yard.make_env().reset(seed=0)[0])[None]
with torch.inference_mode():
    logits = ant.policy.logits(start)[0]
figure = Figure(figsize=(8.5, 2.0), layout="constrained")
for temperature, ax in zip((0.5, 1.0, 2.0), figure.subplots(1, 3, sharey=True), strict=True):
    chances = (logits / temperature).softmax(dim=-1).numpy()
    ax.bar(range(len(chances)), chances, color=[skill_colour(code) for code in range(len(chances))])
    ax.set(title=f"temperature {temperature:g}", xlabel="skill", xticks=range(0, 16, 3), ylim=(0, 1))
    ax.spines[["top", "right"]].set_visible(False)
figure.axes[0].set_ylabel("probability")
figure

# %% [markdown]
# Now each way plays the same twelve starts. The picture is redrawn whenever one has finished. A dot is the share of
# successes, and the line its 95 % interval (Wilson's): with so few episodes it is long, and two ways whose lines
# overlap as much as those of the first five *cannot* be distinguished.

# %%
ways = {
    "greedy": ant.variant("greedy"),
    "sampled": ant.variant("sample"),
    "sampled, temperature 0.5": ant.variant("sample", temperature=0.5),
    "greedy, noise 0.5": ant.variant("greedy", noise_scale=0.5),
    "greedy, no noise": ant.variant("greedy", noise_scale=0.0),
    "argmax-Q": ant.variant("argmax_q"),
    "random skills": ant.variant("random"),
}


def draw_intervals(episodes):
    """Success of each contestant so far, with its interval."""
    figure = Figure(figsize=(7.5, 2.6), layout="constrained")
    ax = figure.add_subplot()
    for place, (_, part) in enumerate(episodes.groupby("actor", sort=False)):
        wins, count = int(part["success"].sum()), len(part)
        low, high = wilson(wins, count)
        ax.plot([100 * low, 100 * high], [place, place], color="#2779d2", linewidth=2)
        ax.plot(100 * wins / count, place, "o", color="#2779d2", clip_on=False, zorder=5)
        ax.annotate(f"{wins} of {count}", (102, place), va="center", fontsize=9, annotation_clip=False)
    ax.set_yticks(range(len(ways)), list(ways))
    ax.set(xlim=(0, 100), ylim=(len(ways) - 0.5, -0.5), xlabel="success, % (95 % interval)")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


handle = display(Figure(figsize=(7.5, 2.6)), display_id=True)
played = []
for name, actor in ways.items():
    contestant = Contestant(name, actor, EPISODES)
    played.append(rollout(yard, [contestant], seed=3, workers=0, record=True, record_observations=True))
    handle.update(draw_intervals(pd.concat([one.episodes for one in played])))
episodes = pd.concat([one.episodes for one in played], ignore_index=True)
result = RolloutResult(yard.name, episodes, {key: path for one in played for key, path in one.paths.items()})

# %%
summary = summary_table(episodes)
readable(summary, yard)

# %% [markdown]
# ## What is counted, and why
#
# One row of the evaluator's table is one episode:

# %%
columns = ["actor", "episode", "seed", "return", "score", "success", "terminated", "length", "final_code"]
some = episodes[episodes["actor"] == "argmax-Q"].head(4)
some[columns].assign(decisions=some["codes"].map(len))

# %% [markdown]
# * **success**: the goal was reached at *any* step. In a maze that ends the episode at once (`terminated`), so one
#   episode counts once, and time spent at the goal earns nothing. Runners have no goal, so the value is missing, not
#   false.
# * **score**: computed from the *environment's* rewards, never from the scaled ones that the learner sees. In a maze
#   the return is 1 or 0, so score and success are the same number.
# * **length**: steps. A failure lasts to the cap, so the mean length mixes two things; look at that of the successes.
# * **seed**: episode $i$ has the same seed for every contestant, so differences cannot come from the starts.
# * **how many**: everybody plays a number of episodes that is fixed *in advance*. The classic mistake is to run many
#   environments side by side and stop when enough episodes are over: successes end early and failures late, so the
#   finished ones are mostly successes. What that would have reported here, had we stopped half-way:

# %%
rows = []
for name, part in episodes.groupby("actor", sort=False):
    half = part.nsmallest(max(len(part) // 2, 1), "length")
    everything, early = (100 * float(some["success"].mean()) for some in (part, half))
    rows.append({"way": name, "all episodes, %": everything, "the first half to end, %": early})
stopped = pd.DataFrame(rows).set_index("way")
stopped.round(0)

# %% [markdown]
# ## The Ant on its way
#
# Its paths to the goal, coloured by skill:

# %%
plot_trajectories(yard, result, "greedy")

# %% [markdown]
# And one of them step by step, from above, drawn without any driver: the limbs are where the simulator's model has
# them, in the colour of the skill.


# %%
def walk(task, body, codes, every, fps=15):
    """An Ant's episode as a GIF: walls, trail and limbs in the colour of the skill in use."""
    figure = Figure(figsize=(4.0, 4.0), dpi=80, layout="constrained")
    ax = figure.add_subplot()
    draw_walls(ax, task)
    low, high = body.root[:, :2].min(axis=0) - 2.5, body.root[:, :2].max(axis=0) + 2.5
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=" ", ylabel="", xticks=[], yticks=[])
    caption = figure.text(0.02, 0.015, "", fontsize=10, family="monospace")
    trail = ax.add_collection(LineCollection([], linewidths=2))
    limbs = ax.add_collection(LineCollection([], linewidths=5, capstyle="round", zorder=6))
    background = CachedBackground(figure, (trail, limbs, caption))
    colours = [skill_colour(int(code)) for code in codes]
    pieces = np.stack([body.root[:-1, :2], body.root[1:, :2]], axis=1)
    frames = []
    for now in range(0, len(codes), every):
        trail.set(segments=list(pieces[:now]), color=colours[: max(now, 1)])
        limbs.set(segments=list(body.limbs[now][:, :, :2]), color=colours[now])
        caption.set_text(f"skill {codes[now]:2d}   {now * task.step_seconds:4.1f} s")
        frames.append(background.frame())
    return gif_bytes(frames, fps)


number = choose_episodes(result, "greedy")[0]  # of median length
path = result.paths["greedy", number]
with simulator(yard) as inside:
    body = body_frames(inside.unwrapped.model, body_states(yard, path.observations).qpos)
clip = walk(yard, body, path.codes, every=3)
(RUNS / "ant.gif").write_bytes(clip)
Image(data=clip, format="png")

# %% [markdown]
# ## What goes wrong
#
# Averages hide the causes, so look at the failures one by one. The recorded observations show how each ended: on its
# back (the torso's own z axis points down), pressed against something (less than half a metre in the last 100 steps),
# or still on its way.

# %%
rows = []
for row in episodes[~episodes["success"].astype(bool)].itertuples():
    states = result.paths[row.actor, row.episode].observations
    x, y = states[-1, 4:6]  # of the quaternion (w, x, y, z)
    lies = 1 - 2 * (x**2 + y**2) < 0
    crept = np.linalg.norm(states[-1, :2] - states[-101:, :2], axis=1).max() < 0.5
    rows.append({"way": row.actor, "end": "on its back" if lies else "stuck" if crept else "on its way"})
failures = pd.DataFrame(rows, columns=["way", "end"])
kinds = ["on its back", "stuck", "on its way"]
pd.crosstab(failures["way"], failures["end"]).reindex(index=list(ways), columns=kinds, fill_value=0)

# %%
plot_failures(yard, result, "argmax-Q")

# %% [markdown]
# Argmax-Q finds the way as well as the others, and then mostly ends *beside* the goal. As in D4RL, each episode draws
# its own goal from the outlined area, and the agent does not know where it is: it has to search. The policy imitates
# how the data search; the critic's maximum prefers skills that hardly occur there in the data (notebook 04). Random
# skills hardly ever get that far.

# %% [markdown]
# ## How long does one action take?
#
# A robot cannot wait. Each point is the processor time of one call of `act`, the minimum of 60, on one thread
# (other processes are not counted); the dashed line is the duration of one step of that robot. An action costs five
# passes through a small network, whatever the robot; 64 robots at once cost about four to six times as much as one.

# %%
sizes = (1, 4, 16, 64)
rows = []
for name, agent in agents.items():
    observation = tasks[name].make_env().reset(seed=0)[0]
    for size in sizes:
        agent.reset(num_envs=size, seed=0)
        seconds = []
        for _ in range(REPEATS):
            began = time.process_time()
            agent.act(np.tile(observation, (size, 1)))
            seconds.append(time.process_time() - began)
        rows.append({"agent": name, "robots": size, "ms": 1000 * min(seconds)})
times = pd.DataFrame(rows).pivot(index="agent", columns="robots", values="ms").loc[list(agents)]
times.insert(0, "a step is, ms", [1000 * tasks[name].step_seconds for name in agents])
figure = Figure(figsize=(6.5, 2.9), layout="constrained")
ax = figure.add_subplot()
for name, colour in zip(agents, ("#10a06f", "#2779d2", "#d0271a"), strict=True):
    ax.plot(sizes, times.loc[name, list(sizes)], "o-", color=colour, label=name)
    ax.axhline(times.loc[name, "a step is, ms"], color=colour, linestyle="--", linewidth=1)
ax.set(xscale="log", yscale="log", xlabel="robots at once", ylabel="ms for one act", xticks=sizes, xticklabels=sizes)
ax.minorticks_off()
ax.set_yticks([1, 2, 5, 10, 20, 50, 100], [1, 2, 5, 10, 20, 50, 100])
ax.legend(fontsize=9, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
ax.spines[["top", "right"]].set_visible(False)
figure

# %%
times.round(1)

# %% [markdown]
# ## The same from the command line
#
# `dds evaluate` is this evaluation as one command: contestants, seeds, table.

# %%
status = main(["evaluate", str(CHECKPOINTS / "pointmaze-large"), "--episodes", str(EPISODES), "--workers", "0"])

# %% [markdown]
# ## What you should see

# %% tags=["check"]
found = summary.set_index("contestant")["success"]
gaps = np.diff([step for step, number in chosen if number == 0])
centres = [clouds[code][-1].mean(dim=0) for code in two]
checks = pd.DataFrame(
    [
        ("the loop by hand against the library", apart, 0, 1e-5),
        ("how far apart two skills push", float((centres[0] - centres[1]).norm()), 0.2, 2.8),
        ("steps between two decisions, least and most differ by", np.ptp(gaps), 0, 0),
        ("normalised score of the Hopper's run", score, 85, 112),
        ("success of the Ant, greedy, %", found["greedy"], 70, 100),
        ("success of the Ant, sampled, %", found["sampled"], 70, 100),
        ("success of random skills, %", found["random skills"], 0, 35),
        ("too much success if one stops at half, %, argmax-Q", np.diff(stopped.loc["argmax-Q"])[0], 1, 100),
        ("ms for one act of the Hopper's agent", times.loc["hopper-medium-expert", 1], 0, 50),
        ("exit status of `dds evaluate`", status, 0, 0),
        ("size of the last clip, kB", len(clip) / 1e3, 20, 900),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. Now and then the Hopper falls. Find a seed with which it does, and film the 200 steps before the fall.
# 2. Stop the denoising loop early: what would the action be if the *first* guess of $\hat x_0$ were taken, after one
#    pass instead of five? Draw the clouds of the guesses.
# 3. How many episodes does it take to distinguish 90 % from 95 %? Work it out with `wilson`, then look at the tables of
#    papers.
#
# <details>
# <summary>Answers</summary>
#
# 1. With the loop above, seed 3: it falls after 494 steps. Of 60 episodes of `rollout` with seed 0, six end in a fall.
# 2. The first guess already points the right way, but its cloud is wider: for the likeliest skill the standard
#    deviation along x is 0.08 instead of 0.02, along y 0.18 instead of 0.12, and a single action still changes by 0.2
#    (root mean square) in the passes that follow.
# 3. More than 400 of each: with 400 episodes the intervals of 90 % (86.7 to 92.6) and 95 % (92.4 to 96.7) still
#    overlap, with 450 they no longer do. Tables of papers usually rest on 100 episodes or fewer.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds evaluate checkpoints/antmaze-umaze-diverse --episodes 100 --selection '[greedy, sample, argmax_q, random]'
# dds evaluate checkpoints/antmaze-umaze-diverse --episodes 100 --selection '[greedy]' --noise_scale 0
# dds evaluate checkpoints/hopper-medium-expert --out runs/hopper.parquet
# ```
#
# Next: [06 · Look at the skills](06_look_at_skills.ipynb).
