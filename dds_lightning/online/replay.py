"""The replay: transitions that were collected, in memory, the oldest overwritten when it is full."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dds_lightning.errors import UserError


class Replay:
    """Semi-MDP transitions, one row for each decision.

    Args:
        size: Rows that it holds at most.
        observation_dim: O.
        action_dim: D numbers of an action; 0 for codes.
        num_codes: K, where actions are codes; None leaves open how many there are.
    """

    def __init__(self, size: int, observation_dim: int, action_dim: int, num_codes: int | None = None) -> None:
        if size < 1:
            raise UserError(f"data.replay_size is {size}, expected at least 1")
        self.size, self.count, self.next = size, 0, 0
        self.num_codes = num_codes
        wide, codes = (size, observation_dim), action_dim == 0
        self.columns: dict[str, Tensor] = {
            "observations": torch.empty(wide),  # memory is taken when rows are written
            "actions": torch.empty(size, dtype=torch.int64) if codes else torch.empty(size, action_dim),
            "rewards": torch.empty(size),
            "next_observations": torch.empty(wide),
            "discounts": torch.empty(size),
            "dones": torch.empty(size),
        }

    def keep_steps(self, horizon: int, action_dim: int) -> None:
        """From now on keep the steps of every transition too: what was seen and done in each.

        Args:
            horizon: H steps at most.
            action_dim: A numbers of a primitive action.
        """
        if "steps" in self.columns:
            return
        width = self.columns["observations"].shape[1]
        self.columns |= {
            "steps": torch.empty(self.size, dtype=torch.int64),  # taken, H or fewer
            "step_observations": torch.empty(self.size, horizon, width),
            "step_actions": torch.empty(self.size, horizon, action_dim),
        }

    def __len__(self) -> int:
        """Rows with a transition."""
        return self.count

    def add(self, **row: Any) -> None:
        """Write one transition, a value for each column; of its steps as many as were taken."""
        for name, column in self.columns.items():
            if name.startswith("step_"):
                column[self.next, : row["steps"]] = torch.from_numpy(np.asarray(row[name], np.float32))
            else:
                column[self.next] = torch.as_tensor(row[name])
        self.next = (self.next + 1) % self.size
        self.count = min(self.count + 1, self.size)

    def sample(self, count: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw rows with replacement; of the steps of each, where they are kept, one: (count, O) and (count, A)."""
        index = torch.randint(self.count, (count,), generator=generator)
        batch = {name: column[index] for name, column in self.columns.items() if "step" not in name}
        if "steps" in self.columns:
            step = (torch.rand(count, generator=generator) * self.columns["steps"][index]).long()
            batch |= {name: self.columns[name][index, step] for name in ("step_observations", "step_actions")}
        return batch

    def state_dict(self) -> dict[str, Any]:
        """The rows that were written, and where the next goes."""
        rows = {name: column[: self.count].clone() for name, column in self.columns.items()}
        return {"rows": rows, "next": self.next, "size": self.size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over what `state_dict` returned.

        Raises:
            UserError: It is damaged, or has other columns: it is the replay of another task or another action space.
        """
        if state["size"] != self.size:
            raise UserError(
                f"data.replay_size is {self.size}, the checkpoint's replay has {state['size']}: give the same"
            )
        if "step_actions" in state["rows"]:
            self.keep_steps(*state["rows"]["step_actions"].shape[1:])
        if wrong := self._damage(state["rows"], state["next"]):
            raise UserError(
                f"the replay in the checkpoint is damaged ({wrong}): take an earlier checkpoint, or start from its "
                "weights with model.init_from"
            )
        for name, column in self.columns.items():
            if name not in state["rows"] and "step" in name:
                raise UserError(
                    "model.follow is above 0, but the checkpoint's replay has no steps to learn from: go on with 0, or "
                    "start a new training"
                )
            found = state["rows"][name]
            if found.shape[1:] != column.shape[1:] or found.dtype != column.dtype:
                raise UserError(
                    f"the replay in the checkpoint has {name} of {tuple(found.shape[1:])} ({found.dtype}), here they "
                    f"are {tuple(column.shape[1:])} ({column.dtype}): it is of another task or another action space"
                )
            column[: len(found)] = found
            self.count = len(found)
        self.next = int(state["next"])

    def _damage(self, rows: Mapping[str, Tensor], place: int) -> str | None:
        """What is wrong with the columns of a checkpoint, whose next row goes to `place`; None if nothing is."""
        if missing := [name for name in self.columns if name not in rows and "step" not in name]:
            return f"it lacks {', '.join(missing)}"
        count = len(rows["rewards"])
        for name, column in rows.items():
            if len(column) != count:
                return f"{name} has {len(column)} rows, rewards has {count}"
            if name not in ("step_observations", "step_actions") and not bool(torch.isfinite(column).all()):
                return f"{name} has numbers that are not finite"  # beyond its last step a row is whatever memory held
        if not 0 <= place < self.size or count > self.size or count not in (place, self.size):
            return f"its next row is {place}, with {count} of {self.size} rows"
        codes = rows["actions"]
        if self.num_codes is not None and codes.ndim == 1 and count:
            low, high = int(codes.min()), int(codes.max())
            if low < 0 or high >= self.num_codes:
                return f"codes run from {low} to {high}, expected 0 to {self.num_codes - 1}"
        return None
