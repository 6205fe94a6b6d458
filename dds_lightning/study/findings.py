"""What a finished run produced: everything that a report shows, read from the run's files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from dds_lightning.errors import UserError
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.saving.run_directory import MARKER, read_marker
from dds_lightning.saving.untrusted import conform, read_csv, refuse_links
from dds_lightning.study.contestants import DATA_POLICY
from dds_lightning.study.run_task import recall_task
from dds_lightning.study.tables import BEST, failures_table, skills_table, summary_table
from dds_lightning.study.verdict import Verdict, verdict
from dds_lightning.tasks import Task, known_task

_RELABEL = "delete its folder, and `dds run` relabels"
_NUMBER, _TEXT = (int, float), (str,)
_BOUND = (int, float, type(None))
_FORMS: dict[tuple[str, str], dict[str, Any]] = {
    ("data", "scores"): {"mean": _NUMBER, "best": _NUMBER},
    ("evaluate", "start_value"): {"mean": _NUMBER, "low": _BOUND, "high": _BOUND},
    ("evaluate", "protocol"): {
        **dict.fromkeys(("task", "environment", "checkpoint"), _TEXT),
        **dict.fromkeys(("episodes", "seed", "horizon"), (int,)),
        **dict.fromkeys(("noise_scale", "temperature"), _NUMBER),
        "sampler": (str, type(None)),
    },
}
"""(Stage, fact) -> the form of what a report shows of it, where it is there."""
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
    def read(cls, root: Path, asked: str | None = None) -> Findings:
        """Read a run directory.

        Args:
            root: A directory of `dds run`.
            asked: Name or file of its task, see `recall_task`.

        Raises:
            UserError: The directory holds no evaluation, its task is unknown, or a stage was written by a newer
                version.
        """
        if not (root / "evaluate" / "episodes.parquet").is_file():
            raise UserError(
                f"{root} holds no evaluation (evaluate/episodes.parquet): expected a run of `dds run` that has "
                "finished at least its stage 'evaluate'"
            )
        refuse_links(root)
        recall_task(root, asked)
        result = RolloutResult.load(root / "evaluate")
        episodes = result.episodes
        task = known_task(result.task)
        main = str(episodes["actor"].iloc[0])
        parts = episodes.groupby("actor", sort=False)["label"].nunique()
        singles = next((str(name) for name in parts.index[parts > 1]), None)
        effects = ("dx", "dy", "distance") if task.maze_map is not None else ("reward",)
        usage = root / "relabel" / "codes.csv"
        data = None
        if usage.is_file():
            data = read_csv(usage, dict.fromkeys(("share", *effects), "iuf") | {"code": "iu"}, remedy=_RELABEL)
            if sorted(data["code"]) != list(range(len(data))):
                raise UserError(f"{usage} lists other codes than 0 to {len(data) - 1}: {_RELABEL}")
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
                data,
                episodes[episodes["actor"] == singles] if singles else None,
                effects,
            ),
            _markers(root),
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


def _markers(root: Path) -> dict[str, dict[str, Any]]:
    """The markers of a run's stages, with what a report shows of their facts in the form that it needs."""
    found = {stage: marker for stage in STAGES if (marker := read_marker(root / stage))}

    def what(stage: str, name: str) -> str:
        return f"{root / stage / MARKER} is damaged, and `dds run` does the stage again once it is deleted: {name}"

    for (stage, name), form in _FORMS.items():
        facts = found.get(stage, {}).get("facts", {})
        if facts.get(name) is not None:
            facts[name] = conform(facts[name], form, what(stage, name))
    evidence = found.get("examine", {}).get("facts", {})
    numbers = [*evidence, *(["fidelity_clone"] if "fidelity" in evidence else [])]
    conform(evidence, dict.fromkeys(numbers, _NUMBER), what("examine", "facts"))
    return found
