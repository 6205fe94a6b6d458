"""The schedule of a rollout: slots for contestants, episodes for slots, seeds for episodes."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import AgentGroup, Contestant

DEFAULT_SLOTS = 192


class Plan(NamedTuple):
    """One contestant's slots: for each, which of its episodes it plays."""

    contestant: Contestant
    slots: list[list[int]]


def check_contestants(contestants: Sequence[Contestant]) -> None:
    """Refuse contestants that cannot be played.

    Raises:
        UserError: Names the contestant and what is wrong.
    """
    if not contestants:
        raise UserError("contestants is empty, expected at least one")
    for name, count in Counter(contestant.name for contestant in contestants).items():
        if count > 1:
            raise UserError(f"contestant '{name}' appears {count} times: names must differ")
    if len({id(contestant.actor) for contestant in contestants}) < len(contestants):
        raise UserError("two contestants share one actor object; give each its own, for example `agent.variant()`")
    for name, episodes, labels in ((one.name, one.episodes, one.labels) for one in contestants):
        if episodes < 1:
            raise UserError(f"contestant '{name}': episodes is {episodes}, expected 1 or more")
        if labels is not None and len(labels) != episodes:
            raise UserError(f"contestant '{name}': {len(labels)} labels for {episodes} episodes, expected one each")


def bundle(contestants: Sequence[Contestant]) -> list[tuple[Any, list[Contestant]]]:
    """Group contestants whose actors can act in one batch."""
    bundles: dict[Any, list[Contestant]] = {}
    for contestant in contestants:
        group = getattr(contestant.actor, "group_key", None)
        key = contestant.name if group is None else (type(contestant.actor), group)
        bundles.setdefault(key, []).append(contestant)
    return list(bundles.items())


def slots_needed(contestants: Sequence[Contestant], slots: int = DEFAULT_SLOTS) -> int:
    """Return how many environments a rollout of these contestants with `slots` uses."""
    return sum(len(plan.slots) for plan in plan_slots(contestants, slots))


def plan_slots(contestants: Sequence[Contestant], slots: int, most: int | None = None) -> list[Plan]:
    """Plan all contestants, with fewer slots each if only `most` are available."""
    episodes = sum(contestant.episodes for contestant in contestants)
    for limit in range(slots, 0, -1):
        plans = [_plan_one(contestant, limit * contestant.episodes / episodes) for contestant in contestants]
        total = sum(len(plan.slots) for plan in plans)
        if most is None or total <= most:
            return plans
    raise UserError(f"the pool has {most} environments, but these contestants need at least {total}")


def _plan_one(contestant: Contestant, share: float) -> Plan:
    """Split a contestant's episodes over its share of the slots, evenly, each slot with one label only."""
    labels = contestant.labels or [""] * contestant.episodes
    members: dict[str, list[int]] = {}
    for episode, label in enumerate(labels):
        members.setdefault(label, []).append(episode)
    most = max(map(len, members.values()))
    wide = max(1, int(share / len(members)))  # slots a label
    wide = -(-most // -(-most // wide))  # no wider than the longest slot's episodes need
    slots = [episodes[turn::wide] for turn in range(wide) for episodes in members.values()]
    return Plan(contestant, slots)


class ActorSlots(NamedTuple):
    """An actor and the range of slots that it plays, `low` to `high` - 1."""

    name: str
    actor: Any
    low: int
    high: int


def assign_slots(bundles: list[tuple[Any, list[Contestant]]], plans: list[Plan], seed: int) -> list[ActorSlots]:
    """Reset the actors for their slots, agents as an `AgentGroup`."""
    by_name = {plan.contestant.name: plan for plan in plans}
    assigned, low = [], 0
    for _, members in bundles:
        sizes = [len(by_name[member.name].slots) for member in members]
        seeds = [_actor_seed(seed, member.name) for member in members]
        actor = members[0].actor
        if hasattr(actor, "group_key"):
            actor = AgentGroup([member.actor for member in members])
            actor.reset(sizes, seeds)
        else:
            actor.reset(sizes[0], seeds[0])
        high = low + sum(sizes)
        assigned.append(ActorSlots(" + ".join(member.name for member in members), actor, low, high))
        low = high
    return assigned


def _actor_seed(seed: int, name: str) -> int:
    return int(np.random.SeedSequence([seed, zlib.crc32(name.encode())]).generate_state(1)[0])


def episode_seeds(contestant: Contestant, seed: int) -> list[int]:
    """Return the seed of each episode: the i-th of every label has the same."""
    counts: Counter[str] = Counter()
    seeds = []
    for episode in range(contestant.episodes):
        label = contestant.labels[episode] if contestant.labels else ""
        seeds.append(episode_seed(seed, counts[label]))
        counts[label] += 1
    return seeds


def episode_seed(seed: int, episode: int) -> int:
    """The environment seed of episode `episode` (counted within its label) of a rollout with `seed`."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0] >> 1)
