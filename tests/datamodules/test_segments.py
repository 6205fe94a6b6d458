from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from torch import Tensor

from datamodules.loader import TensorLoader
from datamodules.segments import STD_FLOOR, SegmentDataModule
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError

Make = Callable[..., dict[str, Any]]

torch.set_num_threads(1)


def _identity(index: Tensor) -> dict[str, Tensor]:
    return {"index": index}


def _loader(**options: Any) -> TensorLoader:
    return TensorLoader(_identity, **{"size": 23, "batch_size": 5, "shuffle": True, "seed": 4, **options})


def _epoch(loader: TensorLoader) -> list[list[int]]:
    return [batch["index"].tolist() for batch in loader]


def _flat(batches: list[list[int]]) -> list[int]:
    return [item for batch in batches for item in batch]


# ---------------------------------------------------------------------- TensorLoader


def test_every_item_is_seen_once_an_epoch() -> None:
    loader = _loader()
    batches = _epoch(loader)
    assert [len(batch) for batch in batches] == [5, 5, 5, 5, 3]
    assert sorted(_flat(batches)) == list(range(23))
    assert len(loader) == 5


def test_drop_last_leaves_out_what_is_not_full() -> None:
    loader = _loader(drop_last=True)
    assert [len(batch) for batch in _epoch(loader)] == [5, 5, 5, 5]
    assert len(loader) == 4


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    first, second = _loader(), _loader()
    torch.manual_seed(123)  # the global generator has no say
    epochs = [_epoch(first), _epoch(first)]
    assert epochs == [_epoch(second), _epoch(second)]
    assert epochs[0] != epochs[1]
    assert _epoch(_loader(seed=5)) != epochs[0]
    assert torch.cat([torch.tensor(b) for b in epochs[1]]).equal(first.order(1))


def test_iterating_leaves_the_global_generator_alone() -> None:
    before = torch.random.get_rng_state()
    _epoch(_loader())
    assert torch.random.get_rng_state().equal(before)


def test_without_shuffle_the_order_is_that_of_the_items() -> None:
    loader = _loader(shuffle=False)
    assert _flat(_epoch(loader)) == _flat(_epoch(loader)) == list(range(23))


def _take(loader: TensorLoader, count: int) -> list[list[int]]:
    """`count` batches, in iterations that are left as soon as there are enough."""
    taken: list[list[int]] = []
    while True:
        for batch in loader:
            taken.append(batch["index"].tolist())
            if len(taken) == count:
                return taken


@pytest.mark.parametrize("stop", range(1, 11))
def test_resuming_anywhere_gives_the_batches_that_were_left(stop: int) -> None:
    halted = _loader()
    seen = _take(halted, stop)
    resumed = _loader()
    resumed.load_state_dict(halted.state_dict())
    assert seen + _take(resumed, 15 - stop) == _take(_loader(), 15)


def test_iterations_left_early_lose_nothing() -> None:
    loader = _loader()
    iter(loader)  # never started: does not count
    assert _take(loader, 3) + _take(loader, 3) + _take(loader, 4) == _take(_loader(), 10)


def test_without_shuffle_only_a_restored_iteration_starts_in_the_middle() -> None:
    loader = _loader(shuffle=False)
    assert _take(loader, 2) == _take(loader, 2)
    resumed = _loader(shuffle=False)
    resumed.load_state_dict(loader.state_dict())
    assert [batch[0] for batch in _epoch(resumed)] == [10, 15, 20]
    assert [batch[0] for batch in _epoch(resumed)] == [0, 5, 10, 15, 20]


def test_a_state_of_other_data_is_refused() -> None:
    state = _loader().state_dict()
    with pytest.raises(UserError, match="made with batch_size = 5, now it is 6"):
        _loader(batch_size=6).load_state_dict(state)
    with pytest.raises(UserError, match="made with size = 23, now it is 24"):
        _loader(size=24).load_state_dict(state)


def test_processes_share_an_epoch_without_overlap() -> None:
    parts = [_flat(_epoch(_loader(rank=rank, world_size=2))) for rank in (0, 1)]
    assert [len(part) for part in parts] == [11, 11]
    assert len(set(parts[0]) | set(parts[1])) == 22


def test_a_batch_larger_than_the_data_is_the_data() -> None:
    assert [len(b) for b in _epoch(_loader(batch_size=100, drop_last=True))] == [23]
    with pytest.raises(UserError, match="batch_size: got 0"):
        _loader(batch_size=0)
    with pytest.raises(UserError, match="got 0 items for 1 processes"):
        _loader(size=0)


