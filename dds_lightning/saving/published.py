"""The published directory: an agent, or a module, that others can load and trust.

```
 checkpoints/pointmaze-large/
   model.safetensors   weights, buffers included, keys "skill.*" and "policy.*"
   config.yaml         format_version, the modules' hyper-parameters, how the agent acts, the task
   metrics.json        scores
   README.md           the card
   SHA256SUMS          of the four files above; `sha256sum -c SHA256SUMS` checks them too
```
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import yaml
from torch import Tensor, nn

from dds_lightning._version import __version__
from dds_lightning.errors import UserError
from dds_lightning.saving.arrays import read_tensors
from dds_lightning.saving.build import build_module
from dds_lightning.saving.files import expand, folder_written_whole, mend_folder, neighbours, refuse_newer, sha256
from dds_lightning.saving.fingerprint import completed
from dds_lightning.saving.untrusted import TEXT, mapping, read_json, read_text, read_yaml, regular_file

FORMAT_VERSION = 1
WEIGHTS, CONFIG, METRICS, CARD, SUMS = (
    "model.safetensors",
    "config.yaml",
    "metrics.json",
    "README.md",
    "SHA256SUMS",
)
CONTENTS = (WEIGHTS, CONFIG, METRICS, CARD)
LARGEST = 96 * TEXT
"""Bytes of the weights, 25 million numbers. The paper's agent has 22 MB."""

M = TypeVar("M", bound=nn.Module)


@dataclass(frozen=True)
class Published:
    """A published directory in memory, verified.

    Attributes:
        directory: Where it was read.
        state: All weights, keys "skill.*" and "policy.*".
        config: Contents of config.yaml.
        metrics: Contents of metrics.json.
    """

    directory: Path
    state: Mapping[str, Tensor]
    config: Mapping[str, Any]
    metrics: Mapping[str, Any]

    def module(self, cls: type[M], part: str) -> M:
        """Build module `part`, in evaluation mode on the CPU.

        Raises:
            UserError: The module is missing, or its weights do not fit its settings.
        """
        if not isinstance(self.config.get(part), dict):
            raise UserError(f"{self.directory / CONFIG} describes no '{part}'; it has {', '.join(self.config)}")
        settings = completed(self.config[part], self._weights("skill"), self.config.get("skill"))
        return build_module(cls, settings, self._weights(part), f"{self.directory} ({part})")

    def _weights(self, part: str) -> dict[str, Tensor]:
        return {key.removeprefix(f"{part}."): value for key, value in self.state.items() if key.startswith(f"{part}.")}

    def acting(self) -> dict[str, Any]:
        """How the agent acts: arguments of `DDSAgent` beside its modules.

        Raises:
            UserError: A value that no agent has; the message names it.
        """
        found = self.config.get("agent") or {"selection": "sample" if "policy" in self.config else "random"}
        where = f"{self.directory / CONFIG}, agent"
        chosen = mapping(found, where)
        skill = self.config.get("skill")
        count = skill.get("num_skills", 16) if isinstance(skill, dict) else 0
        known: dict[str, Any] = {
            "selection": str,
            "temperature": (int, float),
            "noise_scale": (int, float),
            "seed": int,
            "hold": int,
        }
        for name, value in chosen.items():
            if value is not None and name in known and (not isinstance(value, known[name]) or isinstance(value, bool)):
                raise UserError(f"{where}: {name} is {value!r}, expected another kind of value")
        codes = chosen.get("fixed_codes")
        if codes is not None and not (
            isinstance(codes, list) and codes and all(type(code) is int and 0 <= code < count for code in codes)
        ):
            raise UserError(f"{where}: fixed_codes is {str(codes)[:80]}, expected a list of codes of 0 to {count - 1}")
        return {"selection": None, **chosen}


def publish(
    directory: str | os.PathLike[str],
    modules: Mapping[str, nn.Module],
    config: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    card: str | None = None,
) -> Path:
    """Write a published directory: whole, or the previous one stays.

    Args:
        directory: Where to write; an earlier published directory there is replaced.
        modules: Lightning modules by the name they get, for example "skill" and "policy".
        config: Further plain values for config.yaml, for example the task.
        metrics: Scores as plain values.
        card: Text of README.md; a short one by default.

    Returns:
        The directory.

    Raises:
        UserError: Something else is at `directory`, or a value is not plain.
        OSError: It could not be written.
    """
    target = expand(directory).resolve()
    mend_folder(target)
    _refuse_foreign(target)
    entries: dict[str, Any] = {"format_version": FORMAT_VERSION, "dds_lightning": __version__}
    entries |= _plain(dict(config or {}), CONFIG)
    state: dict[str, Tensor] = {}
    for name, module in modules.items():
        settings = {k: v for k, v in dict(module.hparams).items() if not k.startswith("_")}  # type: ignore[arg-type]
        entries[name] = _plain(settings, f"{CONFIG}: {name}")
        # Clones: safetensors refuses tensors that share memory.
        state |= {f"{name}.{key}": value.detach().cpu().clone() for key, value in module.state_dict().items()}
    texts = {
        CONFIG: yaml.safe_dump(entries, sort_keys=False, allow_unicode=True),
        METRICS: json.dumps(_plain(dict(metrics or {}), METRICS), indent=2, allow_nan=True) + "\n",
        CARD: card if card is not None else _short_card(target.name, entries),
    }
    with folder_written_whole(target) as part:
        try:
            safetensors.torch.save_file(state, part / WEIGHTS, metadata={"format": "pt"})
        except safetensors.SafetensorError as error:  # what it raises for a disk error
            raise UserError(f"{target / WEIGHTS} could not be written: {error}") from None
        (part / WEIGHTS).chmod(0o644)  # safetensors writes for the owner alone
        for name, text in texts.items():
            (part / name).write_text(text, encoding="utf-8")
        sums = "".join(f"{sha256(part / name)}  {name}\n" for name in CONTENTS)
        (part / SUMS).write_text(sums, encoding="utf-8")
        load_published(part)
    return Path(directory)


