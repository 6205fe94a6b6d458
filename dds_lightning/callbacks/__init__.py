"""Callbacks of a training: evaluation by rollouts, exact resuming, a guard against infinite losses, speed."""

from dds_lightning.callbacks.compiled import CompiledLoss as CompiledLoss
from dds_lightning.callbacks.guard import FiniteGuard as FiniteGuard
from dds_lightning.callbacks.resume import ExactResume as ExactResume
from dds_lightning.callbacks.rollouts import RolloutEvaluation as RolloutEvaluation
from dds_lightning.callbacks.several import SeveralUpdates as SeveralUpdates
