"""What acts in environments: what an actor is, and how several agents share one decoder batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent


class Acted(NamedTuple):
    """What an actor did in one step, in n environments."""

    actions: NDArray[np.float32]
    """(n, A) in the environment's units."""
    codes: NDArray[np.int64] | None = None
    """(n,) the skill in use; None for an actor without skills."""
    chosen: NDArray[np.bool_] | None = None
    """(n,) whether the skill was chosen in this step."""


class Actor(Protocol):
    """An agent, a controller, a baseline; anything that a `Contestant` plays with.

    One that has a method `paid(rewards, rows)` is told after every step what its actions (n,) earned in `rows`.
    """

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Forget everything and get ready for `num_envs` environments."""

    def act(
        self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]
    ) -> Acted | NDArray[np.float32]:
        """Act in the environments `rows`; the others have played their last episode.

        Args:
            observations: (n, O), one for each of `rows`.
            restarted: (n,), which of them have just begun an episode.
            rows: (n,), indices among `num_envs`, ascending.

        Returns:
            What it did; the actions (n, A) alone are enough for an actor without skills.
        """
        ...


class RandomActor:
    """Uniform actions in the box; the least that any other actor must beat.

    Args:
        action_dim: A.
        low: Lower bound of every action entry.
        high: Upper bound of every action entry.
    """

    def __init__(self, action_dim: int, low: float = -1.0, high: float = 1.0) -> None:
        """Keep the box."""
        self.action_dim, self.low, self.high = action_dim, low, high
        self._random = np.random.default_rng(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Restart the random stream."""
        self._random = np.random.default_rng(seed)

    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]) -> Acted:
        """As `Actor.act`."""
        return Acted(self._random.uniform(self.low, self.high, (len(rows), self.action_dim)).astype(np.float32))


class AgentGroup:
    """One or several agents on one skill model as one actor: each chooses its codes, one decoder batch acts for all.

    Rows are the agents' environments, one agent after the other. A small decoder batch costs almost as much
    as a large one, so this is what makes a table of many contestants cheap.

    Args:
        agents: With equal `group_key`, no agent twice.
    """

    def __init__(self, agents: Sequence[DDSAgent]) -> None:
        """Keep the agents."""
        assert len({agent.group_key for agent in agents}) == 1, "agents of a group share model and noise"
        self.agents = list(agents)
        self._starts = np.zeros(len(agents) + 1, dtype=np.intp)

    def reset(self, sizes: Sequence[int], seeds: Sequence[int]) -> None:
        """Reset agent i for `sizes[i]` environments with `seeds[i]`; the first's stream is the decoder's."""
        for agent, size, seed in zip(self.agents, sizes, seeds, strict=True):
            agent.reset(size, seed)
        self._starts = np.concatenate([[0], np.cumsum(sizes)])

    @torch.inference_mode()
    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]) -> Acted:
        """As `Actor.act`, rows counted over all agents."""
        lead = self.agents[0]
        x = lead.observe(observations)  # (n, O)
        cuts = np.searchsorted(rows, self._starts)
        codes, chosen = [], []
        for i, agent in enumerate(self.agents):
            part = slice(cuts[i], cuts[i + 1])
            own = rows[part] - self._starts[i]
            codes.append(agent.choose(x[part], restarted[part], own))
            chosen.append(agent.decided[own])
        in_use = np.concatenate(codes)  # (n,) codes, or (n, D) continuous skills, which have no number to note
        acted = lead.decode(x, in_use)
        return Acted(acted, in_use, np.concatenate(chosen)) if in_use.ndim == 1 else Acted(acted)


@dataclass(frozen=True)
class Contestant:
    """Who plays, and how often.

    Attributes:
        name: Shown in the table; unique within a rollout.
        actor: An `Actor`, or a `DDSAgent`.
        episodes: How many it plays.
        labels: One for each episode, for a contestant of several parts (each single skill). With L different
            labels, row r of the actor plays only episodes of label r modulo L, in order of first appearance.
    """

    name: str
    actor: Any
    episodes: int
    labels: Sequence[str] | None = None


def single_skills(agent: Any, episodes_each: int = 20, name: str = "single skill") -> Contestant:
    """Every skill replayed alone, `episodes_each` times, labelled "skill 0", "skill 1" and so on."""
    count = agent.num_skills
    labels = [f"skill {k}" for k in range(count)] * episodes_each
    return Contestant(name, agent.variant("fixed", fixed_codes=np.arange(count)), len(labels), labels)
