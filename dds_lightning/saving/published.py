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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch
import yaml
from torch import Tensor, nn

from dds_lightning._version import __version__
from dds_lightning.errors import UserError
from dds_lightning.saving.files import folder_written_whole, mend_folder, neighbours, refuse_newer, sha256

FORMAT_VERSION = 1
WEIGHTS, CONFIG, METRICS, CARD, SUMS = (
    "model.safetensors",
    "config.yaml",
    "metrics.json",
    "README.md",
    "SHA256SUMS",
)
CONTENTS = (WEIGHTS, CONFIG, METRICS, CARD)

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
        state = {key.removeprefix(f"{part}."): value for key, value in self.state.items() if key.startswith(f"{part}.")}
        return build_module(cls, self.config[part], state, f"{self.directory} ({part})")


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
    target = Path(directory).expanduser().resolve()
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


def load_published(directory: str | os.PathLike[str]) -> Published:
    """Read and verify a published directory.

    Raises:
        UserError: A file is missing, changed, damaged, or of a newer version; the message names it.
    """
    directory = Path(directory).expanduser()
    with contextlib.suppress(OSError):
        mend_folder(directory.resolve())
    if not directory.is_dir():
        raise UserError(f"there is no published checkpoint {directory}{neighbours(directory)}")
    there = sorted(entry.name for entry in directory.iterdir())
    lacking = [name for name in (*CONTENTS, SUMS) if not (directory / name).is_file()]
    if lacking:
        raise UserError(
            f"{directory} is not a published checkpoint: it lacks {', '.join(lacking)}; "
            f"it holds {', '.join(there) or 'nothing'}"
        )
    _verify_sums(directory)
    config = _read(directory / CONFIG, yaml.safe_load)
    refuse_newer(directory / CONFIG, config.get("format_version"), FORMAT_VERSION)
    try:
        state = safetensors.torch.load_file(directory / WEIGHTS)
    except (safetensors.SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{directory / WEIGHTS} is damaged: {error}") from None
    return Published(directory, state, config, _read(directory / METRICS, json.loads))


def _verify_sums(directory: Path) -> None:
    sums: dict[str, str] = {}
    for line in (directory / SUMS).read_text(encoding="utf-8", errors="replace").splitlines():
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


def _read(path: Path, parse: Callable[[str], Any]) -> dict[str, Any]:
    try:
        value = parse(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read: {str(error).splitlines()[0]}") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} holds a {type(value).__name__}, expected names with values")
    return value


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


def build_module(cls: type[M], settings: Mapping[str, Any], state: Mapping[str, Tensor], origin: str) -> M:
    """Build a module and load its weights; errors name the file."""
    # Lightning's command line stores `_instantiator` and the like, names of code to call: they are never followed.
    settings = {key: value for key, value in settings.items() if not str(key).startswith("_")}
    try:
        with torch.device("meta"):  # takes no memory, whatever widths a file names
            own = {name: value.shape for name, value in cls(**settings).state_dict().items()}
    except TypeError as error:
        reason = str(error).replace("__init__()", "it").replace(f"{cls.__name__}.", "")
        raise UserError(f"{origin} does not hold a {cls.__name__} of this version: {reason}") from None
    except UserError as error:
        raise UserError(f"{origin}: {error}") from None
    except (RuntimeError, ValueError, ArithmeticError, AssertionError) as error:
        reason = str(error).split("\n", 1)[0]
        raise UserError(f"{origin} holds settings with which no {cls.__name__} can be built: {reason}") from None
    missing, unknown = sorted(own.keys() - state.keys()), sorted(state.keys() - own.keys())
    if missing or unknown:
        lists = ((what, names) for what, names in (("lacks", missing), ("has unknown", unknown)) if names)
        text = " and ".join(f"{what} {', '.join(names[:3])}{' ...' if names[3:] else ''}" for what, names in lists)
        raise UserError(f"{origin} does not fit {cls.__name__}: it {text}")
    for name, value in state.items():
        if value.shape != own[name]:
            shapes = f"{tuple(value.shape)}, expected {tuple(own[name])}"
            raise UserError(f"{origin} does not fit {cls.__name__}: {name} is {shapes}")
    module = cls(**settings)
    learnt = {name for name, _ in module.named_parameters()}
    for name, value in state.items():
        bad = ~torch.isfinite(value) if name in learnt else torch.isnan(value)  # a buffer may say "no bound"
        if bool(bad.any()):
            found = "NaN" if bool(torch.isnan(value).any()) else "infinity"
            raise UserError(f"{origin} holds {found} in {name}: its training diverged; take an earlier checkpoint")
    module.load_state_dict(state)
    return module.eval()
