"""What a finished run produced: everything that a report shows, read from the run's files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from dds_lightning.errors import UserError
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.saving.run_directory import read_marker
from dds_lightning.study.contestants import DATA_POLICY
from dds_lightning.study.run_task import recall_task
from dds_lightning.study.tables import BEST, failures_table, skills_table, summary_table
from dds_lightning.study.verdict import Verdict, verdict
from dds_lightning.tasks import Task, known_task

STAGES = ("data", "skill", "relabel", "policy", "clone", "examine", "evaluate")


@dataclass(frozen=True, eq=False)
class Findings:
    """Everything that a report shows, read from one run directory.

    Attributes:
        root: The run directory.
        task: The task that was played.
        result: The evaluation's episodes and paths.
        main: The contestant the run is about: the published agent as it acts by default.
        singles: The contestant whose parts are the single skills; None if they did not play.
        summary: See `tables.summary_table`.
        failures: See `tables.failures_table`.
        skills: See `tables.skills_table`.
        markers: Stage -> its marker.
    """

    root: Path
    task: Task
    result: RolloutResult
    main: str
    singles: str | None
    summary: pd.DataFrame
    failures: pd.DataFrame
    skills: pd.DataFrame
    markers: Mapping[str, Mapping[str, Any]]

    @classmethod
    def read(cls, root: Path) -> Findings:
        """Read a run directory.

        Raises:
            UserError: The directory holds no evaluation, its task is unknown, or a stage was written by a newer
                version.
        """
        if not (root / "evaluate" / "episodes.parquet").is_file():
            raise UserError(
                f"{root} holds no evaluation (evaluate/episodes.parquet): expected a run of `dds run` that has "
                "finished at least its stage 'evaluate'"
            )
        recall_task(root)
        result = RolloutResult.load(root / "evaluate")
        episodes = result.episodes
        task = known_task(result.task)
        main = str(episodes["actor"].iloc[0])
        parts = episodes.groupby("actor", sort=False)["label"].nunique()
        singles = next((str(name) for name in parts.index[parts > 1]), None)
        usage = root / "relabel" / "codes.csv"
        effects = ("dx", "dy", "distance") if task.maze_map is not None else ("reward",)
        return cls(
            root,
            task,
            result,
            main,
            singles,
            summary_table(episodes),
            failures_table(episodes, task),
            skills_table(
                episodes.loc[episodes["actor"] == main, "codes"],
                pd.read_csv(usage) if usage.is_file() else None,
                episodes[episodes["actor"] == singles] if singles else None,
                effects,
            ),
            {stage: marker for stage in STAGES if (marker := read_marker(root / stage))},
        )

    def facts(self, stage: str) -> Mapping[str, Any]:
        """Return the facts in a stage's marker; empty if there is none."""
        return self.markers.get(stage, {}).get("facts", {})

    @property
    def verdict(self) -> Verdict | None:
        """The weak stage; None for a run of an older version, which did not examine its stages."""
        evidence = self.facts("examine")
        if not evidence:
            return None
        scores = {"agent": float(self.summary["score"].iloc[0])}
        scores |= {f"data_{which}": value for which, value in self.facts("data").get("scores", {}).items()}
        names = {"behaviour cloning": "clone", DATA_POLICY: "data_policy"}
        for row in self.summary.itertuples(index=False):
            name = "single" if row.kind == BEST else names.get(str(row.contestant))
            if name is not None:
                scores[name] = float(row.score)
        return verdict(scores, evidence)

    @property
    def protocol(self) -> Mapping[str, Any] | None:
        """How the evaluation was done, see `protocol.protocol`; None if an older version did it."""
        return self.facts("evaluate").get("protocol")
