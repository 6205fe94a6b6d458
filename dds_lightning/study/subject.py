"""`dds atlas`: what a path holds (a run, a published agent, a skill checkpoint), and its skill atlas."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.interpret.atlas.build import CONTINUOUS, DISCRETE, Atlas, make_atlas
from dds_lightning.interpret.atlas.page import write_atlas, write_pictures
from dds_lightning.interpret.atlas.pictures import Announce
from dds_lightning.rollout.actors import single_skills
from dds_lightning.rollout.play import rollout
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.saving.places import refuse_no_checkpoint
from dds_lightning.saving.run_directory import MARKER, read_marker
from dds_lightning.saving.untrusted import conform
from dds_lightning.skill import SkillModule
from dds_lightning.study.contestants import agent_directory, way
from dds_lightning.study.findings import Findings
from dds_lightning.study.loose import loose_task
from dds_lightning.study.run_task import recall_task
from dds_lightning.tasks import Task, get_task, known_task, restore_task

SINGLE = "single skill"


@dataclass(frozen=True, eq=False)
class Subject:
    """What an atlas is about.

    Attributes:
        agent: Its skills, and its policy if there is one.
        task: Name of the task; None if unknown.
        data: Where the data are, `SOURCE:NAME`; None if unknown.
        found: The evaluation of a finished run; None for anything else.
        about: Description of the checkpoint.
    """

    agent: DDSAgent
    task: str | None
    data: str | None
    found: Findings | None
    about: str


def find_subject(place: Path, seed: int = 0, asked: str | None = None) -> Subject:
    """Determine what a path holds.

    Args:
        place: A run of `dds run` with at least its skills trained, a published directory, or a skill checkpoint.
        seed: Seed of the agent.
        asked: Name of the task that was asked for, if one was.

    Raises:
        UserError: The path holds none of these.
    """
    if place.is_file() or place.suffix == ".ckpt":
        agent, trained = _skills_alone(place, seed), loose_task(asked, str(place))
        name = trained.name if trained else None
        return Subject(agent, name, None, None, f"skill checkpoint {_shown(place)}")
    recall_task(place, asked)
    data, task = _data_of(place)
    if not (place / "model.safetensors").is_file() and not (place / "agent" / "model.safetensors").is_file():
        checkpoint = place / "skill" / "last.ckpt"
        if read_marker(place / "skill").get("state") == "finished" and checkpoint.is_file():
            return Subject(
                _skills_alone(checkpoint, seed), task, data, None, f"skills of the run {_shown(place)}, no policy yet"
            )
        if data is not None:
            raise UserError(f"{place} is a run whose skills are not trained yet: finish them with `dds run`")
    directory = agent_directory(place)
    from dds_lightning.saving.published import load_published

    if task is None and (kept := restore_task(load_published(directory).config, directory)):
        task = kept.name
    found = Findings.read(place) if (place / "evaluate" / "episodes.parquet").is_file() else None
    return Subject(DDSAgent.load(directory, seed=seed), task, data, found, f"published agent {_shown(directory)}")


def _skills_alone(checkpoint: Path, seed: int) -> DDSAgent:
    refuse_no_checkpoint(checkpoint)
    return DDSAgent(SkillModule.load(checkpoint), None, "random", seed=seed)


def _data_of(run: Path) -> tuple[str | None, str | None]:
    """Return data and task of a run; both None if it is not a run."""
    marker = read_marker(run / "data")
    settings = marker.get("settings", {})
    conform(settings, dict.fromkeys(("data", "task"), (str, type(None))), f"{run / 'data' / MARKER}, settings")
    collected = marker.get("outputs", {}).get("data")
    return settings.get("data") or (f"local:{run / 'data' / collected}" if collected else None), settings.get("task")


def atlas(
    place: Path,
    data: str | None,
    task: str | None,
    out: Path,
    episodes: int = 5,
    against: Sequence[Path] = (),
    seed: int = 0,
    figures: Path | None = None,
    announce: Announce = lambda message: None,
) -> tuple[Atlas, Path]:
    """Create and write the atlas of a path; the arguments are those of `dds atlas`.

    Raises:
        UserError: There are no skills, the data or the task is unknown, or they do not fit each other.
        DataError: The data are damaged or belong to another task.
    """
    from datamodules.relabel import check_widths
    from datamodules.sources import load_trajectories

    announce("looking at the checkpoint")
    subject = find_subject(place, seed, task)
    if not subject.agent.discrete:
        raise UserError(f"{place} has no codes: an atlas shows discrete skills; look at this agent with `dds evaluate`")
    spec, name = data or subject.data, task or subject.task
    if spec is None:
        raise UserError(f"{place} does not know its data: give --data, for example local:DIR, minari:ID or d4rl:FILE")
    if name is None:
        raise UserError(f"{place} does not say which task it is for: give --task; `dds tasks` lists them")
    known = get_task(task) if task else known_task(name)  # a name read from a file never opens another file
    models = [SkillModule.load(path) for path in against]
    announce("reading the data")
    trajectories = load_trajectories(spec, known)
    wanted = trajectories.task
    assert wanted is not None
    for model in (subject.agent.skill, *models):
        check_widths(trajectories, model)
    result, main, singles = _episodes(subject, wanted, episodes, seed, announce)
    others = [(DISCRETE if model.discrete else CONTINUOUS, model) for model in models]
    made = make_atlas(
        subject.agent, wanted, trajectories, result, main, singles, others=others, seed=seed, announce=announce
    )
    source, _, where = spec.partition(":")
    spec = f"{source}:{_shown(where)}"
    command = ["dds", "atlas", _shown(place), "--data", spec, "--task", wanted.name, "--seed", str(seed)]
    announce("writing the page")
    if figures is not None:
        write_pictures(made, figures, out.stem)
    about = _about(subject, wanted, spec, result, main)
    return made, write_atlas(made, out, about, shlex.join([*command, "--out", _shown(out)]))


def _shown(place: str | Path) -> str:
    """Return a path as the page names it: others read the page, and folders of the maker's machine are not for them."""
    path = Path(place)
    if not path.is_absolute():
        return str(place)
    if path.is_relative_to(Path.cwd()):
        return str(path.relative_to(Path.cwd()))
    if path.parent.name == "snapshots" and path.parts[-3].startswith("models--"):  # of the Hub's cache
        return f"hf:{path.parts[-3].removeprefix('models--').replace('--', '/', 1)}@{path.name}"
    return path.name


