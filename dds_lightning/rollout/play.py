"""Vectorised episodes of several contestants over real environments, and one row of results per episode.

Contestants play side by side in one `EnvPool`. Each has its own slots and a fixed split of its episodes over
them, so an episode that fails slowly counts as much as one that succeeds fast. Episode i of every
contestant starts from the same environment seed: comparisons are paired.

The same call gives the same table: it depends on task, contestants, `seed` and `slots` (the rows of a batch
share the actor's random stream), not on `workers` or the load of the machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.console.progress import on_terminal, progress_bar
from dds_lightning.envs.pool import EnvPool
from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Acted, Contestant
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.rollout.schedule import (
    DEFAULT_SLOTS,
    ActorSlots,
    Plan,
    assign_slots,
    bundle,
    check_contestants,
    episode_seeds,
    plan_slots,
)
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
    """Play the episodes of all contestants.

    Args:
        task: The environment, or its name.
        contestants: Who plays, and how often.
        seed: Seed of environments and actors.
        workers: Processes that step environments; None for one a core, 0 for this process only.
        slots: Environments in all; more are used when there are more contestants and labels.
        progress: Show a bar when standard error is a terminal.
        record: Keep the path of every episode.
        record_observations: Keep the observations as well.
        pool: Play in these environments instead of new ones; `workers` is then not used, and `slots` is
            bounded by its size.
        threads: Torch's threads while acting. One is best for small networks and on a busy machine, where
            threads that wait for a core cost far more than they bring; large networks on idle cores gain from
            more. The last bits of the table may depend on it.

    Returns:
        The table of episodes, in the contestants' order, and the recorded paths.

    Raises:
        UserError: Contestants that cannot play; the message names them.
        EnvPoolError: An environment failed.
    """
    task = get_task(task)
    check_contestants(contestants)
    if slots < 1:
        raise UserError(f"slots is {slots}, expected at least 1")
    if pool is not None and pool.task != task:
        raise UserError(f"the pool has environments of '{pool.task.name}', expected '{task.name}'")
    bundles = bundle(contestants)
    members = [contestant for _, bundled in bundles for contestant in bundled]
    plans = plan_slots(members, slots, pool.num_envs if pool else None)
    total = sum(len(plan.slots) for plan in plans)
    with contextlib.ExitStack() as stack:
        if pool is None:
            pool = stack.enter_context(EnvPool(task, total, workers))
        count = sum(plan.contestant.episodes for plan in plans)
        report = stack.enter_context(_mean_so_far(count, progress, "success" if task.measures_success else "score"))
        match = _Match(pool, plans, seed, record or record_observations, record_observations, report)
        stack.enter_context(_torch_threads(threads))
        rows = match.play(assign_slots(bundles, plans, seed))
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
        self.todo = [list(episodes) for plan in plans for episodes in plan.slots]
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

    def play(self, actors: list[ActorSlots]) -> list[dict[str, Any]]:
        """Play to the end; return one row per episode, in the order in which they end."""
        pool = self.pool
        start = pool.start([[seeds[i] for i in todo] for seeds, todo in zip(self.seeds, self.todo, strict=True)])
        self.observations, self.restarted = start["observation"].copy(), start["alive"].copy()
        alive = pool.alive
        self._remember(alive, start["position"][alive], start["observation"][alive])
        rows: list[dict[str, Any]] = []
        while len(alive := pool.alive):
            records = pool.step(self._act(actors, alive))
            self._pay(actors, alive, records["reward"])
            rows += self._note(alive, records)
        return rows

    def _pay(self, actors: list[ActorSlots], slots: NDArray[np.intp], rewards: NDArray[Any]) -> None:
        """Tell the actors that ask for it what their last actions earned."""
        for one in actors:
            if paid := getattr(one.actor, "paid", None):
                own = slice(*np.searchsorted(slots, (one.low, one.high)))
                paid(np.asarray(rewards[own], dtype=np.float32), slots[own] - one.low)

    def _note(self, slots: NDArray[np.intp], records: NDArray[Any]) -> list[dict[str, Any]]:
        """Record one step of some slots; return the rows of the episodes that have ended."""
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

    def _act(self, actors: list[ActorSlots], slots: NDArray[np.intp]) -> NDArray[np.float32]:
        """All actions (n, A) for some live slots, ascending."""
        actions = np.empty((len(slots), self.task.action_dim), np.float32)
        for one in actors:
            low, high = np.searchsorted(slots, (one.low, one.high))
            if low < high:
                actions[low:high] = self._act_one(one, slots[low:high])
        return actions

    def _act_one(self, one: ActorSlots, slots: NDArray[np.intp]) -> NDArray[np.float32]:
        """One actor's actions for its live slots; its codes are noted."""
        acted = one.actor.act(self.observations[slots], self.restarted[slots], slots - one.low)
        if not isinstance(acted, Acted):
            acted = Acted(acted)
        actions = np.asarray(acted.actions, dtype=np.float32)
        if actions.shape != (len(slots), self.task.action_dim):
            expected = (len(slots), self.task.action_dim)
            raise UserError(f"'{one.name}' gave actions of shape {actions.shape}, expected {expected}")
        if not np.isfinite(actions).all():
            raise UserError(f"'{one.name}' gave an action that is not finite; has its training diverged?")
        if acted.codes is not None:
            self.codes[slots] = acted.codes
        for slot in [] if acted.chosen is None else slots[acted.chosen]:
            self.chosen[slot].append(int(self.codes[slot]))
        return actions

    def _remember(self, slots: NDArray[np.intp], positions: NDArray[Any], observations: NDArray[Any]) -> None:
        if self.positions is not None:
            self.positions[slots, self.lengths[slots]] = positions
        if self.seen is not None:
            self.seen[slots, self.lengths[slots]] = observations

    def _finish(self, slot: int, record: Any) -> dict[str, Any]:
        """Return the row of the episode that has just ended in a slot, and reset the slot for the next."""
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
    """Let torch use `count` threads inside the block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _mean_so_far(total: int, shown: bool, what: str) -> Iterator[Callable[[float], None]]:
    """A bar of episodes done and the mean so far of "success" or "score"; shown on a terminal only."""
    text = f"{what} {{task.fields[mean]:.0f}}{' %' if what == 'success' else ''}"
    layout = ("episodes", "bar", "count", text, "remaining")
    values: list[float] = []
    with progress_bar(layout, total, shown=shown and on_terminal(), mean=0.0) as update:

        def report(value: float) -> None:
            values.append(value)
            update(advance=1, mean=sum(values) / len(values))

        yield report
