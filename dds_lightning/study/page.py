"""The text of `report.md`."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from dds_lightning.study.findings import Findings
from dds_lightning.study.protocol import heading, paper_line
from dds_lightning.study.tables import BEST, CONTESTANT, SKILL, ends, markdown, readable
from dds_lightning.tasks import Task

_OTHERS = 3
"""Most frequent ends that are listed for each contestant other than the main one."""


def page(findings: Findings, files: Mapping[str, str], diagnosis: Mapping[str, pd.DataFrame]) -> str:
    """Return the report as Markdown.

    Args:
        findings: The results that it shows.
        files: Name -> file beside the report, for those that exist.
        diagnosis: The tables of `diagnosis.diagnose`.
    """
    parts = [f"# {findings.task.name}", _opening(findings), _results(findings)]
    if "scores" in files:
        parts.append(_picture(files, "scores", "Normalised scores; grey: single skills."))
    parts.append(diagnosis_section(diagnosis))
    if "trajectories" in files:
        parts.append("## How the policy gets there\n")
        parts.append(_picture(files, "trajectories", f"{findings.main}, coloured by the skill in use."))
    if "clip" in files:
        parts.append(_picture(files, "clip", "One episode: the successful one of median length, if any succeeded."))
    parts.append(_skills(findings, files))
    if "failures" in files:
        parts.append(_failures(findings, files))
    if "values" in files:
        parts.append("## What the critic believes\n")
        text = (
            "V for a body at rest. Along the way to the goal it should rise steadily; a policy gets stuck "
            "in a dead end that looks better than the way out of it."
        )
        parts.append(_picture(files, "values", text))
    if "training" in files:
        parts.append("## Training\n")
        parts.append(_picture(files, "training", "Read from the metrics.csv of both trainings."))
    parts.append(_run(findings))
    names = [name for name in ("summary", "failures", "skills") if name in files]
    tables = ", ".join(f"[{files[name]}]({files[name]})" for name in names)
    parts.append(f"Tables: {tables}; every episode is in [evaluate/episodes.parquet](../evaluate/episodes.parquet).")
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _opening(findings: Findings) -> str:
    row = findings.summary.iloc[0]
    task = findings.task
    text = f"{headline(row, task)}, at most {task.max_episode_steps} steps an episode, in {task.env_id}"
    if task.maze_map is not None:
        text += f" from cell {task.start_cell} to cell {task.goal_cell}"
    lines = [text + "."]
    lines += [f"{heading(findings.protocol)}."] if findings.protocol else []
    if findings.verdict is not None:
        lines.insert(1, f"**{findings.verdict.text}**")
    return "\n\n".join([*lines, *filter(None, [paper_line(task)])])


def headline(row: pd.Series, task: Task) -> str:
    """Say what a contestant reached in half a sentence; the number by which the task is judged comes first.

    Args:
        row: A row of `tables.summary_table`.
        task: The task that was played.
    """
    error = "" if pd.isna(row["score_error"]) else f" ± {row['score_error']:.1f}"
    if not task.measures_success:
        return (
            f"**{row['contestant']}**: normalised score **{row['score']:.1f}{error}** over {row['episodes']} episodes, "
            f"mean return {row['return']:.1f}, mean length {row['steps']:.0f} steps"
        )
    interval = f"(95 % interval {row['success_low']:.1f} to {row['success_high']:.1f})"
    if task.subtasks:
        count = len(task.subtasks)
        return (
            f"**{row['contestant']}**: normalised score **{row['score']:.1f}{error}** over {row['episodes']} episodes, "
            f"{row['return']:.2f} of {count} subtasks on average, all {count} in {row['success']:.1f} % {interval}"
        )
    what = "reached the goal" if task.maze_map is not None else "succeeded"
    text = (
        f"**{row['contestant']}** {what} in **{row['success']:.1f} %** of {row['episodes']} episodes "
        f"{interval}, normalised score {row['score']:.1f}"
    )
    return text + (f", median {row['length']:.0f} steps" if row["length"] == row["length"] else "")


def _results(findings: Findings) -> str:
    notes = "Intervals are Wilson's, ± is" if findings.task.measures_success else "± is"
    notes += " the standard error. All contestants played from the same starts."
    if (findings.summary["kind"] == BEST).any():
        each = int(findings.summary.loc[findings.summary["kind"] == SKILL, "episodes"].iloc[0])
        notes += f" The best single skill was picked afterwards, from {each} episodes each, which flatters it."
    table = readable(findings.summary, findings.task)
    table["contestant"] = [
        name.strip() if kind == CONTESTANT else f"&nbsp;&nbsp;{name.strip()}"
        for name, kind in zip(table["contestant"], findings.summary["kind"], strict=True)
    ]
    return f"## Results\n\n{markdown(table)}\n\n{notes}"


def _skills(findings: Findings, files: Mapping[str, str]) -> str:
    formats = {"in data": ".1f", "chosen": ".1f", "alone": ".0f", "dx": ".2f", "dy": ".2f", "distance": ".2f"}
    headings = {"in data": "in data %", "chosen": "chosen %", "alone": "success alone %"}
    if findings.task.maze_map is None:
        formats |= {"alone": ".1f", "reward": ".3f"}
        headings["alone"] = "score alone"
    table = findings.skills
    shown = markdown(table.rename(columns=headings), {headings.get(k, k): v for k, v in formats.items()})
    text = "## The skills\n\n"
    if "starts_by_skill" in files:
        text += (
            _picture(files, "starts_by_skill", "Each skill alone from several starts, one panel per skill.") + "\n\n"
        )
    if "skills_by_start" in files:
        text += (
            _picture(files, "skills_by_start", "The same in close-up; a number marks where its skill ended.") + "\n\n"
        )
    if "single_skills" in files:
        text += _picture(files, "single_skills", "Each skill alone from the task's start.") + "\n\n"
    text += shown + f"\n\nChosen: share of the decisions of {findings.main}."
    if "dx" in table:
        text += " dx, dy and distance: mean change of the first two observations over a segment of the data."
    if "reward" in table:
        text += " reward: mean of a segment of the data, discounted, in the learner's convention."
    return text


def diagnosis_section(tables: Mapping[str, pd.DataFrame]) -> str:
    """Return the section on where a run loses, from the tables of `diagnosis.diagnose`."""
    text = (
        "## Where it loses\n\nFrom what the data hold, by what a copy of their actions and one skill alone reach, to "
        "what choosing skills reaches.\n\n" + markdown(tables["scores"], {"score": ".1f"})
    )
    return text if tables["measures"].empty else f"{text}\n\n{markdown(tables['measures'])}"


def _failures(findings: Findings, files: Mapping[str, str]) -> str:
    mine = findings.failures["contestant"] == findings.main
    text = "## Where failed episodes ended\n\n"
    text += markdown(ends(findings.failures[mine])) if mine.any() else f"No episode of {findings.main} failed."
    if "failed_ends" in files:
        caption = "A dot is an end, the number on it the skill in use; bold numbers count the ends in a cell."
        text += "\n\n" + _picture(files, "failed_ends", caption)
    others = findings.failures[~mine].groupby("contestant", sort=False).head(_OTHERS)
    if len(others):
        table = ends(others)
        table.insert(0, "contestant", others["contestant"].to_numpy())
        text += f"\n\nThe others, at most {_OTHERS} ends each:\n\n{markdown(table)}"
    return text


def _run(findings: Findings) -> str:
    from dds_lightning.saving.run_directory import duration

    seconds = [(stage, float(marker.get("seconds", 0.0))) for stage, marker in findings.markers.items()]
    if not seconds:
        return ""
    settings = findings.markers.get("evaluate", {}).get("settings", {})
    seed = f", seed {settings['seed']}" if "seed" in settings else ""
    lines = [f"| {stage} | {duration(spent)} |" for stage, spent in seconds]
    total = f"| all | {duration(sum(spent for _, spent in seconds))} |"
    return f"## The run{seed}\n\n" + "\n".join(["| stage | time |", "| --- | --: |", *lines, total])


def _picture(files: Mapping[str, str], name: str, text: str) -> str:
    return f"![{name}]({files[name]})\n\n{text}"
