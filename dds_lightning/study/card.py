"""The card of a published agent: what it does, how well, and how it was made, for whoever finds the directory."""

from collections.abc import Mapping
from typing import Any

import pandas as pd

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
        task: where the agent acts.
        episodes: the rollout's table; its first contestant is how the agent acts by default.
        seed: of training and evaluation.
        data: facts about the data, name to value.
        settings: "skill" and "policy" to the parsed settings of their training.
        command: what makes the same agent again.
    """
    table = summary_table(episodes)
    table = table[table["kind"] == CONTESTANT]
    first = table.iloc[0]
    facts = "\n".join(f"- {name}: {value}" for name, value in data.items())
    trained = "\n".join(_training(stage, chosen) for stage, chosen in settings.items())
    what = f"From cell {task.start_cell} to cell {task.goal_cell} of " if task.maze_map is not None else ""
    return f"""# {task.name}: an agent with discrete diffusion skills

{what}{task.env_id}, at most {task.max_episode_steps} steps. **{first["contestant"]}: {first["success"]:.1f} % of
{first["episodes"]} episodes** (95 % interval {first["success_low"]:.1f} to {first["success_high"]:.1f}), normalised
score {first["score"]:.1f}. One training, seed {seed}; the score is of the last checkpoint.

```python
from dds_lightning import DDSAgent, get_task

agent = DDSAgent.load("DIRECTORY")  # this directory; weights by safetensors, settings by YAML, no pickle
env = get_task("{task.name}").make_env()
observation, _ = env.reset(seed=0)
agent.reset(seed=0)
action = agent.act(observation)  # a skill every {settings["skill"]["data"]["horizon"]} steps, an action every step
```

## Scores

{markdown(readable(table))}

## Data

{facts}

## Training

{trained}

`{command}` makes it again. `sha256sum -c SHA256SUMS` checks the files.

## What it cannot do

It knows one maze, one start and one goal: another goal needs a policy of its own (the skills can be used again). The
data were made by a scripted controller of this project; scores are not comparable with those on D4RL's data sets.
"""


def _training(stage: str, chosen: Mapping[str, Any]) -> str:
    model = ", ".join(f"{name} {value}" for name, value in chosen["model"].items() if not name.endswith("_dim"))
    return f"- {stage}: {chosen['trainer']['max_steps']:,} steps, batches of {chosen['data']['batch_size']}; {model}"
