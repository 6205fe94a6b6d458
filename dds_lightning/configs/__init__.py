"""The packaged configurations and how a command line finds them."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import read_yaml

ROOT = Path(__file__).parent
RUN_DEFAULTS: dict[str, Any] = {
    "data_steps": 200_000,
    "clone_steps": 16_000,
    "episodes_per_skill": 20,
    "selection": "greedy",  # on average of all agents shipped and tried, 4 to 5 points above sampling
    "temperature": 1.0,
    "noise_scale": None,  # the skill model's
}
"""What a preset's `run.yaml` may set, with the defaults."""


def packaged() -> list[str]:
    """Names of all packaged configurations, as `--config` takes them."""
    found = (path.relative_to(ROOT) for path in ROOT.rglob("*.yaml") if path.name != "run.yaml")
    return sorted(str(path) for path in found if path.parent.name != "studies")


def families() -> set[str]:
    """Names of the packaged presets."""
    return {path.parent.name for path in ROOT.glob("*/skill.yaml")}


def find(name: str) -> Path:
    """Find a configuration: the user's file, or else a packaged one.

    Raises:
        UserError: Neither exists.
    """
    for path in (Path(name), ROOT / name, ROOT / f"{name}.yaml"):
        if path.is_file():
            return path
    inside = [known for known in packaged() if known.startswith(f"{name}/")]
    stems = {known.removesuffix(".yaml"): known for known in packaged()}  # an ending that all have brings none nearer
    alike = difflib.get_close_matches(name.removesuffix(".yaml"), stems, n=2, cutoff=0.66)
    near = inside or [stems[stem] for stem in alike]
    known = f": did you mean {' or '.join(near)}?" if near else f", and the packaged ones are {', '.join(packaged())}"
    raise UserError(f"--config: there is no file {name}{known}")


def known_as(word: str) -> str:
    """A word of a command line as people type it: the name of a packaged configuration in place of its path."""
    path = Path(word)
    return str(path.relative_to(ROOT)) if path.is_absolute() and path.is_relative_to(ROOT) else word


def run_defaults(name: str) -> dict[str, Any]:
    """What a preset says about `dds run` apart from its trainings; it need not have a `run.yaml`.

    Args:
        name: As for `preset_folder`.

    Returns:
        A value for each of `RUN_DEFAULTS`.

    Raises:
        UserError: There is no such preset, or its `run.yaml` is not a mapping of these settings.
    """
    path = preset_folder(name) / "run.yaml"
    chosen = read_yaml(path, verdict="is not valid YAML", remedy="mend it") if path.is_file() else {}
    known = ", ".join(RUN_DEFAULTS)
    if not isinstance(chosen, dict):
        raise UserError(f"preset: {path} is not a mapping, expected some of {known}")
    for key, value in chosen.items():
        if key not in RUN_DEFAULTS:
            raise UserError(f"preset: {path} sets {key}, expected only {known}")
        likeness = 1.0 if RUN_DEFAULTS[key] is None else RUN_DEFAULTS[key]
        kinds = (int, float) if isinstance(likeness, float) else type(likeness)
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise UserError(f"preset: {path} sets {key} to {value!r}, expected a value like {likeness!r}")
    return {**RUN_DEFAULTS, **chosen}


def preset_folder(name: str) -> Path:
    """The folder of a preset: a packaged one's name or a folder of the user's.

    Raises:
        UserError: There is none.
    """
    folder = Path(name) if Path(name).is_dir() else ROOT / name
    if not folder.is_dir():
        known = ", ".join(sorted(families()))
        raise UserError(f"preset: there is no folder {name}, and the packaged ones are {known}")
    return folder


def resolve_configs(words: Sequence[str]) -> list[str]:
    """Replace the names of packaged configurations after `--config` or `-c` by their paths."""
    out: list[str] = []
    for index, word in enumerate(words):
        flag, equals, value = word.partition("=")
        if index and words[index - 1] in ("--config", "-c"):
            out.append(str(find(word)))
        elif flag == "--config" and equals:
            out.append(f"--config={find(value)}")
        else:
            out.append(word)
    return out
