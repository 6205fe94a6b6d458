"""The replay: transitions that were collected, in memory, the oldest overwritten when it is full."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dds_lightning.errors import UserError


class Replay:
    """Semi-MDP transitions, one row for each decision.

    Args:
        size: Rows that it holds at most.
        observation_dim: O.
        action_dim: D numbers of an action; 0 for codes.
    """

    def __init__(self, size: int, observation_dim: int, action_dim: int) -> None:
        if size < 1:
            raise UserError(f"data.replay_size is {size}, expected at least 1")
        self.size, self.count, self.next = size, 0, 0
        wide, codes = (size, observation_dim), action_dim == 0
        self.columns: dict[str, Tensor] = {
            "observations": torch.empty(wide),  # memory is taken when rows are written
            "actions": torch.empty(size, dtype=torch.int64) if codes else torch.empty(size, action_dim),
            "rewards": torch.empty(size),
            "next_observations": torch.empty(wide),
            "discounts": torch.empty(size),
            "dones": torch.empty(size),
        }

    def __len__(self) -> int:
        """Rows with a transition."""
        return self.count

    def add(self, **row: Any) -> None:
        """Write one transition, a value for each column."""
        for name, column in self.columns.items():
            column[self.next] = torch.as_tensor(row[name])
        self.next = (self.next + 1) % self.size
        self.count = min(self.count + 1, self.size)

    def sample(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw rows with replacement."""
        index = torch.randint(self.count, (count,), generator=generator)
        return {name: column[index] for name, column in self.columns.items()}

    def state_dict(self) -> dict[str, Any]:
        """The rows that were written, and where the next goes."""
        rows = {name: column[: self.count].clone() for name, column in self.columns.items()}
        return {"rows": rows, "next": self.next, "size": self.size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over what `state_dict` returned.

        Raises:
            UserError: It has other columns: it is the replay of another task or another action space.
        """
        if state["size"] != self.size:
            raise UserError(
                f"data.replay_size is {self.size}, the checkpoint's replay has {state['size']}: give the same"
            )
        for name, column in self.columns.items():
            found = state["rows"][name]
            if found.shape[1:] != column.shape[1:] or found.dtype != column.dtype:
                raise UserError(
                    f"the replay in the checkpoint has {name} of {tuple(found.shape[1:])} ({found.dtype}), here they "
                    f"are {tuple(column.shape[1:])} ({column.dtype}): it is of another task or another action space"
                )
            column[: len(found)] = found
            self.count = len(found)
        self.next = int(state["next"])