def refuse_another(directory: str | os.PathLike[str], state: Mapping[str, Tensor]) -> None:
    """Refuse a directory with other weights, so that a name typed once more costs nobody an agent.

    Args:
        directory: Where an agent is to be published.
        state: Its weights, keys as in `Published.state`.

    Raises:
        UserError: Another agent was published there, or one that cannot be read.
    """
    target = expand(directory).resolve()
    mend_folder(target)
    if not os.path.lexists(target / SUMS):
        return
    try:
        held = load_published(target)
    except UserError as error:
        raise UserError(f"{error}; --replace puts the new agent in its place") from None
    if held.state.keys() != state.keys() or any(not held.state[key].equal(state[key].cpu()) for key in state):
        raise UserError(
            f"{directory} holds another published agent (task {held.config.get('task')}), which would be lost: choose "
            "another directory, or give --replace"
        )


def load_published(directory: str | os.PathLike[str]) -> Published:
    """Read and verify a published directory.

    Raises:
        UserError: A file is missing, changed, damaged, or of a newer version; the message names it.
    """
    directory = expand(directory)
    with contextlib.suppress(OSError):
        mend_folder(directory.resolve())
    if not directory.is_dir():
        raise UserError(f"there is no published checkpoint {directory}{neighbours(directory)}")
    there = sorted(entry.name for entry in directory.iterdir())
    lacking = [name for name in (*CONTENTS, SUMS) if not os.path.lexists(directory / name)]
    if lacking:
        raise UserError(
            f"{directory} is not a published checkpoint: it lacks {', '.join(lacking)}; "
            f"it holds {', '.join(there[:8]) or 'nothing'}{' ...' if there[8:] else ''}"
        )
    root = _root(directory)
    for name in (*CONTENTS, SUMS):
        regular_file(directory / name, LARGEST if name == WEIGHTS else TEXT, root)
    _verify_sums(directory)
    config = mapping(read_yaml(directory / CONFIG, root=root), directory / CONFIG)
    refuse_newer(directory / CONFIG, config.get("format_version"), FORMAT_VERSION)
    state, _ = read_tensors(directory / WEIGHTS, largest=LARGEST, root=root)
    return Published(directory, state, config, mapping(read_json(directory / METRICS), directory / METRICS))


def weights_hash(path: Path) -> str | None:
    """Hash of what a checkpoint holds, a file or a published directory, wherever it lies; None if it is not there."""
    file = path / WEIGHTS if path.is_dir() else path
    return sha256(file) if file.is_file() else None


def _root(directory: Path) -> Path:
    """The folder that links in a published directory may not leave: itself, or its repository in the Hub's cache."""
    above = directory.resolve().parent
    return above.parent if above.name == "snapshots" and (above.parent / "blobs").is_dir() else directory


def _verify_sums(directory: Path) -> None:
    sums: dict[str, str] = {}
    for line in read_text(directory / SUMS, 4096).splitlines():
        digest, _, name = line.partition("  ")
        if name not in CONTENTS or len(digest) != 64:
            raise UserError(f"{directory / SUMS}: '{line[:80]}' is not a valid line, expected a hash and a file name")
        sums[name] = digest
    for name in CONTENTS:
        if sums.get(name) != sha256(directory / name):
            raise UserError(
                f"{directory / name} is not the file that was published (its hash differs from {SUMS}): "
                "fetch the directory again; if you changed it yourself, update the sums with `sha256sum`"
            )


def _refuse_foreign(target: Path) -> None:
    """Replace only what was published: a wrong path must not destroy other files."""
    if not target.exists():
        return
    if not target.is_dir():
        raise UserError(f"{target} is a file, expected a directory to publish in")
    there = {entry.name for entry in target.iterdir()}
    foreign = sorted(there - {*CONTENTS, SUMS}) if SUMS in there else sorted(there)
    if foreign:
        names = ", ".join(foreign[:5]) + (" ..." if foreign[5:] else "")
        raise UserError(f"{target} holds what was not published: {names}; move it away or choose another directory")


def _plain(value: Any, where: str) -> Any:
    """Return the value with tuples as lists; refuse what YAML and JSON cannot hold as plain values."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(entry, f"{where}: {key}") for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry, where) for entry in value]
    if hasattr(value, "tolist"):  # NumPy and torch
        return _plain(value.tolist(), where)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise UserError(f"{where} is a {type(value).__name__}, expected a number, a text, a list or names with values")


def _short_card(name: str, config: Mapping[str, Any]) -> str:
    about = "\n".join(f"- {key}: {value}" for key, value in config.items() if not isinstance(value, (dict, list)))
    return (
        f"# {name}\n\nDiscrete diffusion skills, written by dds-lightning.\n\n{about}\n\n"
        f'```python\nfrom dds_lightning import DDSAgent\n\nagent = DDSAgent.load("{name}")\n```\n'
    )
