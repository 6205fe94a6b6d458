"""Vectorised episodes of several contestants over real environments, and one result row an episode.

Contestants play side by side in one `EnvPool`. Each has slots of its own and a fixed split of its episodes
over them, so an episode that fails slowly counts as much as one that succeeds fast. Episode i of every
contestant starts from the same environment seed: comparisons are paired.

The same call gives the same table: it depends on task, contestants, `seed` and `slots` (the rows of a batch
share the actor's random stream), not on `workers`.
"""

from __future__ import annotations

import contextlib
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dds_lightning.actors import Actor, Contestant
from dds_lightning.actors import single_skills as single_skills
from dds_lightning.envpool import EnvPool, available_cores
from dds_lightning.errors import UserError
from dds_lightning.results import RolloutPath as RolloutPath
from dds_lightning.results import RolloutResult as RolloutResult
from dds_lightning.tasks import Task, get_task

DEFAULT_SLOTS = 192
OVERLAP = range(24, 4096)
"""Slots with which acting and stepping overlap: half a batch must be worth acting for."""


class _Plan(NamedTuple):
    """One contestant's slots: for each, which of its episodes it plays."""

    contestant: Contestant
    slots: list[list[int]]


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

    Returns:
        The table of episodes, in the contestants' order, and the recorded paths.

    Raises:
        UserError: contestants that cannot be played; the message names them.
        EnvPoolError: an environment failed.
    """
    task = get_task(task) if isinstance(task, str) else task
    _check(contestants)
    if slots < 1:
        raise UserError(f"slots is {slots}, expected at least 1")
    if pool is not None and pool.task != task:
        raise UserError(f"the pool has environments of '{pool.task.name}', expected '{task.name}'")
    bundles = _bundles(contestants)
    members = [contestant for _, own in bundles for contestant in own]
    plans = _plans(members, slots, pool.num_envs if pool else None)
    total = sum(len(plan.slots) for plan in plans)
    with contextlib.ExitStack() as stack:
        if pool is None:
            pool = stack.enter_context(EnvPool(task, total, workers))
        report = stack.enter_context(_progress_bar(sum(plan.contestant.episodes for plan in plans), progress))
        match = _Match(pool, plans, seed, record or record_observations, record_observations, report)
        stack.enter_context(_few_threads(pool.workers))
        rows = match.play(_seated(bundles, plans, seed))
    order = {contestant.name: i for i, contestant in enumerate(contestants)}
    rows.sort(key=lambda row: (order[row["actor"]], row["episode"]))
    paths = {(row["actor"], row["episode"]): row.pop("path") for row in rows}
    return RolloutResult(task.name, pd.DataFrame(rows), {key: path for key, path in paths.items() if path})


def episode_seed(seed: int, episode: int) -> int:
    """The environment seed of episode `episode` (counted within its label) of a rollout with `seed`."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0] >> 1)


# ---------------------------------------------------------------------- who sits where


def _check(contestants: Sequence[Contestant]) -> None:
    if not contestants:
        raise UserError("contestants is empty: there is nobody to play")
    for name, count in Counter(contestant.name for contestant in contestants).items():
        if count > 1:
            raise UserError(f"contestant '{name}' appears {count} times: names must differ")
    if len({id(contestant.actor) for contestant in contestants}) < len(contestants):
        raise UserError("two contestants share one actor object; give each its own (an agent's `variant()`)")
    for contestant in contestants:
        if contestant.episodes < 1:
            raise UserError(f"contestant '{contestant.name}': episodes is {contestant.episodes}, expected 1 or more")
        if contestant.labels is not None and len(contestant.labels) != contestant.episodes:
            raise UserError(
                f"contestant '{contestant.name}': {len(contestant.labels)} labels for {contestant.episodes} "
                "episodes, expected one each"
            )


def _bundles(contestants: Sequence[Contestant]) -> list[tuple[Any, list[Contestant]]]:
    """Contestants whose actors can act in one batch, together."""
    bundles: dict[Any, list[Contestant]] = {}
    for contestant in contestants:
        key = getattr(contestant.actor, "group_key", None)
        bundles.setdefault(contestant.name if key is None else (type(contestant.actor), key), []).append(contestant)
    return list(bundles.items())


def slots_needed(contestants: Sequence[Contestant], slots: int = DEFAULT_SLOTS) -> int:
    """Environments that a rollout of these contestants with `slots` uses."""
    return sum(len(plan.slots) for plan in _plans(contestants, slots))


def _plans(contestants: Sequence[Contestant], slots: int, most: int | None = None) -> list[_Plan]:
    """Everybody's plan, with fewer slots each if there are no more than `most`."""
    episodes = sum(contestant.episodes for contestant in contestants)
    for limit in range(slots, 0, -1):
        plans = [_plan(contestant, limit * contestant.episodes / episodes) for contestant in contestants]
        total = sum(len(plan.slots) for plan in plans)
        if most is None or total <= most:
            return plans
    raise UserError(f"the pool has {most} environments, but these contestants need at least {total}")


