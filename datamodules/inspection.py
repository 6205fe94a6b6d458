"""Looking at data sets: what `dds data check`, `show` and `list` print."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from datamodules.sources import load_trajectories
from datamodules.sources.minari import minari_root, read_metadata
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task


def check_dataset(
    spec: str, task: Task | str | None = None, *, horizon: int | None = None
) -> pd.DataFrame:
    """Read a data set, refuse it if anything is wrong, else describe it.

    Args:
        spec: As in `load_trajectories`.
        task: The task that it must fit, if any; in mazes rewards are those of the task's goal.
        horizon: H; if given, also count segments and refuse data whose episodes are all shorter.

    Returns:
        As `describe`.

    Raises:
        DataError: At the first thing wrong; the message names data set, episode, field and value.
    """
    task = get_task(task) if isinstance(task, str) else task
    return describe(load_trajectories(spec, task), task=task, horizon=horizon)


def describe(
    trajectories: Trajectories, *, task: Task | None = None, horizon: int | None = None
) -> pd.DataFrame:
    """What a person wants to know of a data set: one row a fact, columns `fact` and `value`.

    Args:
        trajectories: The data.
        task: Adds normalised scores and, in mazes, which share of the free cells was visited.
        horizon: Adds the number of segments of that many steps.
    """
    lengths, returns = trajectories.lengths, trajectories.returns
    terminated = trajectories.terminations[trajectories.step_offsets[1:] - 1]
    facts: dict[str, Any] = {
        "data set": trajectories.name,
        "episodes": trajectories.num_episodes,
        "steps": trajectories.num_steps,
        "observation width": trajectories.observation_dim,
        "action width": trajectories.action_dim,
        "episode length, shortest": int(lengths.min()),
        "episode length, median": float(np.median(lengths)),
        "episode length, longest": int(lengths.max()),
        "terminated episodes": int(terminated.sum()),
        "truncated episodes": int((~terminated).sum()),
        "return, lowest": float(returns.min()),
        "return, mean": float(returns.mean()),
        "return, highest": float(returns.max()),
    }
    if task is not None:
        facts["normalised score, mean"] = float(task.normalised_score(returns).mean())
        if task.maze_map is not None:
            facts["episodes that reach the goal"] = int(terminated.sum())
            facts["free cells visited"] = f"{_visited(trajectories, task)} of {len(task.free_cells())}"
    if horizon is not None:
        facts[f"segments of {horizon} steps"] = len(trajectories.windows(horizon))
    facts["fingerprint"] = trajectories.fingerprint()
    return pd.DataFrame({"fact": list(facts), "value": pd.Series(list(facts.values()), dtype=object)})


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


def list_datasets(root: str | Path | None = None) -> pd.DataFrame:
    """The Minari data sets under a folder, without reading their arrays.

    Args:
        root: Folder of data sets; None takes MINARI_DATASETS_PATH or ~/.minari/datasets.

    Returns:
        Columns `data set`, `environment`, `episodes`, `steps`, `data` (the spec to pass on) and `problem`, which is
        empty for a set whose metadata is sound.
    """
    folder = Path(root) if root is not None else minari_root()
    rows = []
    for path in sorted(folder.glob("**/data/metadata.json")):
        home = path.parent.parent
        if any(part.startswith(".") for part in home.relative_to(folder).parts):
            continue
        row: dict[str, Any] = {"data set": home.relative_to(folder).as_posix(), "data": f"local:{home}"}
        try:
            metadata = read_metadata(path.parent)
            row |= {
                "environment": (metadata["env_spec"] or {}).get("id", "unknown"),
                "episodes": metadata.get("total_episodes"),
                "steps": metadata.get("total_steps"),
                "problem": "",
            }
        except UserError as error:
            row |= {"environment": "", "episodes": None, "steps": None, "problem": str(error)}
        rows.append(row)
    return pd.DataFrame(rows, columns=["data set", "environment", "episodes", "steps", "data", "problem"])


def _visited(trajectories: Trajectories, task: Task) -> int:
    cells = np.unique(task.xy_to_cell(trajectories.observations[:, :2]), axis=0)
    return len({(int(i), int(j)) for i, j in cells} & set(task.free_cells()))
