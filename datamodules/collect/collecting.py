"""How data are made for a family of tasks: one `Collector` record; everything around its recorder is the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata as installed
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from datamodules.collect.minari_writer import write_minari
from datamodules.collect.recording import Episode, EpisodeRecorder, PartialRecording, record
from datamodules.storage import refuse_existing
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.tasks import Task, get_task


@dataclass(frozen=True)
class DataSetPlan:
    """What differs from one collected data set to the next.

    Attributes:
        recorder: Records the episodes.
        env: The recorded environment, made by its id.
        algorithm: Minari's `algorithm_name`.
        description: Minari's `description`.
        settings: What the data depend on beside task, seed, steps and recipe.
        env_spec: Minari's `env_spec`; None takes that of `env`.
        evaluation: Minari's `eval_env_spec`; None leaves it out.
        packages: Packages whose installed versions are kept in the metadata.
        chunk: Rounds that a worker records at once.
        trim: Drops the episodes that were recorded beyond the end of the set.
    """

    recorder: EpisodeRecorder
    env: gym.Env[Any, Any]
    algorithm: str
    description: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    env_spec: EnvSpec | None = None
    evaluation: EnvSpec | None = None
    packages: tuple[str, ...] = ("gymnasium", "gymnasium-robotics", "mujoco")
    chunk: int = 1
    trim: Callable[[Iterator[Episode]], Iterator[Episode]] = iter


@dataclass(frozen=True)
class Collector:
    """How the data of a family of tasks are made, and the behaviour that makes them as an actor.

    Attributes:
        family: Of the tasks that it serves.
        physics: Those of the tasks that it serves; None serves all.
        steps: Environment steps of a set unless another number is given.
        recipe: Dataclass of what the behaviour does; every field has a default.
        plan: What to record for (task, seed, steps, recipe).
        controller: The behaviour as an `Actor`, for (task, recipe).
    """

    family: str
    physics: tuple[str, ...] | None
    steps: int
    recipe: type[Any]
    plan: Callable[[Task, int, int, Any], DataSetPlan]
    controller: Callable[[Task, Any], Any]

    def collect(
        self,
        task: Task | str,
        steps: int | None = None,
        seed: int = 0,
        out: str | Path = "data",
        workers: int | None = None,
        *,
        recipe: Any = None,
        dataset_id: str | None = None,
        overwrite: bool = False,
        progress: bool = True,
        **settings: Any,
    ) -> Path:
        """Collect a data set and write it as a Minari data set.

        An interrupted call with the same arguments continues where it stopped.

        Args:
            task: A task that this collector serves, or its name.
            steps: Environment steps in all; None takes the collector's own number.
            seed: The same seed gives the same bytes of every array, whatever the workers and interruptions.
            out: Folder of data sets; the set becomes `out/<dataset_id>`, where MINARI_DATASETS_PATH=out finds it.
            workers: Processes; None takes every core, 1 stays in this process.
            recipe: What the behaviour does, an instance of the collector's recipe class; None takes its defaults.
            dataset_id: Name of the set; None takes the task's own, for example "pointmaze-large-diverse-v0".
            overwrite: Replace a set of the same name.
            progress: Show a progress bar on standard error.
            **settings: Fields of the recipe that differ from `recipe`.

        Returns:
            The data set's folder; `load_trajectories(f"local:{folder}", task)` reads it.

        Raises:
            UserError: For a task that this collector does not serve, a number out of range, or a folder that exists.
        """
        task = get_task(task)
        if task.family != self.family or (self.physics and task.physics not in self.physics):
            physics = f" in {' or '.join(self.physics)} physics" if self.physics else ""
            raise UserError(f"task: '{task.name}' cannot be collected here, expected a task of {self.family}{physics}")
        recipe = replace(recipe or self.recipe(), **settings)
        steps = self.steps if steps is None else steps
        folder = prepare_folder(task, steps, seed, out, dataset_id, overwrite)
        plan = self.plan(task, seed, steps, recipe)
        collection = {"task": task.name, "seed": seed, "steps": steps, **asdict(recipe), **plan.settings}
        partial = PartialRecording(folder, collection)
        title = f"collecting {folder.name}" if progress else None
        episodes = plan.trim(record(plan.recorder, workers, chunk=plan.chunk, partial=partial, title=title))
        env_spec = plan.env_spec or plan.env.spec
        assert env_spec is not None, "environments are made by their id"
        write_minari(
            folder.parent,
            folder.name,
            episodes,
            env_spec=env_spec,
            observation_space=plan.env.observation_space,
            action_space=plan.env.action_space,
            overwrite=overwrite,
            metadata={
                "author": ["dds-lightning"],
                "algorithm_name": plan.algorithm,
                "description": plan.description + _how_to_build(env_spec),
                **({"eval_env_spec": plan.evaluation.to_json()} if plan.evaluation else {}),
                "requirements": [f"{package}=={installed.version(package)}" for package in plan.packages],
                "collection": collection,
            },
        )
        partial.remove()
        return folder


def _how_to_build(env_spec: EnvSpec) -> str:
    """What `recover_environment` of a Minari installation needs for an environment of this package."""
    if not str(env_spec.entry_point).startswith("dds_lightning."):
        return ""
    return (
        f" The environment {env_spec.id} comes with dds-lightning: install it from its checkout, with "
        "`pip install -e . -c constraints.txt`, before Minari's `recover_environment`."
    )


def prepare_folder(task: Task, steps: int, seed: int, out: str | Path, dataset_id: str | None, overwrite: bool) -> Path:
    """The folder of the set to come.

    Raises:
        UserError: When a number is out of range, or the folder exists and may not be replaced.
    """
    if steps < 1:
        raise UserError(f"steps: got {steps}, expected at least 1")
    refuse_seed("seed", seed)
    folder = Path(out) / (dataset_id or task.data_ids["local"])
    refuse_existing(folder, overwrite)
    return folder