def _plan(contestant: Contestant, share: float) -> _Plan:
    """Split a contestant's episodes over its share of the slots, evenly, each slot with one label only."""
    labels = contestant.labels or [""] * contestant.episodes
    members: dict[str, list[int]] = {}
    for episode, label in enumerate(labels):
        members.setdefault(label, []).append(episode)
    most = max(map(len, members.values()))
    wide = max(1, int(share / len(members)))  # slots a label
    wide = -(-most // -(-most // wide))  # no wider than the longest slot's episodes need
    slots = [own[turn::wide] for turn in range(wide) for own in members.values()]
    return _Plan(contestant, slots)


class _Seat(NamedTuple):
    """An actor and the range of slots it plays."""

    name: str
    actor: Actor
    low: int
    high: int


def _seated(bundles: list[tuple[Any, list[Contestant]]], plans: list[_Plan], seed: int) -> list[_Seat]:
    """Reset the actors, grouped ones as one actor."""
    by_name = {plan.contestant.name: plan for plan in plans}
    seats, low = [], 0
    for _, members in bundles:
        sizes = [len(by_name[member.name].slots) for member in members]
        seeds = [_actor_seed(seed, member.name) for member in members]
        actor = members[0].actor
        if len(members) > 1:
            actor = actor.group([member.actor for member in members])
            actor.reset(sizes, seeds)
        else:
            actor.reset(sizes[0], seeds[0])
        seats.append(_Seat(" + ".join(member.name for member in members), actor, low, low + sum(sizes)))
        low = seats[-1].high
    return seats


def _actor_seed(seed: int, name: str) -> int:
    return int(np.random.SeedSequence([seed, zlib.crc32(name.encode())]).generate_state(1)[0])


# ---------------------------------------------------------------------- playing


class _Match:
    """The state of a rollout in progress: one entry a slot."""

    def __init__(
        self,
        pool: EnvPool,
        plans: list[_Plan],
        seed: int,
        record: bool,
        record_observations: bool,
        report: Callable[[bool], None],
    ) -> None:
        self.pool, self.task, self.report = pool, pool.task, report
        self.who = [plan.contestant for plan in plans for _ in plan.slots]
        self.todo = [list(own) for plan in plans for own in plan.slots]
        self.seeds = [_episode_seeds(plan.contestant, seed) for plan in plans for _ in plan.slots]
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

    def play(self, seats: list[_Seat]) -> list[dict[str, Any]]:
        """Play to the end; a row an episode, in the order in which they end."""
        pool = self.pool
        start = pool.start([[own[i] for i in todo] for own, todo in zip(self.seeds, self.todo, strict=True)])
        self.observations, self.restarted = start["observation"].copy(), start["alive"].copy()
        alive = pool.alive
        self._remember(alive, start["position"][alive], start["observation"][alive])
        # Two halves take turns: while the workers step one, the actors act for the other.
        halves = [alive[alive % 2 == half] for half in (0, 1)] if len(alive) in OVERLAP else [alive]
        for half in halves:
            pool.send(half, self._act(seats, half))
        rows: list[dict[str, Any]] = []
        while pool.busy:
            slots, records = pool.receive()
            rows += self._note(slots, records)
            more = slots[records["alive"]]
            if len(more):
                pool.send(more, self._act(seats, more))
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
            self.report(row["success"])
        again = ended & records["alive"]
        self.restarted[slots] = again
        self.observations[slots] = records["observation"]
        self._remember(slots[again], records["position"][again], records["observation"][again])
        return rows

    def _act(self, seats: list[_Seat], slots: NDArray[np.intp]) -> NDArray[np.float32]:
        """Everybody's actions (n, A) for some live slots, ascending."""
        actions = np.empty((len(slots), self.task.action_dim), np.float32)
        for seat in seats:
            low, high = np.searchsorted(slots, (seat.low, seat.high))
            if low < high:
                actions[low:high] = self._act_one(seat, slots[low:high])
        return actions

    def _act_one(self, seat: _Seat, slots: NDArray[np.intp]) -> NDArray[np.float32]:
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


def _episode_seeds(contestant: Contestant, seed: int) -> list[int]:
    """Seed of each episode: the i-th of every label has the same."""
    counts: Counter[str] = Counter()
    seeds = []
    for episode in range(contestant.episodes):
        label = contestant.labels[episode] if contestant.labels else ""
        seeds.append(episode_seed(seed, counts[label]))
        counts[label] += 1
    return seeds


@contextlib.contextmanager
def _few_threads(workers: int) -> Iterator[None]:
    """Let torch use only the cores that the workers leave: threads that wait for a core cost far more than
    they bring."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(min(before, max(1, available_cores() - workers)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _progress_bar(total: int, wanted: bool) -> Iterator[Callable[[bool], None]]:
    """A bar of episodes done and the share that succeeded so far, on standard error; silent elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not (wanted and console.is_terminal):
        yield lambda success: None
        return
    columns = (
        TextColumn("episodes"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("success {task.fields[share]:.0f} %"),
        TimeRemainingColumn(),
    )
    successes = 0
    with Progress(*columns, console=console, transient=True) as bar:
        line = bar.add_task("episodes", total=total, share=0.0)

        def report(success: bool) -> None:
            nonlocal successes
            successes += success
            done = bar.tasks[0].completed + 1
            bar.update(line, advance=1, share=100.0 * successes / done)

        yield report