def _episodes(
    subject: Subject, task: Task, episodes: int, seed: int, announce: Announce
) -> tuple[RolloutResult | None, str | None, str | None]:
    """Return episodes with their paths, and the names of policy and single skills: the run's, or played now."""
    found = subject.found
    if found is not None and found.task == task and found.result.paths:
        return found.result, found.main, found.singles
    if episodes == 0:
        return None, None, None
    agent = subject.agent
    players, main = [single_skills(agent, episodes, SINGLE)], None
    if agent.policy is not None:
        players.insert(0, way(agent, agent.selection, max(episodes, 1), agent.temperature))
        main = players[0].name
    announce(f"playing {sum(player.episodes for player in players)} episodes")
    seen = task.maze_map is None  # without a maze there are no paths to draw
    result = rollout(task, players, seed=seed, progress=False, record=True, record_observations=seen)
    return result, main, SINGLE


def _about(
    subject: Subject, task: Task, spec: str, result: RolloutResult | None, main: str | None
) -> list[tuple[str, str]]:
    settings = subject.agent.skill.hparams
    lines = [
        ("checkpoint", subject.about),
        ("data", spec),
        ("task", f"{task.name} ({task.env_id})"),
        ("skills", f"K = {settings['num_skills']}, D = {settings['skill_dim']}, H = {settings['horizon']}"),
    ]
    if result is not None and main is not None:
        row = result.summary().set_index("actor").loc[main]
        reached = f"{row['success']:.0f} % succeed" if task.measures_success else f"score {row['score']:.1f}"
        lines.append(
            ("policy", f"{main}: {reached}, {row['episodes']:.0f} episode{'' if row['episodes'] == 1 else 's'}")
        )
    return lines
