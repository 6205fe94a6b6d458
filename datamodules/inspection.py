"""Looking at data sets: what `dds data check`, `show` and `list` print."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from datamodules.sources import load_trajectories
from datamodules.sources.minari import minari_root, read_metadata
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task


def check_dataset(spec: str, task: Task | str | None = None, *, horizon: int | None = None) -> dict[str, Any]:
    """Read a data set from end to end, refuse it if anything is wrong, else say what is in it.

    Args:
        spec: As in `load_trajectories`.
        task: The task that it must fit, if any; in mazes rewards are then those of the task's goal.
        horizon: H; if given, also count segments, and refuse data whose episodes are all shorter.

    Returns:
        The facts of `describe`.

    Raises:
        DataError: At the first thing wrong; the message names data set, episode, field and value.
    """
    task = get_task(task) if isinstance(task, str) else task
    return describe(load_trajectories(spec, task), task=task, horizon=horizon)[0]


def describe(
    trajectories: Trajectories, *, task: Task | None = None, horizon: int | None = None
) -> tuple[dict[str, Any], pd.DataFrame]:
    """What a person wants to know of a data set.

    Args:
        trajectories: The data.
        task: Adds normalised scores and, in mazes, how many of the free cells were visited.
        horizon: Adds the number of segments of that many steps.

    Returns:
        Facts by name, and a table with one row a column of the observations and actions: `dimension`,
        `lowest`, `mean`, `std`, `highest`.
    """
    lengths, returns = trajectories.lengths, trajectories.returns
    terminated = trajectories.terminations[trajectories.step_offsets[1:] - 1]
    facts: dict[str, Any] = {
        "data set": trajectories.name,
        "episodes": trajectories.num_episodes,
        "steps": trajectories.num_steps,
        "observation width": trajectories.observation_dim,
        "action width": trajectories.action_dim,
        "shortest episode": int(lengths.min()),
        "median episode": float(np.median(lengths)),
        "longest episode": int(lengths.max()),
        "terminated episodes": int(terminated.sum()),
        "truncated episodes": int((~terminated).sum()),
        "lowest return": round(float(returns.min()), 3),
        "mean return": round(float(returns.mean()), 3),
        "highest return": round(float(returns.max()), 3),
    }
    if task is not None:
        facts["mean normalised score"] = round(float(task.normalised_score(returns).mean()), 2)
        if task.maze_map is not None:
            facts["episodes that reach the goal"] = int(terminated.sum())
            facts["free cells visited"] = f"{_visited(trajectories, task)} of {len(task.free_cells())}"
    if horizon is not None:
        facts[f"segments of {horizon} steps"] = len(trajectories.windows(horizon))
    facts["fingerprint"] = trajectories.fingerprint()
    columns = {"observation": trajectories.observations, "action": trajectories.actions}
    dimensions = pd.DataFrame(
        [
            {
                "dimension": f"{kind} {j}",
                "lowest": float(values[:, j].min()),
                "mean": float(values[:, j].mean(dtype=np.float64)),
                "std": float(values[:, j].std(dtype=np.float64)),
                "highest": float(values[:, j].max()),
            }
            for kind, values in columns.items()
            for j in range(values.shape[1])
        ]
    )
    return facts, dimensions


def episode_table(trajectories: Trajectories) -> pd.DataFrame:
    """One row an episode: `episode`, `steps`, `return`, `terminated`, `truncated`."""
    last = trajectories.step_offsets[1:] - 1
    return pd.DataFrame(
        {
            "episode": np.arange(trajectories.num_episodes),
            "steps": trajectories.lengths,
            "return": trajectories.returns,
            "terminated": trajectories.terminations[last],
            "truncated": trajectories.truncations[last],
        }
    )


def find_datasets(roots: Iterable[str | Path] = ()) -> pd.DataFrame:
    """The Minari data sets in Minari's own folder and in others, without reading their arrays.

    Args:
        roots: Folders to look in beside MINARI_DATASETS_PATH (or ~/.minari/datasets).

    Returns:
        One row a data set: `data set`, `environment`, `episodes`, `steps`, `data` (the spec to pass on) and
        `problem`, which is empty when the metadata are sound.
    """
    rows: dict[Path, dict[str, Any]] = {}
    for root in (minari_root(), *map(Path, roots)):
        for path in sorted(root.glob("**/data/metadata.json")):
            home = path.parent.parent
            inside = home.relative_to(root)
            if not any(part.startswith(".") for part in inside.parts):  # hidden: half-written by somebody
                rows[home.resolve()] = {"data set": inside.as_posix(), **_row(home), "data": f"local:{home}"}
    columns = ["data set", "environment", "episodes", "steps", "data", "problem"]
    return pd.DataFrame(list(rows.values()), columns=columns)


def _row(home: Path) -> dict[str, Any]:
    try:
        metadata = read_metadata(home / "data")
    except UserError as error:
        return {"environment": "", "episodes": 0, "steps": 0, "problem": str(error)}
    return {
        "environment": (metadata["env_spec"] or {}).get("id", ""),
        "episodes": metadata.get("total_episodes", 0),
        "steps": metadata.get("total_steps", 0),
        "problem": "",
    }


def _visited(trajectories: Trajectories, task: Task) -> int:
    cells = np.unique(task.xy_to_cell(trajectories.observations[:, :2]), axis=0)
    return len({(int(i), int(j)) for i, j in cells} & set(task.free_cells()))
