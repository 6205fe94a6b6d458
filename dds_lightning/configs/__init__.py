"""The packaged configurations and how a command line finds them."""

from collections.abc import Sequence
from pathlib import Path

from dds_lightning.errors import UserError

ROOT = Path(__file__).parent


def packaged() -> list[str]:
    """Names of all packaged configurations, as `--config` takes them."""
    return sorted(str(path.relative_to(ROOT)) for path in ROOT.rglob("*.yaml"))


def find(name: str) -> Path:
    """Find a configuration: a file of the user's, or else a packaged one.

    Raises:
        UserError: neither exists.
    """
    for path in (Path(name), ROOT / name, ROOT / f"{name}.yaml"):
        if path.is_file():
            return path
    raise UserError(f"--config: there is no file {name}, and the packaged ones are {', '.join(packaged())}")


def find_preset(name: str) -> dict[str, Path]:
    """Both configurations of a preset: a packaged folder's name or a folder of the user's.

    Raises:
        UserError: neither exists, or one of the two files is missing.
    """
    folder = Path(name) if Path(name).is_dir() else ROOT / name
    if not folder.is_dir():
        known = ", ".join(sorted({Path(entry).parent.name for entry in packaged()}))
        raise UserError(f"preset: there is no folder {name}, and the packaged ones are {known}")
    pair = {stage: folder / f"{stage}.yaml" for stage in ("skill", "policy")}
    for path in pair.values():
        if not path.is_file():
            raise UserError(f"preset: folder {folder} has no {path.name}")
    return pair


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