# ---------------------------------------------------------------------- SegmentDataModule


@pytest.fixture
def data(make_episode: Make) -> Trajectories:
    return Trajectories.from_episodes("made", [make_episode(12 + e % 3, e) for e in range(20)])


def _batches(loader: Any) -> dict[str, Tensor]:
    batches = list(loader)
    return {key: torch.cat([batch[key] for batch in batches]) for key in batches[0]}


def test_batches_are_segments_of_one_episode(data: Trajectories) -> None:
    module = SegmentDataModule.from_trajectories(data, horizon=4, batch_size=8)
    assert (module.observation_dim, module.action_dim, module.horizon) == (2, 1, 4)
    batch = next(iter(module.train_dataloader()))
    assert {key: tuple(value.shape) for key, value in batch.items()} == {
        "observations": (8, 4, 2),
        "actions": (8, 4, 1),
        "starts": (8,),
    }
    assert [value.dtype for value in batch.values()] == [torch.float32, torch.float32, torch.int64]
    assert torch.equal(torch.from_numpy(data.actions)[batch["starts"]], batch["actions"][:, 0])
    everything = _batches(module.predict_dataloader())
    observations, actions = everything["observations"], everything["actions"]
    assert len(observations) == sum(12 + e % 3 - 3 for e in range(20))
    assert (observations[:, :, 0] == observations[:, :1, 0]).all()  # column 0 is the episode
    torch.testing.assert_close(observations[:, :, 1] / 100, actions[:, :, 0])  # action t is t / 100
    assert (observations[:, 1:, 1] - observations[:, :-1, 1] == 1).all()


@pytest.mark.parametrize(("stride", "count"), [(1, 10), (2, 5), (4, 3)])
def test_stride_thins_the_windows(make_episode: Make, stride: int, count: int) -> None:
    data = Trajectories.from_episodes("one", [make_episode(13)])
    module = SegmentDataModule.from_trajectories(data, horizon=4, stride=stride, validation_fraction=0.0)
    starts = _batches(module.predict_dataloader())["observations"][:, 0, 1]
    assert starts.tolist() == [stride * k for k in range(count)]


def test_training_and_validation_share_no_episode(data: Trajectories) -> None:
    module = SegmentDataModule.from_trajectories(data, horizon=4, validation_fraction=0.2, batch_size=1)
    parts = [
        set(_batches(loader)["observations"][:, :, 0].flatten().tolist())
        for loader in (module.train_dataloader(), module.val_dataloader())
    ]
    assert parts[0] | parts[1] == set(range(20))
    assert not parts[0] & parts[1]
    assert 0.2 <= len(parts[1]) / 20 <= 0.25


def test_validation_is_the_same_every_time_and_bounded(data: Trajectories) -> None:
    module = SegmentDataModule.from_trajectories(data, horizon=4, validation_fraction=0.5, max_validation_segments=7)
    loader = module.val_dataloader()
    first, second = _batches(loader), _batches(loader)
    assert len(first["actions"]) == 7
    torch.testing.assert_close(first, second)
    episodes = set(first["observations"][:, 0, 0].tolist())
    assert {module.validation_episodes[0], module.validation_episodes[-1]} <= episodes


def test_the_first_validation_batches_are_a_fair_sample_of_all_held_out_episodes(make_episode: Make) -> None:
    """In many a file one controller's episodes come before another's; a training looks at a few batches only."""
    data = Trajectories.from_episodes("two controllers", [make_episode(90, int(i >= 20)) for i in range(40)])
    module = SegmentDataModule.from_trajectories(data, horizon=4, batch_size=64, validation_fraction=0.5)
    module.setup()
    late = float(np.mean(np.asarray(module.validation_episodes) >= 20))
    first = next(iter(module.val_dataloader()))["observations"][:, 0, 0]
    assert first.mean().item() == pytest.approx(late, abs=0.2)


def test_no_validation_when_none_is_asked_for(data: Trajectories) -> None:
    module = SegmentDataModule.from_trajectories(data, horizon=4, validation_fraction=0.0)
    assert module.val_dataloader() == []
    assert len(module.training_episodes) == 20


def test_statistics_are_of_the_training_episodes(data: Trajectories) -> None:
    module = SegmentDataModule.from_trajectories(data, horizon=4, validation_fraction=0.3)
    found = module.statistics()
    rows = np.concatenate([data.episode(e)["observations"] for e in module.training_episodes]).astype(np.float64)
    np.testing.assert_allclose(found["observation_mean"], rows.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found["observation_std"], rows.std(axis=0), rtol=1e-6)
    assert found["action_low"].tolist() == [-1]
    assert found["action_high"].tolist() == [1]
    assert {value.dtype for value in found.values()} == {torch.float32}


