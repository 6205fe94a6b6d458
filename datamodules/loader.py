"""Batches by index from tensors in memory, in an order that can be taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dds_lightning.errors import UserError

Batch = dict[str, Tensor]


def overfits(trainer: Any) -> bool:
    """Whether a Trainer, if there is one, was asked to train and validate on the same few batches."""
    return trainer is not None and trainer.overfit_batches > 0


def data_state(data: Any) -> dict[str, str]:
    """What a data module puts into a checkpoint about its `Trajectories`."""
    return {"name": data.name, "fingerprint": data.fingerprint()}


def refuse_other_data(state: Mapping[str, str], data: Any, trainer: Any) -> None:
    """Refuse a training that goes on with other `Trajectories` than it began with.

    Args:
        state: As `data_state` returned it.
        data: The trajectories of now.
        trainer: Of the data module; None where there is none.

    Raises:
        UserError: They differ, and the trainer trains.
    """
    trains = trainer is None or trainer.state.fn == "fit"
    if trains and state.get("fingerprint") not in (None, data.fingerprint()):
        raise UserError(
            f"data.data: the checkpoint was trained on {state['name']} ({state['fingerprint'][:8]}), these are "
            f"{data.name} ({data.fingerprint()[:8]}), other data: give the same, or start anew from its weights with "
            "--model.init_from"
        )


def refuse_other_rounds(trainer: Any) -> None:
    """Refuse a Trainer of online training whose steps are not those that `data.updates` counts.

    Raises:
        UserError: It has several processes, which would all collect the same, or adds up several batches.
    """
    if trainer.world_size > 1:
        raise UserError(
            f"the Trainer has {trainer.world_size} processes, expected 1: online, one process collects for one policy; "
            "leave out trainer.devices, and raise data.num_envs for more environments side by side"
        )
    if trainer.accumulate_grad_batches != 1:
        raise UserError(
            f"trainer.accumulate_grad_batches is {trainer.accumulate_grad_batches}, expected 1: data.updates counts "
            "batches; raise data.batch_size instead"
        )


class TensorLoader:
    """Batches by index, in an order that is a function of (seed, epoch).

    Shuffled batches are an endless stream of epochs, each a new permutation; an iteration hands out the next
    `len(self)` of them, so one that was left early is taken up where it stopped. Without shuffling every
    iteration begins at the first item. `state_dict` and `load_state_dict` hold the place in the stream, to
    the batch; Lightning saves and restores them by itself. There are no workers: indexing is cheaper than a
    message.

    Attributes:
        group: With more than one, an iteration hands out lists of so many batches, as many lists as it would batches:
            the stream goes on across epochs.
    """

    def __init__(
        self,
        gather: Callable[[Tensor], Batch],
        size: int,
        batch_size: int,
        shuffle: bool = False,
        seed: int = 0,
        *,
        drop_last: bool = False,
        rank: int = 0,
        world_size: int = 1,
        device: torch.device | str = "cpu",
    ) -> None:
        """Prepare to iterate.

        Args:
            gather: (B,) int64 indices on `device` -> a batch.
            size: Number of items; indices run from 0 to size - 1.
            batch_size: B; no larger than `size`.
            shuffle: Permute at every epoch; else the order is always 0, 1, 2, ...
            seed: Of the permutations.
            drop_last: Leave out a last batch that is not full.
            rank: Number of this process; it takes every `world_size`-th item.
            world_size: Number of processes.
            device: Where the indices go.
        """
        if size < world_size:
            raise UserError(f"data: got {size} items for {world_size} processes, expected at least one each")
        if batch_size < 1:
            raise UserError(f"batch_size: got {batch_size}, expected at least 1")
        self.gather, self.size, self.shuffle, self.seed = gather, size, shuffle, seed
        self.rank, self.world_size, self.device = rank, world_size, torch.device(device)
        self._share = size // world_size
        self.batch_size = min(batch_size, self._share)
        self.drop_last = drop_last
        self.group = 1
        self._epoch, self._batch, self._resuming = 0, 0, False

    def __len__(self) -> int:
        """Batches of an epoch."""
        full, rest = divmod(self._share, self.batch_size)
        return full + (0 if self.drop_last or not rest else 1)

    def order(self, epoch: int) -> Tensor:
        """(size,) the items in the order of `epoch`, before they are divided among processes."""
        if not self.shuffle:
            return torch.arange(self.size)
        entropy = np.random.SeedSequence([self.seed, epoch]).generate_state(1, np.uint64)[0]
        generator = torch.Generator().manual_seed(int(entropy >> np.uint64(1)))
        return torch.randperm(self.size, generator=generator)

    def __iter__(self) -> Iterator[Batch | list[Batch]]:
        """The next `len(self)` batches, or groups of them, of the stream; without shuffling, those of one epoch."""
        # All of this runs at the first `next`: Lightning makes iterators that it never starts. Nothing after
        # the last `yield` matters: it does not exhaust those that it does start.
        if not self.shuffle and not self._resuming:
            self._epoch, self._batch = 0, 0
        count = len(self) if self.shuffle else len(self) - self._batch
        self._resuming = False
        stream = self._stream()
        for _ in range(count):
            yield next(stream) if self.group == 1 else list(islice(stream, self.group))

    def _stream(self) -> Iterator[Batch]:
        """Batches without an end."""
        order = self._share_of(self._epoch)
        while True:
            if self._batch >= len(self):
                self._epoch, self._batch = self._epoch + 1, 0
                order = self._share_of(self._epoch)
            start = self._batch * self.batch_size
            self._batch += 1
            yield self.gather(order[start : start + self.batch_size])

    def _share_of(self, epoch: int) -> Tensor:
        return self.order(epoch)[self.rank :: self.world_size][: self._share].to(self.device)

    def state_dict(self) -> dict[str, int]:
        """Epoch, batches handed out, and what the order depends on."""
        return {"epoch": self._epoch, "batch": self._batch, **self._identity()}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Go on where `state` was taken.

        Raises:
            UserError: When the loader would hand out other batches than the one whose state this is.
        """
        for key, own in self._identity().items():
            if state.get(key) != own:
                raise UserError(
                    f"data: the checkpoint was made with {key} = {state.get(key)}, now it is {own}; resume "
                    "with the same data and batch size"
                )
        self._epoch, self._batch, self._resuming = state["epoch"], state["batch"], True

    def _identity(self) -> dict[str, int]:
        return {
            "size": self.size, "batch_size": self.batch_size, "seed": self.seed, "shuffle": int(self.shuffle)
        }  # fmt: skip
