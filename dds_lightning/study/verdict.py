"""Which stage of a run is the weak one, and what to do about it: a list of questions, the first yes is the answer.

```
 reaches what its data hold? ── yes ──► nothing to mend
   │ no
   ├─ episodes end early, no termination says why ──► data
   ├─ a maze, and too slow to cross it in time ─────► data
   ├─ fewer than half of the codes in use ──────────► skills
   ├─ held-out loss rose while training loss fell ──► skills
   ├─ beta is worse than the codes' plain shares ───► policy
   ├─ V does not rank held-out returns ─────────────► critic
   ├─ pi is beta, or always the best code ──────────► policy
   └─ otherwise, what copies the data worst ────────► skills
```

A stage is judged by what the later ones build on, so the order is that of the method, with one exception: skills are
asked about their length last, because held-out loss keeps falling in good runs too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from dds_lightning.callbacks.convergence import OVERFIT

CRITIC_RANK = 0.3
"""Correlations of V with held-out returns were 0.5 to 0.74 in good runs, 0.03 to 0.15 with untrained critics."""
SHIFT = (0.015, 0.8)
"""Shares of the greatest shift from the data's policy: 0.03 to 0.7 in good runs, above 0.83 with alpha 100."""
NEAR = 3.0
"""Points below a reference that do not count as lost."""
OF_THE_BEST = 0.9
"""Share of the best episode's score with which a run is well served."""
MISSING = 0.2
"""Share of episodes that end early, and none by a termination, from which terminations are thought to be missing."""
SLOW = 0.9
"""Share of an episode that the way to a maze's goal takes at the data's pace, from which an agent hardly arrives;
it was 0.2 to 0.6 in good runs."""


class Verdict(NamedTuple):
    """The weak stage.

    Attributes:
        stage: "data", "skill", "policy", or None if the run reaches what its data hold.
        text: One or two sentences: what is wrong, by which number, and what to do.
    """

    stage: str | None
    text: str


def verdict(scores: Mapping[str, float], evidence: Mapping[str, float]) -> Verdict:
    """Name the weak stage of a run.

    Args:
        scores: Normalised scores: `agent`, and where known `data_mean` and `data_best` (of an episode of the data),
            `single` (best single skill), `clone`, `data_policy` (the agent with alpha 0).
        evidence: See `evidence`; what was not measured is left out and not asked.
    """
    agent, best = scores["agent"], scores.get("data_best", math.nan)
    single = scores.get("single", math.nan)
    references = [  # what it is called, its score, and the score from which the agent does not fall short of it
        ("the data's mean", scores.get("data_mean", math.nan), scores.get("data_mean", math.nan)),
        ("behaviour cloning", scores.get("clone", math.nan), scores.get("clone", math.nan)),
        ("one skill alone", single, single - NEAR),
        (f"{100 * OF_THE_BEST:.0f} % of the data's best episode", OF_THE_BEST * best, OF_THE_BEST * best),
    ]
    ahead = [reference for reference in references if reference[2] > agent]
    if not ahead:
        reached = f", the best episode of the data {best:.1f}" if best == best else ""
        return Verdict(None, f"Nothing to mend: the agent scores {agent:.1f}{reached}.")
    ask = evidence.get
    if ask("terminates", 1.0) == 0.0 and ask("ends_early", 0.0) > MISSING:
        return Verdict(
            "data",
            f"Data: {100 * evidence['ends_early']:.0f} % of the episodes end early, but none by a termination. If they "
            "ended because the robot fell or succeeded, record that as `terminations`: the critic cannot see it "
            "otherwise.",
        )
    if ask("way_share", 0.0) > SLOW:
        return Verdict(
            "data",
            f"Data: too slow to arrive. At their pace the shortest way from start to goal takes "
            f"{100 * evidence['way_share']:.0f} % of the steps that an episode may have. Record faster movements, or "
            "take a nearer goal (TASK?goal=ROW,COLUMN).",
        )
    if 2 * ask("codes_used", math.inf) < ask("num_skills", 0.0):
        return Verdict(
            "skill",
            f"Skills: only {evidence['codes_used']:.0f} of {evidence['num_skills']:.0f} codes are in use. "
            "Keep codebook_init=kmeans and restart_threshold above 0, lower --skill.model.lr, or ask for fewer codes "
            "with --skill.model.num_skills.",
        )
    if ask("overfit", 0.0) > OVERFIT:
        return Verdict(
            "skill",
            f"Skills: overfit. Held-out loss rose by {100 * evidence['overfit']:.0f} % since step "
            f"{evidence['lowest_step']:,.0f} while training loss fell. Collect more data, or lower "
            "--skill.trainer.max_steps.",
        )
    if ask("beta_loss", 0.0) > ask("share_loss", math.inf):
        return Verdict(
            "policy",
            "Policy: it knows the data by heart. The skills of held-out episodes are less likely by it "
            f"({evidence['beta_loss']:.1f} nats) than by their plain shares ({evidence['share_loss']:.1f}). Raise "
            "--policy.model.dropout, or lower --policy.trainer.max_steps.",
        )
    if ask("critic_rank", 1.0) < CRITIC_RANK:
        return Verdict(
            "policy",
            f"Critic: its values hardly rank the returns of held-out episodes (correlation "
            f"{evidence['critic_rank']:.2f}, expected above {CRITIC_RANK:g}). Train it longer with "
            "--policy.trainer.max_steps, and check that rewards and terminations are in the data.",
        )
    low, high = SHIFT
    shift = ask("policy_shift", math.nan)
    if shift < low or shift > high:
        what, how = ("the same as the data's", "raise") if shift < low else ("nearly always the critic's best", "lower")
        return Verdict(
            "policy",
            f"Policy: its choices are {what} ({100 * shift:.0f} % of the way from the data's policy to the critic's "
            f"best code): {how} --policy.model.alpha.",
        )
    name, score, _ = max(ahead, key=lambda reference: reference[2])
    text = f"Skills: the agent scores {agent:.1f}; {name}: {score:.1f}."
    return Verdict("skill", f"{text} {_length(evidence)}Train them longer with --skill.trainer.max_steps.")


def _length(evidence: Mapping[str, float]) -> str:
    """What says that skills were not trained for long enough."""
    said = []
    fall = evidence.get("expected_fall", math.nan)
    if fall > 0.0:
        said.append(f"held-out loss would fall by another {100 * fall:.0f} % with a quarter more steps")
    if "fidelity" in evidence:
        ours, clone = evidence["fidelity"], evidence["fidelity_clone"]
        said.append(f"replayed in the simulator they are off by {ours:.2f} of the distance between two segments")
        said[-1] += f", behaviour cloning by {clone:.2f}"
    return f"Not converged: {'; '.join(said)}. " if said else ""