def test_a_constant_observation_has_the_floor_for_deviation(make_episode: Make) -> None:
    data = Trajectories.from_episodes("still", [make_episode(12, 7), make_episode(12, 7)])
    std = SegmentDataModule.from_trajectories(data, horizon=4).statistics()["observation_std"]
    assert std[0].item() == pytest.approx(STD_FLOOR)
    assert std[1] > 1


def test_memory_mapped_data_give_the_same_batches(data: Trajectories, tmp_path: Path) -> None:
    mapped = Trajectories.load(data.save(tmp_path / "arrays"), mmap=True)
    options: dict[str, Any] = {"horizon": 4, "seed": 2}
    ours = SegmentDataModule.from_trajectories(data, **options)
    theirs = SegmentDataModule.from_trajectories(mapped, **options)
    torch.testing.assert_close(_batches(ours.train_dataloader()), _batches(theirs.train_dataloader()))
    torch.testing.assert_close(ours.statistics(), theirs.statistics())


def test_the_task_alone_tells_the_shapes_and_how_to_get_data() -> None:
    module = SegmentDataModule(task="pointmaze-large-diverse")
    assert (module.observation_dim, module.action_dim) == (4, 2)
    with pytest.raises(UserError, match=r"data: none were given for task .*`dds data collect pointmaze-large-diverse"):
        module.setup()


def test_neither_task_nor_data_is_an_error() -> None:
    with pytest.raises(UserError, match="expected a task or data, got neither"):
        SegmentDataModule().setup()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "pointmaze-large"}, "no task 'pointmaze-large'"),
        ({"horizon": 0}, "horizon: got 0"),
        ({"stride": 0}, "stride: got 0"),
        ({"batch_size": 0}, "batch_size: got 0"),
        ({"validation_fraction": 1.0}, "validation_fraction: got 1.0"),
        ({"max_validation_segments": 0}, "max_validation_segments: got 0"),
    ],
)
def test_settings_out_of_range_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        SegmentDataModule(**options)


def test_a_horizon_longer_than_every_episode_is_refused(data: Trajectories) -> None:
    with pytest.raises(DataError, match="horizon 15 is longer than every one of the 20 episodes"):
        SegmentDataModule.from_trajectories(data, horizon=15).setup()


class _Listener(pl.LightningModule):
    """Learns nothing; writes down what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.heard: list[list[float]] = []

    def training_step(self, batch: dict[str, Tensor]) -> Tensor:
        self.heard.append((batch["observations"][:, 0, 0] * 100 + batch["observations"][:, 0, 1]).tolist())
        return self.weight.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def _fit(
    data: Trajectories, folder: Path, steps: int, checkpoint: Path | None = None, **options: Any
) -> tuple[_Listener, pl.Trainer]:
    module = SegmentDataModule.from_trajectories(data, horizon=4, batch_size=32, validation_fraction=0.0)
    listener = _Listener()
    trainer = pl.Trainer(
        accelerator="cpu",
        max_steps=steps,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        **options,
    )
    trainer.fit(listener, module, ckpt_path=checkpoint, weights_only=True if checkpoint else None)
    return listener, trainer


@pytest.mark.parametrize("limit", [None, 4])
@pytest.mark.parametrize("stop", [1, 4, 6, 7, 8, 12])  # 6 batches an epoch: in the middle and at its end
def test_lightning_resumes_at_the_very_batch(data: Trajectories, tmp_path: Path, stop: int, limit: int | None) -> None:
    whole, _ = _fit(data, tmp_path, 15, limit_train_batches=limit)
    first, trainer = _fit(data, tmp_path, stop, limit_train_batches=limit)
    trainer.save_checkpoint(tmp_path / "at.ckpt")
    second, _ = _fit(data, tmp_path, 15, tmp_path / "at.ckpt", limit_train_batches=limit)
    assert len(whole.heard) == 15
    assert first.heard + second.heard == whole.heard


def test_it_warns_where_whole_episodes_hold_out_far_more_than_was_asked_for(make_episode: Make) -> None:
    few, many = (Trajectories.from_episodes("d", [make_episode(30) for _ in range(count)]) for count in (2, 10))
    with pytest.warns(UserWarning, match=r"validation_fraction is 0\.05, .* with 2 of them that is 50% of the steps"):
        SegmentDataModule.from_trajectories(few, horizon=5).setup()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SegmentDataModule.from_trajectories(many, horizon=5).setup()
