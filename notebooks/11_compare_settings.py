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
# # 11 · Does K matter on my data?
#
# **What you will see:** a question as a file of ten lines, a grid of trainings that all cores work on, a table with
# intervals instead of one lucky number, and what the table does not say.
#
# **Time:** about five minutes on two CPU cores. No network, no GPU, no graphics driver.
#
# A score of one training is an anecdote: with another seed the same settings may do much better or worse. Whoever
# wants to know whether a setting matters trains every value of it with several seeds, and looks at the intervals.

# %%
# %matplotlib inline
from pathlib import Path

import pandas as pd
from IPython.display import Markdown, display
from matplotlib.figure import Figure

from dds_lightning.cli import main
from dds_lightning.grid import figures
from dds_lightning.grid.results import Results
from dds_lightning.study.statistics import interval

# %% tags=["parameters"] quick={"DATA_STEPS": 2000, "SKILL_STEPS": 4, "POLICY_STEPS": 4, "EPISODES": 1, "SEEDS": [0, 1]}
DATA_STEPS = 20_000
SKILL_STEPS = 400
POLICY_STEPS = 1_500
EPISODES = 20
SEEDS = [0, 1, 2]
RUNS = Path("../runs/notebooks/11")  # what this notebook writes lies here

# %% [markdown]
# ## The question as a file
#
# `tasks`, `seeds` and `grid` span the cells. Settings are those of `dds skill fit` and `dds policy fit` with the
# stage in front, so everything that can be set can be asked about. Everything that is not named is the preset's. The
# budgets here are tiny, so that the answer comes within minutes; for your own data add `data: local:FOLDER`.

# %%
RUNS.mkdir(parents=True, exist_ok=True)
study_file = RUNS / "does_k_matter.yaml"
study_file.write_text(
    f"""
title: Does the number of skills matter?
tasks: [pointmaze-umaze-diverse]
seeds: {SEEDS}
settings:
  data.steps: {DATA_STEPS}
  skill.model.hidden_dim: 64
  skill.trainer.max_steps: {SKILL_STEPS}
  policy.trainer.max_steps: {POLICY_STEPS}
  evaluate.episodes: {EPISODES}
grid:
  skill.model.num_skills: [4, 16]
labels: {{skill.model.num_skills: K}}
"""
)
main(["study", "run", str(study_file), "--out", str(RUNS), "--plan"])
# %% [markdown]
# The plan shows what is shared: one data set serves all cells. A piece of work is named by the hash of its settings
# and of what it reads; whatever two cells have in common is done once, also across study files in the same folder.
#
# ## Run it
#
# On a terminal this is `dds study run does_k_matter.yaml`. Stop it at any time: what is finished is kept, and a
# training goes on from its last checkpoint. On a cluster, add `--engine ray` or `--engine slurm`.

# %%
status = main(["study", "run", str(study_file), "--out", str(RUNS)])

# %% [markdown]
# The same command again finds everything done:

# %%
again = main(["study", "run", str(study_file), "--out", str(RUNS)])

# %% [markdown]
# ## The table, with intervals
#
# The first table is what papers print: mean ± standard deviation over seeds. The second holds the interquartile mean
# (the mean of the middle half, which one lucky or unlucky seed does not move much) with its 95 % interval, and the
# probability that a training with the second K beats one with the first.

# %%
results = Results.read(RUNS / study_file.stem)
table, comparison = results.table(), results.comparison()
display(table.style.hide(axis="index"))
display(comparison.style.hide(axis="index").format(precision=2, na_rep="–"))
figures.plot_intervals(comparison)

# %% [markdown]
# The same without any summary: for every threshold, the share of trainings that score above it. Where one line lies
# above the other everywhere, its setting is better whatever one asks for; where they cross, it depends.

# %%
figures.plot_profiles(results.groups())

# %% [markdown]
# **How to read it.** If the intervals overlap, this study cannot tell the two apart: that is not the same as "K does
# not matter". Look at the probability, too: 0.5 is a coin, and its interval says how sure that is.
#
# ## Would more seeds help?
#
# An interval shrinks with the number of seeds, roughly with its square root. Take the results of our seeds again and
# again, at random and some of them twice (a bootstrap): that shows how wide the interval would be with more seeds, if
# they scattered as these do.

# %%
first = next(iter(results.groups().values()))
widths = []
for count in (3, 5, 10, 20):
    more = pd.concat([first] * -(-count // len(first))).to_numpy()[:count]
    found = interval(more)
    widths.append({"seeds": count, "width": found.high - found.low})
widths = pd.DataFrame(widths)
figure = Figure(figsize=(6.4, 2.6), layout="constrained")
ax = figure.add_subplot()
ax.plot(widths["seeds"], widths["width"], "o-")
ax.set(xlabel="seeds", ylabel="width of the interval", xticks=widths["seeds"], ylim=(0, None))
ax.spines[["top", "right"]].set_visible(False)
figure

# %% [markdown]
# ## The page to keep
#
# `dds study report` wrote one page with tables, figures, times, versions and the command behind every number, and the
# same as Markdown. Its beginning:

# %%
page = RUNS / study_file.stem / "report" / "report.md"
display(Markdown("\n".join(page.read_text().split("## Is it real?")[0].splitlines()[:14]).replace("# ", "#### ")))

# %% [markdown]
# ## What you should see

# %% tags=["check"]
inside = comparison["IQM"].between(comparison["low"], comparison["high"]).mean()
checks = pd.DataFrame(
    [
        ("exit status of both runs", status + again, 0, 0),
        ("cells done", (results.cells["state"] == "done").sum(), 2 * len(SEEDS), 2 * len(SEEDS)),
        ("score with 16 skills", results.cells.query("`skill.model.num_skills` == 16")["score"].mean(), 60, 100),
        ("interquartile means inside their intervals, share", inside, 1, 1),
        ("width with 20 seeds, in widths with 3", widths["width"].iloc[-1] / widths["width"].iloc[0], 0.2, 0.8),
        ("size of the page, kB", page.with_name("index.html").stat().st_size / 1e3, 20, 500),
    ],
    columns=["what", "found", "at least", "at most"],
)
checks["fine"] = checks["found"].between(checks["at least"], checks["at most"])
assert checks["fine"].all(), checks
checks.round(2)

# %% [markdown]
# ## Exercises
#
# 1. What would the study do again if you set `evaluate.episodes: 50`? Guess, then ask with `--plan`.
# 2. Add a line `variants: {noiseless: {evaluate.noise_scale: 0}}`: does the decoder's noise matter? How many trainings
#    does the answer cost?
# 3. Which question would you need other data for?
#
# <details>
# <summary>Answers</summary>
#
# 1. The six evaluations and nothing else: no training reads how many episodes will be played.
# 2. None. The grid has twelve cells then, but the noise belongs to acting, so what is new are six evaluations.
# 3. Whether more data help, or data of another driver (where data are collected, `data.steps` and `data.seed` are
#    settings, too). And every question about your own robot: the best K of a maze is not that of a leg.
#
# </details>
#
# ## The same at full size
#
# ```bash
# dds study run table2 --plan        # the paper's table 2 on PointMaze-Large: K and D, three seeds
# dds study run table2 --workers 2   # about two minutes of one core for each of its 48 cells
# ```
