"""How long does a complete run take to a stated score, commit by commit?

    python benchmarks/leaderboard.py [--commits HEAD] [--tasks pointmaze-large-diverse ...] [--seed 0]

Checks each commit out beside this one, runs `dds run TASK` there with that commit's own defaults, adds a row to
results/leaderboard.csv and writes LEADERBOARD.md anew. Measure on an otherwise idle machine: a row holds seconds on the
clock. Hours for all three tasks; a row that is there is not measured again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from dds_lightning.saving.files import written_whole
from dds_lightning.study.tables import markdown

HERE = Path(__file__).parent
ROWS, PAGE = HERE / "results" / "leaderboard.csv", HERE / "LEADERBOARD.md"
BARS = {"pointmaze-large-diverse": 95.0, "hopper-medium-expert": 95.0, "antmaze-medium-diverse": 90.0}
"""Task and the score that it has to reach."""
HEAD = """# Leaderboard of our own history

Minutes on the clock of one complete `dds run TASK`, from data to report with the default settings; its work, which is
the sum over its stages and more than the clock where stages are done side by side; and the score that it reached. A run
below the bar did not reach it, however fast it was. The first rows are what run directories had recorded before this
table was kept, while other programs used the same cores: they bound the times from above. What did not pay is in
[LOG.md](LOG.md).

```bash
python benchmarks/leaderboard.py --commits HEAD
```
"""


def git(*words: str) -> str:
    """What git says."""
    return subprocess.run(["git", *words], cwd=HERE, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603, S607


def measure(commit: str, task: str, seed: int) -> dict[str, object]:
    """One run of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "commit"
        git("worktree", "add", "--detach", str(place), commit)
        try:
            words = [sys.executable, "-m", "dds_lightning", "run", task, f"--seed={seed}", "--json"]
            environment = {**os.environ, "PYTHONPATH": str(place)}
            began = time.monotonic()
            done = subprocess.run(  # noqa: S603 - this Python and this project
                [*words, "--out", str(Path(folder) / "run")],
                check=True,
                stdout=subprocess.PIPE,
                env=environment,
                cwd=folder,
            )
            clock = time.monotonic() - began
        finally:
            git("worktree", "remove", "--force", str(place))
    said = json.loads(done.stdout)
    score = next(
        (row["score"] for row in said["table"] if row["contestant"] == said.get("main")), said["table"][0]["score"]
    )
    return {
        "date": git("log", "-1", "--format=%cs", commit),
        "commit": commit,
        "task": task,
        "bar": BARS[task],
        "score": round(score, 1),
        "minutes": round(clock / 60, 1),
        "work, minutes": round(sum(said["seconds"].values()) / 60, 1),
        "seed": seed,
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
    }


def write(rows: pd.DataFrame) -> None:
    """The rows, and the page."""
    with written_whole(ROWS) as part:
        rows.to_csv(part, index=False, lineterminator="\n")
    parts = [HEAD]
    for task, found in rows.groupby("task", sort=False):
        bar = found["bar"].iloc[0]
        parts.append(f"## {task}: {bar:g}\n\n{markdown(found.drop(columns=['task', 'bar']), {'minutes': '.1f'})}\n")
    with written_whole(PAGE) as part:
        part.write_text("\n".join(parts), encoding="utf-8")


def main() -> None:
    """Measure what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commits", nargs="*", default=["HEAD"])
    parser.add_argument("--tasks", nargs="*", default=list(BARS), choices=list(BARS))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rows = pd.read_csv(ROWS)
    for commit in (git("rev-parse", "--short", name) for name in asked.commits):
        for task in asked.tasks:
            if not ((rows["commit"] == commit) & (rows["task"] == task)).any():
                rows = pd.concat([rows, pd.DataFrame([measure(commit, task, asked.seed)])], ignore_index=True)
                write(rows)
    write(rows)


if __name__ == "__main__":
    main()
