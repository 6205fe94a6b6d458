"""Who plays with the checkpoints of a method: agents over skills, and networks that act at every step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dds_lightning.agent import DDSAgent
from dds_lightning.baselines.behaviour_cloning import CloneActor
from dds_lightning.online.parts import checkpoint_parts
from dds_lightning.rollout.actors import Acted
from dds_lightning.skill import SkillModule
from dds_lightning.training.stages import get_stage

Checkpoints = Mapping[str, str]


class ModuleActor:
    """A module with `act(observations, generator) -> actions` as an `Actor` without memory.

    Args:
        module: The trained module; it is put in evaluation mode and stays on its device.
    """

    def __init__(self, module: Any) -> None:
        self.module = module.eval()
        self.reset(0)

    def reset(self, num_envs: int, seed: int | None = None) -> None:
        """Restart the random stream."""
        self._generator = torch.Generator(self.module.device).manual_seed(seed or 0)

    @torch.inference_mode()
    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_], rows: NDArray[np.intp]) -> Acted:
        """As `Actor.act`."""
        x = torch.from_numpy(np.ascontiguousarray(observations, dtype=np.float32)).to(self.module.device)
        return Acted(self.module.act(x, self._generator).float().cpu().numpy())


def of_skills(checkpoints: Checkpoints) -> DDSAgent:
    """Skills and a policy over them, or a policy over raw actions alone; greedy."""
    *skill, policy = checkpoints.values()
    return DDSAgent(*checkpoint_parts(skill[0] if skill else None, policy), "greedy")


def of_latents(checkpoints: Checkpoints) -> DDSAgent:
    """Continuous skills and what chooses among them, greedy."""
    skill, (stage, path) = checkpoints["skill"], list(checkpoints.items())[-1]
    chooser: Any = get_stage(stage).module_class().load(path)
    return DDSAgent(SkillModule.load(skill), chooser, "greedy")


def of_clone(checkpoints: Checkpoints) -> CloneActor:
    """The clone."""
    return CloneActor.load(checkpoints["clone"])


def of_module(checkpoints: Checkpoints) -> ModuleActor:
    """The module of the one stage that there is."""
    ((stage, path),) = checkpoints.items()
    return ModuleActor(get_stage(stage).module_class().load(path))
