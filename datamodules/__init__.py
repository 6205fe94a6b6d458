"""The data: trajectories, where they come from, and the batches that training reads.

Importing this package is cheap: nothing heavy is loaded before its name is used, so that the processes that
collect data never import a deep-learning library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dds_lightning._moved import redirect_old_paths

if TYPE_CHECKING:
    from datamodules.collect.pointmaze import WaypointController as WaypointController
    from datamodules.collect.pointmaze import collect_pointmaze as collect_pointmaze
    from datamodules.inspection import check_dataset as check_dataset
    from datamodules.inspection import describe as describe
    from datamodules.listing import find_datasets as find_datasets
    from datamodules.loader import TensorLoader as TensorLoader
    from datamodules.relabelled import RelabeledDataModule as RelabeledDataModule
    from datamodules.segments import SegmentDataModule as SegmentDataModule
    from datamodules.sources import load_trajectories as load_trajectories
    from datamodules.trajectories import Trajectories as Trajectories
    from datamodules.validation import DataError as DataError

redirect_old_paths()

_HOMES = {
    "DataError": "datamodules.validation",
    "RelabeledDataModule": "datamodules.relabelled",
    "SegmentDataModule": "datamodules.segments",
    "TensorLoader": "datamodules.loader",
    "Trajectories": "datamodules.trajectories",
    "WaypointController": "datamodules.collect.pointmaze",
    "check_dataset": "datamodules.inspection",
    "collect_pointmaze": "datamodules.collect.pointmaze",
    "describe": "datamodules.inspection",
    "find_datasets": "datamodules.listing",
    "load_trajectories": "datamodules.sources",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'datamodules' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
