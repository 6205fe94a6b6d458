"""What a run's stages are worth one by one: the numbers from which `verdict` names the weak one.

```
 data ──► how many episodes end early and no termination says why; in a maze, whether there is time to arrive
 skills ─► codes in use, fidelity in the simulator, how much held-out loss was still falling
 critic ─► rank correlation of V with the returns of held-out episodes
 policy ─► how far it has moved from the policy of the data, and whether it learnt that one by heart
```
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import cross_entropy

from dds_lightning.errors import UserError

if TYPE_CHECKING:
    from datamodules.relabelled import RelabeledDataModule
    from datamodules.trajectories import Trajectories
    from dds_lightning.baselines.behaviour_cloning import BehaviourCloning
    from dds_lightning.policy import PolicyModule
    from dds_lightning.skill import SkillModule
    from dds_lightning.tasks import Task

EARLY = 0.9
"""An episode shorter than this share of the task's longest ends early."""
STATES = 5000
"""Most states at which critic and policy are asked."""


def data_evidence(trajectories: Trajectories, task: Task) -> dict[str, Any]:
    """Return what the data say of themselves.

    Returns:
        Shares of episodes: `ends_early`, before the task's limit, and `terminates`, by a termination. In a maze also
        `way_share`: the steps from start to goal at the data's pace, as a share of those that an episode may have.
    """
    ended = trajectories.terminations[trajectories.step_offsets[1:] - 1]
    found = {
        "ends_early": float((trajectories.lengths < EARLY * task.max_episode_steps).mean()),
        "terminates": float(ended.mean()),
    }
    if task.maze_map is not None and task.start_cell and task.goal_cell:
        found["way_share"] = steps_to_goal(trajectories, task) / task.max_episode_steps
    return found


def steps_to_goal(trajectories: Trajectories, task: Task) -> float:
    """How many steps the shortest way over a maze's cells takes at the data's pace.

    The pace is the median distance between two places half a cell apart along the data's ways, divided by the steps in
    between, so that swaying on the spot is no progress.
    """
    from datamodules.collect.planner import planner_for

    assert task.maze_map is not None
    assert task.start_cell is not None
    assert task.goal_cell is not None
    way = task.cell_size * (len(planner_for(task.maze_map).path(task.start_cell, task.goal_cell)) - 1)
    places = np.asarray(trajectories.observations[:, :2], np.float64)

    def distances(steps: int) -> NDArray[np.float64]:
        first = np.arange(trajectories.num_steps - steps + 1)
        episodes = trajectories.episode_of(first)
        rows = (first + episodes)[episodes == trajectories.episode_of(first + steps - 1)]
        found: NDArray[np.float64] = np.linalg.norm(places[rows + steps] - places[rows], axis=1)
        return found

    apart = np.ceil(0.5 * task.cell_size / max(distances(1).mean(), 1e-9))
    apart = int(np.clip(apart, 1, trajectories.lengths.max()))
    return way / max(float(np.median(distances(apart))) / apart, 1e-9)


def skill_evidence(skill: SkillModule, checkpoint: Path) -> dict[str, Any]:
    """Return what a skill model and the checkpoint that it is from say of its training.

    Returns:
        `codes_used` (codes with at least a tenth of the share 1/K, by the running usage), `num_skills`, and, where its
        validations allow it, `expected_fall`: by which share a quarter more steps would lower held-out loss; and where
        it has risen while training loss fell, `overfit` (by which share) and `lowest_step` (since when).
    """
    from dds_lightning.callbacks.best import callback_state
    from dds_lightning.callbacks.convergence import Convergence, expected_fall, overfit
    from dds_lightning.saving.checkpoint import load_ckpt

    found: dict[str, Any] = {"num_skills": skill.num_skills}
    if skill.discrete:
        found["codes_used"] = int(skill.bottleneck.health()["codes_used"])
    kept = callback_state(load_ckpt(checkpoint), Convergence) if checkpoint.suffix == ".ckpt" else None
    if kept is None:
        return found
    history, trained = (
        [(int(step), float(loss)) for step, loss in kept.get(name, [])] for name in ("history", "trained")
    )
    if history and not np.isnan(fall := expected_fall(history)):
        found["expected_fall"] = fall
    rise, lowest = overfit(history, trained)
    return {**found, "overfit": rise, "lowest_step": lowest} if rise > 0 else found


