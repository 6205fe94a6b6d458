"""What watches a training: evaluation by rollouts, exact resuming, the guard against losses that are not finite."""

from dds_lightning.callbacks.evaluation import RolloutEvaluation as RolloutEvaluation
from dds_lightning.callbacks.guard import FiniteGuard as FiniteGuard
from dds_lightning.callbacks.resume import ExactResume as ExactResume
