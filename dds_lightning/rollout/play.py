"""Vectorised episodes of several contestants over real environments, and one result row an episode.

Contestants play side by side in one `EnvPool`. Each has slots of its own and a fixed split of its episodes
over them, so an episode that fails slowly counts as much as one that succeeds fast. Episode i of every
contestant starts from the same environment seed: comparisons are paired.

The same call gives the same table: it depends on task, contestants, `seed` and `slots` (the rows of a batch
share the actor's random stream), not on `workers` or how busy the machine is.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.envs.pool import EnvPool
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant
from dds_lightning.rollout.actors import single_skills as single_skills
from dds_lightning.rollout.result import RolloutPath as RolloutPath
from dds_lightning.rollout.result import RolloutResult as RolloutResult
from dds_lightning.rollout.schedule import (
    DEFAULT_SLOTS,
    Plan,
    Seat,
    bundle,
    check_contestants,
    episode_seeds,
    plan_slots,
    take_seats,
)
from dds_lightning.rollout.schedule import episode_seed as episode_seed
from dds_lightning.rollout.schedule import slots_needed as slots_needed
from dds_lightning.tasks import Task, get_task


def rollout(
    task: Task | str,
    contestants: Sequence[Contestant],
    *,
    seed: int = 0,
    workers: int | None = None,
    slots: int = DEFAULT_SLOTS,
    progress: bool = True,
    record: bool = False,
    record_observations: bool = False,
    pool: EnvPool | None = None,
    threads: int = 1,
) -> RolloutResult:
    """Let contestants play their episodes.

    Args:
        task: the environment, or its name.
        contestants: who plays.
        seed: of environments and actors.
        workers: processes that step environments; None one a core, 0 none but this.
        slots: environments in all; more are used when there are more contestants and labels.
        progress: show a bar when standard error is a terminal.
        record: keep the path of every episode.
        record_observations: keep the observations as well.
        pool: play in these environments instead of new ones; `workers` is then not used, and `slots` is
            bounded by its size.
        threads: torch's threads while acting. One is best for small networks and on a busy machine, where
            threads that wait for a core cost far more than they bring; large networks on idle cores gain from
            more. The last bits of the table may depend on it.

    Returns:
        The table of episodes, in the contestants' order, and the recorded paths.

    Raises:
        UserError: contestants that cannot be played; the message names them.
        EnvPoolError: an environment failed.
    """
    task = get_task(task)
    check_contestants(contestants)
    if slots < 1:
        raise UserError(f"slots is {slots}, expected at least 1")
    if pool is not None and pool.task != task:
        raise UserError(f"the pool has environments of '{pool.task.name}', expected '{task.name}'")
    bundles = bundle(contestants)
    members = [contestant for _, own in bundles for contestant in own]
    plans = plan_slots(members, slots, pool.num_envs if pool else None)
    total = sum(len(plan.slots) for plan in plans)
    with contextlib.ExitStack() as stack:
        if pool is None:
            pool = stack.enter_context(EnvPool(task, total, workers))
        count = sum(plan.contestant.episodes for plan in plans)
        report = stack.enter_context(_progress_bar(count, progress, "success" if task.measures_success else "score"))
        match = _Match(pool, plans, seed, record or record_observations, record_observations, report)
        stack.enter_context(_torch_threads(threads))
        rows = match.play(take_seats(bundles, plans, seed))
    order = {contestant.name: i for i, contestant in enumerate(contestants)}
    rows.sort(key=lambda row: (order[row["actor"]], row["episode"]))
    paths = {(row["actor"], row["episode"]): row.pop("path") for row in rows}
    table = pd.DataFrame(rows)
    if not task.measures_success:
        table["success"] = pd.array([None] * len(table), dtype="boolean")  # missing, which is not failed
    return RolloutResult(task.name, table, {key: path for key, path in paths.items() if path})


# ---------------------------------------------------------------------- playing


class _Match:
    """The state of a rollout in progress: one entry a slot."""

    def __init__(
        self,
        pool: EnvPool,
        plans: list[Plan],
        seed: int,
        record: bool,
        record_observations: bool,
        report: Callable[[float], None],
    ) -> None:
        self.pool, self.task, self.report = pool, pool.task, report
        self.who = [plan.contestant for plan in plans for _ in plan.slots]
        self.todo = [list(own) for plan in plans for own in plan.slots]
        self.seeds = [episode_seeds(plan.contestant, seed) for plan in plans for _ in plan.slots]
        count, steps = len(self.todo), self.task.max_episode_steps
        self.turn = np.zeros(count, dtype=np.int64)
        self.returns = np.zeros(count)
        self.lengths = np.zeros(count, dtype=np.int64)
        self.success = np.zeros(count, dtype=bool)
        self.codes = np.full(count, -1, dtype=np.int64)
        self.chosen: list[list[int]] = [[] for _ in range(count)]
        self.positions = np.full((count, steps + 1, 2), np.nan, np.float32) if record else None
        self.in_use = np.full((count, steps), -1, np.int16) if record else None
        width = self.task.observation_dim
        self.seen = np.zeros((count, steps + 1, width), np.float32) if record_observations else None

    def play(self, seats: list[Seat]) -> list[dict[str, Any]]:
        """Play to the end; a row an episode, in the order in which they end."""
        pool = self.pool
        start = pool.start([[own[i] for i in todo] for own, todo in zip(self.seeds, self.todo, strict=True)])
        self.observations, self.restarted = start["observation"].copy(), start["alive"].copy()
        alive = pool.alive
        self._remember(alive, start["position"][alive], start["observation"][alive])
        rows: list[dict[str, Any]] = []
        while len(alive := pool.alive):
            rows += self._note(alive, pool.step(self._act(seats, alive)))
        return rows

    def _note(self, slots: NDArray[np.intp], records: NDArray[Any]) -> list[dict[str, Any]]:
        """Take in one step of some slots: the rows of the episodes that have ended."""
        if self.in_use is not None:
            self.in_use[slots, self.lengths[slots]] = self.codes[slots]
        self.returns[slots] += records["reward"]
        self.success[slots] |= records["success"]
        self.lengths[slots] += 1
        self._remember(slots, records["reached_position"], records["reached"])
        ended = records["terminated"] | records["truncated"]
        rows = [self._finish(slots[row], records[row]) for row in np.flatnonzero(ended)]
        for row in rows:
            self.report(100.0 * row["success"] if self.task.measures_success else row["score"])
        again = ended & records["alive"]
        self.restarted[slots] = again
        self.observations[slots] = records["observation"]
        self._remember(slots[again], records["position"][again], records["observation"][again])
        return rows

    def _act(self, seats: list[Seat], slots: NDArray[np.intp]) -> NDArray[np.float32]:
        """Everybody's actions (n, A) for some live slots, ascending."""
        actions = np.empty((len(slots), self.task.action_dim), np.float32)
        for seat in seats:
            low, high = np.searchsorted(slots, (seat.low, seat.high))
            if low < high:
                actions[low:high] = self._act_one(seat, slots[low:high])
        return actions

    def _act_one(self, seat: Seat, slots: NDArray[np.intp]) -> NDArray[np.float32]:
        """One actor's actions for its live slots; its codes are noted."""
        rows = slots - seat.low
        actions = np.asarray(seat.actor.act(self.observations[slots], self.restarted[slots], rows), dtype=np.float32)
        if actions.shape != (len(slots), self.task.action_dim):
            expected = (len(slots), self.task.action_dim)
            raise UserError(f"'{seat.name}' gave actions of shape {actions.shape}, expected {expected}")
        if not np.isfinite(actions).all():
            raise UserError(f"'{seat.name}' gave an action that is not finite; has its training diverged?")
        codes = getattr(seat.actor, "codes", None)
        if codes is not None:
            self.codes[slots] = np.asarray(codes)[rows]
            for row in np.flatnonzero(np.asarray(seat.actor.decided)[rows]):  # type: ignore[attr-defined]
                self.chosen[slots[row]].append(int(self.codes[slots[row]]))
        return actions

    def _remember(self, slots: NDArray[np.intp], positions: NDArray[Any], observations: NDArray[Any]) -> None:
        if self.positions is not None:
            self.positions[slots, self.lengths[slots]] = positions
        if self.seen is not None:
            self.seen[slots, self.lengths[slots]] = observations

    def _finish(self, slot: int, record: Any) -> dict[str, Any]:
        """The row of the episode that has just ended in a slot, and a clean slate for the next."""
        contestant, episode = self.who[slot], self.todo[slot][self.turn[slot]]
        length = int(self.lengths[slot])
        path = None
        if self.positions is not None and self.in_use is not None:
            seen = None if self.seen is None else self.seen[slot, : length + 1].copy()
            path = RolloutPath(self.positions[slot, : length + 1].copy(), self.in_use[slot, :length].copy(), seen)
        row = {
            "actor": contestant.name,
            "label": contestant.labels[episode] if contestant.labels else contestant.name,
            "episode": episode,
            "seed": self.seeds[slot][episode],
            "return": float(self.returns[slot]),
            "score": float(self.task.normalised_score(self.returns[slot])),
            "success": bool(self.success[slot]),
            "terminated": bool(record["terminated"]),
            "length": length,
            "final_x": float(record["reached_position"][0]),
            "final_y": float(record["reached_position"][1]),
            "final_code": int(self.codes[slot]),
            "codes": self.chosen[slot],
            "path": path,
        }
        self.turn[slot] += 1
        self.returns[slot], self.lengths[slot], self.success[slot] = 0.0, 0, False
        self.chosen[slot] = []
        return row


@contextlib.contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    """Let torch use `count` threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _progress_bar(total: int, wanted: bool, what: str) -> Iterator[Callable[[float], None]]:
    """A bar of episodes done and the mean so far of "success" or "score", on standard error; silent elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not (wanted and console.is_terminal):
        yield lambda value: None
        return
    unit = " %" if what == "success" else ""
    columns = (
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{what} {{task.fields[mean]:.0f}}{unit}"),
        TimeRemainingColumn(),
    )
    values = 0.0
    with Progress(*columns, console=console, transient=True) as bar:
        line = bar.add_task("episodes", total=total, mean=0.0)

        def report(value: float) -> None:
            nonlocal values
            values += value
            done = bar.tasks[0].completed + 1
            bar.update(line, advance=1, mean=values / done)

        yield report
