"""`dds run --seeds N`: the same run with several seeds, packed onto the cores, and one table over the seeds.

Each run is a process with one thread. Before each of its steps it waits for a core, which goes to the run that has had
the fewest: so all runs are equally far, and no core idles until the last of them ends.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

import pandas as pd

from dds_lightning.console.interrupts import Interrupted
from dds_lightning.console.reports import Report, plain, table
from dds_lightning.envs.pool import available_cores
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.interpret.draw.bars import plot_scores
from dds_lightning.interpret.draw.png import png_bytes
from dds_lightning.pipeline.child import Children, tell
from dds_lightning.pipeline.context import Run
from dds_lightning.pipeline.record import keep
from dds_lightning.pipeline.run import run_all
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.saving.files import written_whole
from dds_lightning.saving.run_directory import duration, locked
from dds_lightning.study.statistics import iqm
from dds_lightning.study.tables import BEST, SKILL, markdown
from dds_lightning.training.stages import run_stages

REPORT, TABLE, FIGURE = "seeds.md", "seeds.csv", "seeds.png"


def run_seeds(wanted: RunSettings, count: int) -> Report:
    """Do a run with each of `count` seeds, the first of them `wanted.seed`, in folders `seed-N` of `wanted.out`.

    Args:
        wanted: The run; its `jobs` are how many cores all runs share.
        count: Number of seeds.

    Raises:
        UserError: A setting that cannot work, found before anything is written; or what one of the runs refused, when
            the others have come to their end.
    """
    if count < 1:
        raise UserError(f"--seeds is {count}, expected at least 1")
    seeds = range(wanted.seed, wanted.seed + count)
    refuse_seed("--seed", seeds[-1])
    _refuse_start_of_one_seed(Run(wanted), seeds)
    workers = 1 if wanted.workers is None else wanted.workers
    runs = {
        seed: replace(wanted, seed=seed, out=wanted.out / f"seed-{seed}", jobs=1, workers=workers) for seed in seeds
    }
    turns, started = Turns(wanted.jobs or available_cores()), time.monotonic()
    with locked(wanted.out):
        keep(wanted, count)
        with Children(count) as children:
            working = {seed: children.submit(_run, children, turns, settings) for seed, settings in runs.items()}
            errors = [error for future in working.values() if (error := _error(future))]
        if errors:
            raise errors[0]
        made = [working[seed].result() for seed in seeds]
        return _report(wanted, made, time.monotonic() - started)


def _refuse_start_of_one_seed(run: Run, seeds: range) -> None:
    """Refuse that every seed starts from weights that belong to one of them: the others have skills of their own."""
    for stage in run_stages():
        for name, path in run.trainings.starts(stage).items():
            for seed in seeds if len(seeds) > 1 else ():
                place = run.out / f"seed-{seed}"
                if path.resolve().is_relative_to(place.resolve()):
                    raise UserError(
                        f"{stage}: model.{name} is {path}, of seed {seed} alone, but with --seeds {len(seeds)} every "
                        f"seed would start from it: give weights from outside of {run.out}, or do each seed by itself "
                        f"(`dds run {run.wanted.task} --seed {seed} --out {place} --{stage}.model.{name}={path}`)"
                    )


def _error(future: Future[Any]) -> BaseException | None:
    """Wait for a run; what it failed with."""
    error = future.exception()
    if isinstance(error, Interrupted):
        raise error
    return error


def _run(children: Children, turns: Turns, settings: RunSettings) -> dict[str, Any]:
    name = f"seed {settings.seed}"
    try:
        made: dict[str, Any] = children.run(name, f"{__name__}:one_run", settings, turn=partial(turns.of, name))
    except Interrupted:
        raise
    except BaseException as error:
        tell(f"{name} has failed: {error}; the other seeds go on")
        raise
    return made


def one_run(settings: RunSettings) -> dict[str, Any]:
    """In a process of its own, do one run; what `dds run --json` prints."""
    made: dict[str, Any] = plain(run_all(settings).data)
    return made


class Turns:
    """Cores, each of which goes to whoever has had the fewest turns of those who wait.

    Args:
        count: Number of cores.
    """

    def __init__(self, count: int) -> None:
        self._free = count
        self._had: Counter[str] = Counter()
        self._waiting: list[str] = []
        self._changed = threading.Condition()

    @contextlib.contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Hold a core while the block runs."""
        with self._changed:
            self._waiting.append(name)
            self._changed.wait_for(lambda: self._free and name == min(self._waiting, key=self._had.__getitem__))
            self._waiting.remove(name)
            self._free -= 1
            self._had[name] += 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._free += 1
                self._changed.notify_all()


