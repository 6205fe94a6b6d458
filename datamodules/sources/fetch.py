"""Finds published data sets, on their servers and on this machine. Downloading never runs code from a data set."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from datamodules.sources.download import download
from datamodules.validation import DataError
from dds_lightning.errors import UserError
from dds_lightning.saving.files import expand, home, neighbours
from dds_lightning.saving.untrusted import remove_tree
from dds_lightning.tasks import Task, get_task, task_names
from dds_lightning.tasks.bodies import body_of

D4RL_SERVER = "http://rail.eecs.berkeley.edu/datasets/offline_rl"
"""D4RL's public server. It offers neither encryption nor hashes; files are checked when they are read."""

MINARI_SERVER = "https://huggingface.co/datasets/farama-minari"
"""Where Minari publishes its data sets: a repository per name space, a folder per data set."""


def fetch(task_name: str, source: str = "d4rl", out: str | Path | None = None) -> Path:
    """Download the data set that a source publishes for a task; a repeated call continues an interrupted one.

    Args:
        task_name: A task of the table.
        source: "d4rl" or "minari".
        out: Folder of data sets; None takes D4RL's or Minari's own.

    Returns:
        D4RL's file, or the folder of Minari's data set.

    Raises:
        UserError: For an unknown task or source, a task without data there, or when downloading fails; the
            message says what to do.
    """
    if source == "d4rl":
        return fetch_d4rl(get_task(task_name), out)
    if source == "minari":
        return fetch_minari(_published(get_task(task_name), "minari"), out)
    raise UserError(f"source: got '{source}', expected d4rl or minari")


def fetch_d4rl(task: Task, folder: str | Path | None = None) -> Path:
    """Download a task's file from D4RL's server, unless it is there already.

    Args:
        task: A row of the table with a D4RL file.
        folder: Where to put it; None takes `d4rl_root`.

    Raises:
        UserError: See `datamodules.sources.download.download`.
    """
    name = _published(task, "d4rl")
    url = f"{D4RL_SERVER}/{_d4rl(task)[0]}/{quote(name)}"
    return download(url, expand(folder or d4rl_root()) / name)


def fetch_minari(dataset_id: str, root: str | Path | None = None) -> Path:
    """Download a data set that Minari publishes, unless it is there already.

    Its two files are fetched directly: Minari's downloader runs no foreign code either, but needs one more package, and
    here the metadata are checked before the rest is fetched. The data set gets its name when both are complete.

    Args:
        dataset_id: Minari's id.
        root: Folder of data sets; None takes Minari's.

    Raises:
        UserError: See `datamodules.sources.download.download`.
        DataError: For metadata that `load_trajectories` would refuse.
    """
    from datamodules.sources.minari import check_minari_id, minari_root, read_metadata

    folder = expand(root or minari_root()) / check_minari_id(dataset_id)
    if folder.exists():
        return folder
    repository, _, inner = dataset_id.partition("/")
    address = f"{MINARI_SERVER}/{repository}/resolve/main/{f'{inner}/' if inner else ''}data"
    partial = folder.with_name(f".{folder.name}.fetched")
    download(f"{address}/metadata.json", partial / "data" / "metadata.json")
    try:
        read_metadata(partial / "data")
    except DataError:
        remove_tree(partial, partial.parent)
        raise
    download(f"{address}/main_data.hdf5", partial / "data" / "main_data.hdf5")
    os.replace(partial, folder)
    return folder


def _published(task: Task, source: str) -> str:
    if source not in task.data_ids:
        others = ", ".join(f"{known}:{name}" for known, name in task.data_ids.items())
        raise UserError(f"task '{task.name}' has no data set in source '{source}'; it has {others}")
    return task.data_ids[source]


# ---------------------------------------------------------------------- D4RL's files on this machine


def d4rl_root() -> Path:
    """Where D4RL keeps its files: D4RL_DATASET_DIR, else ~/.d4rl/datasets."""
    return Path(os.environ.get("D4RL_DATASET_DIR") or home() / ".d4rl" / "datasets")


def find_d4rl(name: str) -> Path:
    """The file that `d4rl:NAME` means.

    Args:
        name: A path; or, in D4RL's folder, the name of a file, of a task, or of D4RL's data set for it
            (`antmaze-medium-play-v2`).

    Raises:
        DataError: When there is no such file; the message says how to get it.
    """
    path = expand(name)
    if path.exists():
        return path
    if len(path.parts) > 1:
        raise DataError(f"data set '{path.name}': {path} is missing{neighbours(path)}")
    task = next((task for task in map(get_task, task_names()) if name in _names(task)), None)
    folder = d4rl_root()
    for candidate in (name, f"{name}.hdf5", task.data_ids["d4rl"] if task else name):
        if (folder / candidate).is_file():
            return folder / candidate
    remedy = f"get it with `dds data fetch {task.name}`" if task else "give its path"
    raise DataError(
        f"data set '{name}': there is no such file here or in {folder}, which D4RL_DATASET_DIR sets; {remedy}, or "
        "put the file there by hand"
    )


def _names(task: Task) -> tuple[str, ...]:
    """Names of a task's file: of the file, of the task, and D4RL's."""
    file = task.data_ids.get("d4rl")
    if file is None:
        return ()
    return file, file.removesuffix(".hdf5"), task.name, f"{task.name}-{_d4rl(task)[1]}"


def _d4rl(task: Task) -> tuple[str, str]:
    """Folder on D4RL's server, and the version that the names of its files end in."""
    found = body_of(task).d4rl
    assert found is not None, "a row with a D4RL file has a robot of D4RL's"
    return found
