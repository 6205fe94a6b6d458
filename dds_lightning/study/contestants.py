"""The contestants of the final table: one agent whose skills are chosen in several ways, and its baselines."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.errors import UserError
from dds_lightning.rollout.actors import Contestant, single_skills
from dds_lightning.saving.places import refuse_no_folder
from dds_lightning.study.loose import advice
from dds_lightning.tasks import Task

if TYPE_CHECKING:
    from dds_lightning.agent import DDSAgent

WAYS = ("greedy", "sample", "argmax_q", "random")
DATA_POLICY = "the data's choice of skills (alpha 0)"
COOL = 0.5
"""Temperature of the row between greedy and sampled."""


def way_name(selection: str, temperature: float = 1.0) -> str:
    """Return the table's name for a way of choosing skills."""
    if selection == "sample":
        return "AWR policy, sampled" + ("" if temperature == 1.0 else f" at temperature {temperature:g}")
    names = {"greedy": "AWR policy, greedy", "argmax_q": "argmax-Q", "random": "random skills"}
    if selection not in names:
        raise UserError(f"selection is {selection!r}, expected one of {', '.join(WAYS)}")
    return names[selection]


def way(
    agent: "DDSAgent", selection: str, episodes: int, temperature: float = 1.0, best: Mapping[str, Any] | None = None
) -> Contestant:
    """Return one way of choosing skills as a contestant.

    Args:
        agent: The agent whose skills and policy play.
        selection: How skills are chosen, see `DDSAgent`.
        episodes: Number of episodes to play.
        temperature: Temperature of `sample`.
        best: Facts of the checkpoint (see `protocol.best_facts`), if it is not the last one; its name says so.
    """
    name = way_name(selection, temperature) + (f" ({best_label(best)})" if best else "")
    if getattr(getattr(agent, "policy", None), "STAGE", None) == "online":
        name = name.replace("AWR", "SAC")
    return Contestant(name, agent.variant(selection, temperature=temperature), episodes)  # type: ignore[arg-type]


def best_ways(agent: "DDSAgent", episodes: int, facts: Mapping[str, Any]) -> list[Contestant]:
    """Return the best checkpoint's policy, sampled and greedy; `facts` as in `way`."""
    return [way(agent, selection, episodes, best=facts) for selection in ("sample", "greedy")]


def best_label(best: Mapping[str, Any]) -> str:
    """Say how a checkpoint other than the last was chosen, and what that does to its score."""
    if not str(best["monitor"]).startswith("rollout/"):
        return f"best {best['monitor']} while training, step {best['step']:,}"
    return f"best of {best['evaluations']} evaluations while training, step {best['step']:,}: optimistic"


def final_contestants(
    agent: "DDSAgent",
    task: Task,
    episodes: int,
    episodes_per_skill: int,
    clone: Any = None,
    controller: Any = None,
    best: Sequence[Contestant] = (),
    data_policy: "DDSAgent | None" = None,
) -> list[Contestant]:
    """Return all contestants of the table at the end of `dds run`.

    Args:
        agent: The trained agent; its selection and temperature make the table's first row.
        task: The task that they play.
        episodes: Episodes of each contestant.
        episodes_per_skill: Episodes of each single skill alone.
        clone: Actor of the behaviour-cloning baseline, if there is one.
        controller: Actor that collected the data, if there is one.
        best: The best checkpoint's contestants, if one was kept.
        data_policy: The agent with alpha 0, which shows what choosing by the critic is worth.
    """
    ways = [
        (agent.selection, agent.temperature),
        ("greedy", 1.0),
        ("sample", COOL),
        ("sample", 1.0),
        ("argmax_q", 1.0),
    ]
    table = {way_name(*choice): way(agent, choice[0], episodes, choice[1]) for choice in [*ways, ("random", 1.0)]}
    if data_policy is not None:
        table[DATA_POLICY] = Contestant(DATA_POLICY, data_policy, episodes)
    contestants = [*table.values(), *best, single_skills(agent, episodes_per_skill)]
    if clone is not None:
        contestants.append(Contestant("behaviour cloning", clone, episodes))
    if controller is not None:
        contestants.append(Contestant("the data's controller", controller, episodes))
    return contestants


def behaviour_controller(task: Task) -> Any:
    """Return the actor that collected a data set, with the same noise; None if there is no collector."""
    from datamodules.collect.collectors import behaviour_actor

    return behaviour_actor(task)


BEST_AGENT = Path("evaluate", "best")
"""Where a run publishes its best checkpoint, if it kept one; the last one is in `agent`."""


def agent_directory(directory: Path) -> Path:
    """Return the published agent of a run directory, or the directory itself if it is a published one.

    Raises:
        UserError: The directory is neither.
    """
    refuse_no_folder(directory)
    for candidate in (directory / "agent", directory):
        if (candidate / "model.safetensors").is_file():
            return candidate
    there = ", ".join(sorted(entry.name for entry in directory.iterdir())) or "nothing"
    raise UserError(
        f"{directory} is neither a finished run (no agent/model.safetensors) nor a published checkpoint: "
        f"it holds {there}{advice(directory)}"
    )


def best_directory(directory: Path) -> Path | None:
    """Return the published best checkpoint of a run directory, if it kept one."""
    best = directory / BEST_AGENT
    return best if (best / "model.safetensors").is_file() else None
