"""Callbacks of a training: evaluation by rollouts, exact resuming, the guard against losses that are not finite."""

from dds_lightning.callbacks.guard import FiniteGuard as FiniteGuard
from dds_lightning.callbacks.resume import ExactResume as ExactResume
from dds_lightning.callbacks.rollouts import RolloutEvaluation as RolloutEvaluation
