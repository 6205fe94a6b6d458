"""Behaviour policies: trained by `python -m datamodules.behaviours.train`, shipped small, acting without torch."""

from datamodules.behaviours.ant import AntController
from datamodules.behaviours.policy import MLPPolicy
from datamodules.behaviours.shipped import load_ladder

__all__ = ["AntController", "MLPPolicy", "load_ladder"]
