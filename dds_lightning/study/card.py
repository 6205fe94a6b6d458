"""The card of a published agent: what it does, how well, and how it was trained."""

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from dds_lightning.study.diagnosis import diagnose
from dds_lightning.study.findings import Findings
from dds_lightning.study.page import diagnosis_section, headline
from dds_lightning.study.protocol import paper_line
from dds_lightning.study.tables import CONTESTANT, markdown, readable, summary_table
from dds_lightning.tasks import Task


def agent_card(
    task: Task,
    episodes: pd.DataFrame,
    *,
    seed: int,
    data: Mapping[str, Any],
    settings: Mapping[str, Mapping[str, Any]],
    command: str,
) -> str:
    """Write the card.

    Args:
        task: Where the agent acts.
        episodes: The rollout's table; its first contestant is the agent as it acts by default.
        seed: Seed of training and evaluation.
        data: Facts about the data, name to value; "source" is where they come from, as `--data` takes it, or a
            sentence that begins with "collected" if they were collected for this agent.
        settings: "skill" and "policy" -> the parsed settings of their training.
        command: The command that trained it.
    """
    table = summary_table(episodes)
    table = table[table["kind"] == CONTESTANT]
    first = table.iloc[0]
    facts = "\n".join(f"- {name}: {value}" for name, value in data.items())
    trained = "\n".join(_training(stage, chosen) for stage, chosen in settings.items())
    return f"""# {task.name}: an agent with discrete diffusion skills

{_opening(first, task)} One training, seed {seed}; the score is of the last checkpoint.

```python
from dds_lightning import DDSAgent, get_task

agent = DDSAgent.load("DIRECTORY")  # this directory; weights by safetensors, settings by YAML, no pickle
env = get_task("{task.name}").make_env()
observation, _ = env.reset(seed=0)
agent.reset(seed=0)
action = agent.act(observation)  # a skill every {settings["skill"]["data"]["horizon"]} steps, an action every step
```

## Scores

{markdown(readable(table, task))}{_paper(task)}

## Data

{facts}

## Training

{trained}

`{command}` made it. Presets change between versions: what this agent was trained with is what stands above.
`sha256sum -c SHA256SUMS` checks the files.

## What it cannot do

{textwrap.fill(f"{_limits(task)} {_provenance(str(data.get('source', '')), task)}", 120, break_on_hyphens=False)}
"""


def with_diagnosis(card: str, run: Path) -> str:
    """Insert the section on where the run loses into a card, before the data.

    Args:
        card: As `agent_card` wrote it.
        run: The run directory, its report included.
    """
    measured = {stage: run / "report" / f"{stage}_metrics.csv" for stage in ("skill", "policy")}
    logs = {stage: path for stage, path in measured.items() if path.is_file()}
    section = diagnosis_section(diagnose(Findings.read(run), logs))
    head, heading, rest = card.partition("## Data\n")
    return f"{head}{section}\n\n{heading}{rest}" if heading else f"{card.rstrip()}\n\n{section}\n"


def _opening(first: pd.Series, task: Task) -> str:
    where = f"{task.env_id}, at most {task.max_episode_steps} steps."
    if task.maze_map is None:
        return f"{where} {headline(first, task)}."
    return (
        f"From cell {task.start_cell} to cell {task.goal_cell} of {where} "
        f"**{first['contestant']}: {first['success']:.1f} % of\n{first['episodes']} episodes** (95 % interval "
        f"{first['success_low']:.1f} to {first['success_high']:.1f}), normalised\nscore {first['score']:.1f}."
    )


def _paper(task: Task) -> str:
    line = paper_line(task)
    return f"\n\n{line}" if line else ""


def _limits(task: Task) -> str:
    """Return what the agent was not trained for."""
    if task.maze_map is not None:
        return (
            "It knows one maze, one start and one goal: another goal needs another policy (the skills can be reused)."
        )
    if task.subtasks:
        return (
            f"It knows one kitchen and {len(task.subtasks)} subtasks ({', '.join(task.subtasks)}): others need "
            "another policy (the skills can be reused)."
        )
    return (
        "It knows one body in one physics and moves as its data do: another body or another aim needs other data and "
        "another training."
    )


def _provenance(source: str, task: Task) -> str:
    """Return where the data came from, and what the scores may be compared with."""
    if source.startswith("collected"):
        return "The data come from this project's controllers: scores are not comparable with those on D4RL's own data."
    if source.startswith("d4rl:"):
        return (
            f"The data are a file in D4RL's layout ({source}): compare scores only with others on that same file, and "
            f"mind the environment that they were played in, {task.env_id}."
        )
    return (
        f"The data were provided by the user who trained it ({source}): compare scores only with others on the same "
        "data, and not with those on D4RL's data sets."
    )


def _training(stage: str, chosen: Mapping[str, Any]) -> str:
    model = ", ".join(f"{name} {value}" for name, value in chosen["model"].items() if not name.endswith("_dim"))
    trainer, passes = chosen["trainer"], chosen["trainer"].get("max_epochs") or -1
    limit = f" or {passes} passes over the data, what comes first" if passes > 0 else ""
    return f"- {stage}: {trainer['max_steps']:,} steps{limit}, batches of {chosen['data']['batch_size']}; {model}"
