"""The tables of a report, computed from one row per episode by pure functions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import pandas as pd

from dds_lightning.tasks import Task

SKILL, BEST, CONTESTANT = "skill", "best", "contestant"


def wilson(successes: int, episodes: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's score interval of a success rate (Wilson, 1927), also valid at 0 % and 100 %.

    Args:
        successes: Number of successful episodes.
        episodes: Number of episodes.
        confidence: Coverage, for example 0.95.

    Returns:
        Lower and upper bound in [0, 1]; both NaN without episodes.
    """
    if episodes == 0:
        return math.nan, math.nan
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / episodes
    denominator = 1.0 + z**2 / episodes
    centre = rate + z**2 / (2 * episodes)
    spread = z * math.sqrt(rate * (1.0 - rate) / episodes + z**2 / (4 * episodes**2))
    # At the ends the bound is exactly 0 or 1, whatever rounding gives.
    low = 0.0 if successes == 0 else (centre - spread) / denominator
    high = 1.0 if successes == episodes else (centre + spread) / denominator
    return low, high


def summary_table(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return one row per contestant; below a contestant of several parts, the best part and each part.

    Args:
        episodes: Table of episodes, see `RolloutResult.episodes`.

    Returns:
        Columns `contestant` (its name says how codes are chosen), `kind` ("contestant", "best" or "skill"),
        `episodes`, `success` with `success_low` and `success_high` (per cent; Wilson, 95 %; NaN if the task
        does not measure success), `score` (mean, normalised) with `score_error` (its standard error), `return`
        (mean), `steps` (mean of all episodes), `length` (median steps of successful episodes).
    """
    rows = []
    for actor, played in episodes.groupby("actor", sort=False):
        labels = list(dict.fromkeys(played["label"]))
        if len(labels) == 1:
            rows.append(_row(str(actor), CONTESTANT, played))
            continue
        parts = [_row(f"{label} alone", SKILL, played[played["label"] == label]) for label in labels]
        rows.append(_row(f"{actor}, all {len(labels)} together", CONTESTANT, played))
        best = max(parts, key=_rank)
        alike = all(_rank(part) == _rank(best) for part in parts)
        name = "all alike" if alike else best["contestant"].removesuffix(" alone")
        rows.append({**best, "contestant": f"best {actor} ({name})", "kind": BEST})
        rows += parts
    return pd.DataFrame(rows)


def _row(name: str, kind: str, played: pd.DataFrame) -> dict[str, Any]:
    count, succeeded = len(played), _succeeded(played)
    success = low = high = math.nan
    if succeeded is not None:
        success = 100.0 * int(succeeded.sum()) / count
        low, high = wilson(int(succeeded.sum()), count)
    score = played["score"].to_numpy(dtype=float)
    return {
        "contestant": name,
        "kind": kind,
        "episodes": count,
        "success": success,
        "success_low": 100.0 * low,
        "success_high": 100.0 * high,
        "score": float(score.mean()),
        "score_error": float(score.std(ddof=1) / math.sqrt(count)) if count > 1 else math.nan,
        "return": float(played["return"].mean()),
        "steps": float(played["length"].mean()),
        "length": math.nan if succeeded is None else float(played.loc[succeeded, "length"].median()),
    }


def _succeeded(episodes: pd.DataFrame) -> pd.Series | None:
    """Return which episodes succeeded, as plain bools; None if the task does not measure success."""
    return None if episodes["success"].isna().any() else episodes["success"].astype(bool)


def _rank(row: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return the sort key of parts: score, then success (in mazes the same), then the shorter path."""
    success, length = row["success"], row["length"]
    return row["score"], 0.0 if math.isnan(success) else success, -math.inf if math.isnan(length) else -length


def failures_table(episodes: pd.DataFrame, task: Task) -> pd.DataFrame:
    """Return where failed episodes ended and with which skill, most frequent first; empty if nothing can fail.

    Args:
        episodes: Table of episodes, see `RolloutResult.episodes`.
        task: The task, which maps positions to cells.

    Returns:
        Columns `contestant`, `row` and `column` of the end cell (missing without a maze), `skill` in
        use (-1 without skills), `episodes`, `share` (of the contestant's failures).
    """
    succeeded = _succeeded(episodes)
    ended = episodes[["actor", "final_x", "final_y", "final_code"]]
    failed = ended.iloc[:0] if succeeded is None else ended[~succeeded]
    cells = np.full((len(failed), 2), -1, dtype=np.int64)
    known = failed[["final_x", "final_y"]].notna().all(axis=1).to_numpy()
    if task.maze_map is not None and known.any():
        cells[known] = task.xy_to_cell(failed.loc[known, ["final_x", "final_y"]].to_numpy())
    table = pd.DataFrame(
        {
            "contestant": failed["actor"].to_numpy(),
            "row": cells[:, 0],
            "column": cells[:, 1],
            "skill": failed["final_code"].to_numpy(dtype=np.int64),
        }
    )
    keys = ["contestant", "row", "column", "skill"]
    counted = table.groupby(keys, sort=False).size().rename("episodes").reset_index()
    counted["share"] = counted["episodes"] / counted.groupby("contestant")["episodes"].transform("sum")
    order = {name: i for i, name in enumerate(episodes["actor"].unique())}
    counted["order"] = counted["contestant"].map(order)
    counted = counted.sort_values(
        ["order", "episodes", "row", "column", "skill"], ascending=[True, False, True, True, True]
    )
    for name in ("row", "column"):
        counted[name] = counted[name].astype("Int64").mask(counted[name] < 0)
    return counted.drop(columns="order").reset_index(drop=True)


def skills_table(
    chosen: Iterable[Iterable[int]],
    data: pd.DataFrame | None,
    alone: pd.DataFrame | None,
    effects: Sequence[str] = ("dx", "dy", "distance"),
) -> pd.DataFrame:
    """Return one row per code: how often the data use it and the policy chooses it, what it does, its score alone.

    Args:
        chosen: The codes of each of the policy's episodes.
        data: Summary of the relabelled data (`relabel/codes.csv`), if there is one.
        alone: Episodes of the single skills (rows of `RolloutResult.episodes`), if they played.
        effects: Columns of `data` on what a segment with the code does, in the data's units.

    Returns:
        Columns `skill`, `in data`, `chosen` (per cent), the effects, `alone` (mean normalised score, in a maze
        the percentage that reach the goal; or NaN); those without a source are left out.
    """
    codes = np.fromiter((code for episode in chosen for code in episode), dtype=np.int64)
    count = int(codes.max(initial=-1)) + 1
    if data is not None:
        count = max(count, int(data["code"].max()) + 1)
    if alone is not None:
        count = max(count, int(alone["final_code"].max()) + 1)
    table = pd.DataFrame({"skill": np.arange(count)})
    if data is not None:
        table["in data"] = 100.0 * data.set_index("code")["share"].reindex(table["skill"]).to_numpy()
    table["chosen"] = 100.0 * np.bincount(codes, minlength=count) / max(len(codes), 1)
    if data is not None:
        by_code = data.set_index("code").reindex(table["skill"])
        for name in effects:
            table[name] = by_code[name].to_numpy()
    if alone is not None:
        scores = alone.groupby("final_code")["score"].mean()
        table["alone"] = scores.reindex(table["skill"]).to_numpy(dtype=float)
    return table


def readable(summary: pd.DataFrame, task: Task) -> pd.DataFrame:
    """Return the summary as printed: units in the headings, means with standard errors, rates with intervals.

    Success comes first in mazes; otherwise the normalised score, followed by the return.
    """
    skill = summary["kind"] == SKILL
    columns: dict[str, Any] = {
        "contestant": summary["contestant"].where(~skill, "  " + summary["contestant"]),
        "episodes": summary["episodes"],
    }
    score = {
        "score": [
            cell(mean, ".1f") + ("" if pd.isna(error) else f" ± {error:.1f}")
            for mean, error in zip(summary["score"], summary["score_error"], strict=True)
        ]
    }
    if not task.measures_success:
        returns = [cell(value, ".1f") for value in summary["return"]]
        steps = [cell(value, ".0f") for value in summary["steps"]]
        return pd.DataFrame(columns | score | {"return": returns, "steps (mean)": steps})
    success = {
        "success %": [cell(value, ".1f") for value in summary["success"]],
        "95 % interval": [
            f"{low:.1f} to {high:.1f}"
            for low, high in zip(summary["success_low"], summary["success_high"], strict=True)
        ],
    }
    if task.subtasks:
        done = [cell(value, ".2f") for value in summary["return"]]
        columns |= score | {f"subtasks done, of {len(task.subtasks)}": done}
        columns |= {f"all {len(task.subtasks)}, %": success.pop("success %")} | success
    else:
        columns |= success | score
    columns["steps (median, successes)"] = [cell(value, ".0f") for value in summary["length"]]
    return pd.DataFrame(columns)


def ends(failures: pd.DataFrame) -> pd.DataFrame:
    """Return failures as printed: the cell as one text."""
    cells = [
        "-" if pd.isna(row) else f"({row}, {column})"
        for row, column in zip(failures["row"], failures["column"], strict=True)
    ]
    skills = ["-" if code < 0 else str(code) for code in failures["skill"]]
    shares = [f"{100 * share:.0f} %" for share in failures["share"]]
    return pd.DataFrame(
        {
            "end cell (row, column)": cells,
            "skill in use": skills,
            "episodes": failures["episodes"],
            "share": shares,
        }
    )


def markdown(table: pd.DataFrame, formats: Mapping[str, str] | None = None) -> str:
    """Format a DataFrame as a Markdown table: numbers right-aligned, missing values as a dash.

    Args:
        table: A small table.
        formats: Column -> format of its numbers, for example ".1f".
    """
    formats = formats or {}
    header = [str(column) for column in table.columns]
    numeric = [pd.api.types.is_numeric_dtype(table[column]) for column in table.columns]
    lines = [header, ["--:" if right else "---" for right in numeric]]
    for row in table.itertuples(index=False):
        lines.append([cell(value, formats.get(name, "")) for name, value in zip(table.columns, row, strict=True)])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def cell(value: Any, form: str = "") -> str:
    """Format one value."""
    if pd.isna(value):
        return "-"
    return format(value, form).replace("|", "\\|") if form else str(value).replace("|", "\\|")