def fidelity_evidence(
    trajectories: Trajectories, skill: SkillModule, clone: BehaviourCloning, noise_scale: float | None, seed: int
) -> dict[str, float]:
    """Return `fidelity` and `fidelity_clone`, errors of replays (see `interpret.measure.fidelity`); {} without them."""
    from dds_lightning.interpret.measure.fidelity import SKILLS, fidelity

    @torch.inference_mode()
    def act(observations: Any, rows: Any) -> Any:
        return clone(torch.from_numpy(observations).to(clone.device)).float().cpu().numpy()

    assert trajectories.task is not None, "a run has a task"
    try:
        table = fidelity(trajectories.task, trajectories, skill, {"clone": act}, noise_scale=noise_scale, seed=seed)
    except UserError:  # not MuJoCo, or observations that do not hold its state
        return {}
    errors = table.set_index("player")["error"]
    return {"fidelity": float(errors[SKILLS]), "fidelity_clone": float(errors["clone"])}


@torch.inference_mode()
def policy_evidence(data: RelabeledDataModule, policy: PolicyModule) -> dict[str, float]:
    """Ask critic and policy at the states of held-out episodes, or of all where none are held out.

    Args:
        data: The transitions, set up.
        policy: The trained module.

    Returns:
        `critic_rank`: Spearman's correlation of V with the discounted return to the episode's end, plus V there if only
        the recording ended, or a long way from a rare reward would count as a short one; and with
        ``awr: closed_form`` `policy_shift`: KL(pi || beta) as a share of the most that any choice among the codes of
        the data gives, 0 for the policy of the data, 1 for always the critic's best code; and, where episodes are held
        out, `beta_loss` and `share_loss`: cross entropy, in nats, of their codes under beta and under the plain shares
        of the codes in the data.
    """
    from scipy.stats import spearmanr

    from datamodules.relabelling import returns_to_go

    assert data.transitions is not None, "setup() comes first"
    index = data.validation_index if len(data.validation_index) else torch.arange(len(data.transitions))
    index = index[:STATES]
    relabelling = data.relabelling.for_task(data.task)
    trajectories, discount = data.trajectories, relabelling.step_discount(data.horizon)
    rewards = relabelling.learning_rewards(trajectories, data.horizon)
    ends, lasts = trajectories.step_offsets[1:] - 1, trajectories.observation_offsets[1:] - 1  # of each episode
    goes_on = ~trajectories.terminations[ends]
    onward = torch.from_numpy(trajectories.observations[lasts[goes_on]])
    rewards[ends[goes_on]] += discount * policy.v(onward.to(policy.device)).cpu().numpy()
    returns = returns_to_go(rewards, trajectories.lengths, discount)
    states = data.transitions.observations[index]
    values = policy.v(states.to(policy.device)).cpu().numpy()
    rank = float(spearmanr(values, returns[data.transitions.starts[index].numpy()]).statistic)
    found = {"critic_rank": 0.0 if np.isnan(rank) else rank}
    if policy.hparams.awr == "closed_form":
        states = states.to(policy.device)
        beta = policy.actor(policy.embed(states))
        found["policy_shift"] = policy_shift(policy, states, beta)
        if len(data.validation_index):
            codes, shares = data.transitions.codes[index], data.statistics()["code_share"]
            found["beta_loss"] = float(cross_entropy(beta.cpu(), codes))
            found["share_loss"] = float(cross_entropy(shares.clamp_min(1e-6).log().expand(len(codes), -1), codes))
    return found


@torch.inference_mode()
def policy_shift(policy: PolicyModule, observations: torch.Tensor, beta: torch.Tensor) -> float:
    """KL(pi || beta) over states, as a share of the KL of always taking the likeliest code of pi.

    Args:
        policy: Gives pi.
        observations: (N, O).
        beta: (N, K) logits of the policy of the data there.
    """
    log_pi = policy.logits(observations).log_softmax(dim=-1)
    allowed = log_pi.isfinite()
    log_beta = beta.masked_fill(~allowed, -torch.inf).log_softmax(dim=-1)
    moved = torch.where(allowed, log_pi.exp() * (log_pi - log_beta), 0.0).sum(dim=-1).mean()
    most = -log_beta.gather(1, log_pi.argmax(dim=-1, keepdim=True)).mean()
    return float(moved / most.clamp_min(1e-6))