# ---------------------------------------------------------------------- the table over seeds


def over_seeds(tables: Sequence[Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    """One row for each contestant over the tables of several seeds.

    Args:
        tables: Of each seed the rows of `write_report`'s `table`. Rows of single skills are left out: skill 3 of one
            seed is not skill 3 of another.

    Returns:
        `contestant`, `seeds`, `score` (mean over the seeds), `score_std` (their standard deviation, ddof 1; missing
        for one), `score_iqm` (interquartile mean), the same of `success` where the task measures it, and `scores`
        (list, one for each seed).
    """
    rows = pd.DataFrame([row for one in tables for row in one if row["kind"] != SKILL])
    rows["contestant"] = [_name(*pair) for pair in zip(rows["contestant"], rows["kind"], strict=True)]
    found = []
    for name, played in rows.groupby("contestant", sort=False):
        row: dict[str, Any] = {"contestant": name, "seeds": len(played)}
        for measure in ("score", "success"):
            values = played[measure].astype(float).dropna()
            if len(values):
                row |= {measure: values.mean(), f"{measure}_std": values.std(ddof=1)}
                row[f"{measure}_iqm"] = float(iqm(values.to_numpy()[:, None]))
        found.append({**row, "scores": played["score"].tolist()})
    return pd.DataFrame(found)


def _name(contestant: str, kind: str) -> str:
    """A contestant's name without what differs from seed to seed: the best skill's number, the best step."""
    return re.sub(r" \([^()]*\)$", "", contestant) if kind == BEST else re.sub(r", step [\d,]+", "", contestant)


def _shown(found: pd.DataFrame) -> pd.DataFrame:
    """The table as people read it."""
    shown: dict[str, Any] = {"contestant": found["contestant"], "seeds": found["seeds"]}
    for measure, unit in (("success", "success %"), ("score", "score")):
        if measure in found:
            pairs = zip(found[measure], found[f"{measure}_std"], strict=True)
            shown[unit] = [f"{mean:.1f}" + ("" if pd.isna(std) else f" ± {std:.1f}") for mean, std in pairs]
            shown[f"{unit}, IQM"] = [f"{value:.1f}" for value in found[f"{measure}_iqm"]]
    shown["score of each seed"] = [", ".join(f"{score:.1f}" for score in scores) for scores in found["scores"]]
    return pd.DataFrame(shown)


def _report(wanted: RunSettings, made: Sequence[Mapping[str, Any]], clock: float) -> Report:
    """The table over seeds, and a page with links to the report of each."""
    data: dict[str, Any] = {"task": made[0]["task"], "out": wanted.out, "seeds": [run["seed"] for run in made]}
    data |= {"seconds": clock, "runs": made}
    work = sum(seconds for run in made for seconds in run["seconds"].values())
    end = f"{duration(work)} in all, {duration(clock)} by the clock in this call; everything is in {wanted.out}"
    if not all("table" in run for run in made):
        return Report(data, [*(f"seed {run['seed']}: {run['out']}" for run in made), end])
    found = over_seeds([run["table"] for run in made])
    shown = _shown(found)
    title = f"{data['task']}: mean ± standard deviation and interquartile mean over {len(made)} seeds"
    links = [_link(run) for run in made]
    with written_whole(wanted.out / TABLE) as part:
        shown.to_csv(part, index=False, lineterminator="\n")
    drawn = found.assign(kind="contestant", score_error=found["score_std"])
    with written_whole(wanted.out / FIGURE) as part:
        part.write_bytes(png_bytes(plot_scores(drawn, "standard deviation, and each seed")))
    picture = f"![Scores]({FIGURE})"
    with written_whole(wanted.out / REPORT) as part:
        page = "\n\n".join([f"# {title}", picture, markdown(shown), "\n".join(links)])
        part.write_text(page + "\n", encoding="utf-8")
    report = wanted.out / REPORT
    return Report({**data, "table": found, "report": report}, [title, table(shown), f"report: {report}", end])


def _link(run: Mapping[str, Any]) -> str:
    place = f"seed-{run['seed']}/report/report.md"
    verdict = (run.get("verdict") or {}).get("text", "")
    return f"- [Seed {run['seed']}]({place})" + (f": {verdict}" if verdict else "")
