"""`dds online compare`; `dds online fit` is the stage's own command line."""

from pathlib import Path

from dds_lightning.cli.arguments import data_spec
from dds_lightning.console.reports import Report


def compare(
    task: str,
    skill: str | None = None,
    gaussian: str | None = None,
    data: str | None = None,
    policy: str | None = None,
    seeds: int = 3,
    env_steps: int = 150_000,
    episodes: int = 20,
    out: str | None = None,
    config: str = "online.yaml",
    workers: int | None = None,
    variants: list[str] = [],  # noqa: B006 - jsonargparse shows the default
    set: list[str] = [],  # noqa: B006 - the name of the flag
) -> Report:
    """Learn a task online over discrete skills, continuous skills and raw actions, and compare (figure 5).

    Each training is a `dds online fit` with the same networks, replay and schedule. What is finished is not repeated:
    call it again after an interruption and it goes on. Writes table.csv, comparison.png (success over environment
    steps, mean and standard deviation over seeds; in a maze also where each went) and a folder for each training.

    With --json: `task`, `out`, `env_steps`, `figure`, `table` (a row for each variant: variant, seeds, env_steps,
    success in per cent or score, std over seeds, while learning: the same of the latest collected episodes, cells
    visited).

    Args:
        task: Name of a task.
        skill: Checkpoint of discrete skills.
        gaussian: Checkpoint of continuous skills (model.bottleneck gaussian).
        data: Prior data; adds discrete skills with half of each batch from them.
        policy: Checkpoint of an offline policy over the skills; with --data adds the way from offline to online.
        seeds: Trainings of each variant, with seeds 0, 1, ...
        env_steps: Environment steps of each training.
        episodes: Episodes that each trained agent plays for the table.
        out: Folder; without it runs/TASK-online.
        config: Settings of `dds online fit`, a packaged configuration or a file.
        workers: Processes for the environments that agents play in; without it one per core.
        variants: Some of discrete, continuous, raw, prior and offline; without it all whose files are given.
        set: Further arguments of `dds online fit`, for example ["--data.updates=0.1"].
    """
    from dds_lightning.pipeline.compare import Comparison
    from dds_lightning.pipeline.compare import compare as run
    from dds_lightning.tasks import get_task

    return run(
        Comparison(
            task=task,
            out=Path(out or f"runs/{get_task(task).name}-online"),
            skill=skill,
            gaussian=gaussian,
            data=data_spec(data) if data else None,
            policy=policy,
            seeds=seeds,
            env_steps=env_steps,
            episodes=episodes,
            workers=workers,
            config=config,
            arguments=tuple(set),
            chosen=tuple(variants),
        )
    )
