"""Where a run loses: what the data hold, what a copy of them reaches, one skill alone, and the choice of skills.

```
 data ──► behaviour cloning        score of imitating actions alone
   └────► skills ──► one skill     score of the decoder
             └─────► policy        gain from choosing skills
```
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from dds_lightning.saving.untrusted import read_csv
from dds_lightning.study.contestants import DATA_POLICY
from dds_lightning.study.tables import BEST
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from datamodules.trajectories import Trajectories
    from dds_lightning.study.findings import Findings


_EVIDENCE = (
    ("way_share", "way from start to goal at the data's pace, % of an episode's steps", ".0f", 100.0),
    ("codes_used", "codes in use (training segments)", ".0f", 1.0),
    ("expected_fall", "fall of held-out loss with a quarter more skill steps, %", ".1f", 100.0),
    ("overfit", "rise of held-out skill loss above its lowest level, %", ".0f", 100.0),
    ("fidelity", "error of replayed skills, in distances between two segments", ".3f", 1.0),
    ("fidelity_clone", "the same for behaviour cloning", ".3f", 1.0),
    ("beta_loss", "cross entropy of held-out skills by the data's policy, nats", ".2f", 1.0),
    ("share_loss", "the same by the skills' shares in the data", ".2f", 1.0),
    ("critic_rank", "rank correlation of V with returns of held-out episodes", ".2f", 1.0),
    ("policy_shift", "way of the policy from the data's to the critic's best code, %", ".0f", 100.0),
)
"""Numbers of `evidence` in the report: key, what it is called, format, factor."""


def behaviour_scores(trajectories: Trajectories, task: Task) -> dict[str, float]:
    """Score the behaviour policy as an evaluation would.

    In the kitchen the data give rewards at every step, an evaluation only once, so the subtasks that an episode
    completes are counted instead.

    Returns:
        `mean` and `best` normalised score of an episode.
    """
    if task.subtasks:
        from datamodules.sources.subtasks import subtasks_completed

        scores = task.normalised_score(subtasks_completed(trajectories, task))
    else:
        scores = task.normalised_score(trajectories.returns)
    return {"mean": round(float(scores.mean()), 2), "best": round(float(scores.max()), 2)}


def diagnose(findings: Findings, logs: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """Return the tables of the report's section on where the run loses; what was not measured is left out.

    Args:
        findings: What the run produced.
        logs: "skill" and "policy" -> the metrics.csv of their training.

    Returns:
        `scores`: one row per step from data to policy, columns `who` and `score` (normalised); `measures`: columns
        `measure` and `value`, numbers of the two trainings and of the critic at the start.
    """
    return {"scores": _scores(findings), "measures": _measures(findings, logs)}


def _scores(findings: Findings) -> pd.DataFrame:
    data = findings.facts("data").get("scores", {})
    rows = [(f"the data, {which} episode", data[which]) for which in ("mean", "best") if which in data]
    summary = findings.summary
    ladder = {"behaviour cloning": 0, "random skills": 1, DATA_POLICY: 3, findings.main: 4}  # the best skill is 2
    chosen = summary["contestant"].isin(list(ladder)) | (summary["kind"] == BEST)
    played = sorted(
        summary.loc[chosen, ["contestant", "score"]].itertuples(index=False),
        key=lambda row: ladder.get(str(row.contestant), 2),
    )
    rows += [(str(row.contestant), float(row.score)) for row in played]
    return pd.DataFrame(rows, columns=["who", "score"])


def _measures(findings: Findings, logs: Mapping[str, Path]) -> pd.DataFrame:
    rows: list[tuple[str, str]] = []

    def logged(stage: str, column: str, name: str, form: str, factor: float = 1.0) -> None:
        value = _last(logs.get(stage), column)
        if not math.isnan(value):
            rows.append((name, format(factor * value, form)))

    held_out = "held-out segments"
    logged("skill", "val/reconstruction_rmse", f"error of decoded actions (RMSE, {held_out})", ".3g")
    logged("skill", "val/codes_used", f"codes in use ({held_out})", ".0f")
    logged("policy", "val/clipped_share", "AWR weights that are clipped, %", ".1f", 100.0)
    logged("policy", "val/code_accuracy", "agreement of the policy with the data's codes, %", ".0f", 100.0)
    evidence = findings.facts("examine")
    for key, name, form, factor in _EVIDENCE:
        if key in evidence:
            rows.append((name, format(factor * float(evidence[key]), form)))
    start = findings.facts("evaluate").get("start_value")
    if start:
        bounds = [start["low"], start["high"]]
        possible = "" if None in bounds else f" (possible: {bounds[0]:.3g} to {bounds[1]:.3g})"
        rows.append(("V at the start, in learning rewards", f"{start['mean']:.3g}{possible}"))
    return pd.DataFrame(rows, columns=["measure", "value"])


def _last(path: Path | None, column: str) -> float:
    """Return the last logged value of a column; NaN if there is none."""
    if path is None:
        return math.nan
    table = read_csv(path, {})
    values = table[column].dropna().tolist() if column in table else []
    return float(values[-1]) if values else math.nan
