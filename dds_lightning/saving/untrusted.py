"""The one place where files that a stranger may have made are opened, and where folders are deleted.

Published directories, checkpoints, run directories and data sets are made to be shared (SECURITY.md). Their files are
read through the functions here and in `dds_lightning.saving.arrays`:

- only regular files: a pipe would wait for ever, a device has no end;
- no link that leads out of the folder that was given;
- at most so many bytes, values, levels, and copies of one value by an alias;
- whatever a parser raises becomes one sentence that names the file and says what to do.

What a function returns is plain: texts, numbers, lists, and mappings whose names are texts.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from dds_lightning.errors import UserError, reason

if TYPE_CHECKING:
    import pandas as pd

TEXT = 2**20
"""Bytes of a text file, unless a reader says otherwise. Genuine ones have a few thousand."""
VALUES = 100_000
"""Values in a text file; what an alias repeats counts as often as it appears."""
LEVELS = 40
"""Levels of a text file."""
REMEDY = "get it again from where it came from"

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


# ---------------------------------------------------------------------- opening


def regular_file(path: str | Path, largest: int | None = None, root: str | Path | None = None) -> int:
    """Refuse what is not a plain file of a bearable size.

    Args:
        path: The file.
        largest: Bytes that it may have; None sets no limit.
        root: The folder that it must lie in, links followed; None accepts any place.

    Returns:
        Its size in bytes.

    Raises:
        UserError: It is missing, no regular file, too large, or a link out of `root`.
    """
    path = Path(path)
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is missing or cannot be read ({reason(error)})") from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise UserError(f"{path} is {kind}, expected a file")
    if root is not None and not is_inside(path, root):
        raise UserError(f"{path} is a link to {os.path.realpath(path)}, outside of {root}: expected the file itself")
    if largest is not None and found.st_size > largest:
        raise UserError(f"{path} has {found.st_size:,} bytes, expected at most {largest:,}")
    return found.st_size


def is_inside(path: str | Path, root: str | Path) -> bool:
    """Whether a path lies in a folder once links and `..` have been followed."""
    try:
        return Path(path).resolve().is_relative_to(Path(root).resolve())
    except (OSError, RuntimeError):  # links in a circle
        return False


@contextlib.contextmanager
def parsing(what: str | Path, remedy: str = REMEDY, verdict: str = "is damaged") -> Iterator[None]:
    """Turn whatever a parser raises over a file into one sentence.

    Args:
        what: The file, as the sentence begins.
        remedy: What to do, as it ends.
        verdict: What is said about the file.

    Raises:
        UserError: The file cannot be parsed.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # libraries raise anything over damaged files
        raise UserError(f"{what} {verdict}: {' '.join(reason(error).split())[:200]}; {remedy}") from error


def read_text(
    path: str | Path,
    largest: int = TEXT,
    root: str | Path | None = None,
    remedy: str = REMEDY,
    verdict: str = "cannot be read",
) -> str:
    """Read a UTF-8 text; see `regular_file`.

    Raises:
        UserError: It is refused by `regular_file`, or no UTF-8.
    """
    regular_file(path, largest, root)
    with parsing(path, remedy, verdict), open(path, "rb") as file:
        return file.read(largest + 1)[:largest].decode("utf-8")


# ---------------------------------------------------------------------- YAML and JSON


def read_yaml(
    path: str | Path,
    largest: int = TEXT,
    root: str | Path | None = None,
    remedy: str = REMEDY,
    verdict: str = "cannot be read",
) -> Any:
    """Read plain values from YAML; see `parse_yaml`.

    Raises:
        UserError: The file is refused, or its content is.
    """
    return parse_yaml(read_text(path, largest, root, remedy, verdict), path, remedy, verdict)


def parse_yaml(text: str, what: str | Path, remedy: str = REMEDY, verdict: str = "cannot be read") -> Any:
    """Parse plain values from YAML, within `LEVELS` and `VALUES`.

    Raises:
        UserError: It is not valid, holds tags that name code, or is deeper or longer, aliases followed.
    """
    with parsing(what, remedy, verdict):
        depth = 0
        for count, event in enumerate(yaml.parse(text, Loader=_Loader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > LEVELS or count > 3 * VALUES:
                raise UserError(f"{what} is nested deeper than {LEVELS} levels or has more than {VALUES:,} values")
        loader = _Loader(text)
        try:
            return check_plain(loader.get_single_data(), what)
        finally:
            loader.dispose()


def read_json(
    path: str | Path,
    largest: int = TEXT,
    root: str | Path | None = None,
    remedy: str = REMEDY,
    verdict: str = "cannot be read",
) -> Any:
    """Read plain values from JSON; see `parse_json`.

    Raises:
        UserError: The file is refused, or its content is.
    """
    return parse_json(read_text(path, largest, root, remedy, verdict), path, remedy, verdict)


def parse_json(text: str | bytes, what: str | Path, remedy: str = REMEDY, verdict: str = "cannot be read") -> Any:
    """Parse plain values from JSON, within `LEVELS` and `VALUES`.

    Raises:
        UserError: It is not valid, or deeper or longer.
    """
    with parsing(what, remedy, verdict):
        return check_plain(json.loads(text), what)


def mapping(value: Any, what: str | Path) -> dict[str, Any]:
    """Return a value that must be a mapping of names to values.

    Raises:
        UserError: It is another kind of value.
    """
    if not isinstance(value, dict):
        raise UserError(f"{what} holds a {type(value).__name__}, expected names with values")
    return value


def check_plain(value: Any, what: str | Path, most: int = VALUES) -> Any:
    """Return a value, unless it is too deep, too long or refers to itself, or a name in it is not a text.

    Values that appear several times are the same object in memory, whatever their number; printed or copied they are
    not, so each appearance counts.

    Raises:
        UserError: See above.
    """
    sizes: dict[int, int] = {}

    def size(node: Any, level: int) -> int:
        if not isinstance(node, (dict, list, tuple, set)):
            return 1
        if level > LEVELS:
            raise UserError(f"{what} is nested deeper than {LEVELS} levels, or refers to itself")
        if id(node) not in sizes:
            if isinstance(node, dict):
                for key in node:
                    if not isinstance(key, (str, int)):
                        raise UserError(f"{what} has a {type(key).__name__} where a name was expected")
            inner = node.values() if isinstance(node, dict) else node
            sizes[id(node)] = 1 + sum(size(entry, level + 1) for entry in inner)
        if sizes[id(node)] > most:
            raise UserError(f"{what} has more than {most:,} values once its aliases are followed")
        return sizes[id(node)]

    size(value, 0)
    return value


def read_csv(
    path: str | Path, columns: Mapping[str, str], largest: int = 64 * TEXT, remedy: str = REMEDY
) -> pd.DataFrame:
    """Read a table of numbers.

    Args:
        path: The file.
        columns: Column that must be there -> kinds of NumPy that it may have, for example "iuf". Others must be numbers
            too.
        largest: Bytes that it may have.
        remedy: What to do about a damaged file.

    Raises:
        UserError: It is damaged, a column is missing, or holds something else.
    """
    import pandas as pd

    text = read_text(path, largest, remedy=remedy)
    with parsing(path, remedy):
        for row in csv.reader(io.StringIO(text[:TEXT].partition("\n")[0])):
            if len(row) > 1000 or len(set(row)) < len(row):
                raise UserError(f"{path} has {len(row)} columns, expected at most 1000, each of another name")
        table = pd.read_csv(io.StringIO(text))
        check_columns(table, {**dict.fromkeys(table.columns, "iufb"), **columns}, path, remedy)
    return table


def check_columns(table: pd.DataFrame, columns: Mapping[str, str], what: str | Path, remedy: str = REMEDY) -> None:
    """Refuse a table that lacks a column, or has another kind of value in it.

    Args:
        table: The table.
        columns: Column -> kinds of NumPy that it may have.
        what: The file, for messages.
        remedy: What to do.

    Raises:
        UserError: See above.
    """
    for name, kinds in columns.items():
        if name not in table:
            raise UserError(f"{what} has no column '{name}': {remedy}")
        if (kind := getattr(table[name].dtype, "kind", "O")) not in kinds:
            raise UserError(f"{what}, column '{name}': got values of type {table[name].dtype} ({kind}): {remedy}")


def conform(value: Any, form: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Return a mapping of plain values, if it has at least the entries of a form.

    Args:
        value: What was read.
        form: Name -> the types that its value may have, or the form of a mapping. An entry that may be None may be
            missing. Numbers must be finite, and texts lose what `safe_name` takes away.
        what: The file and the place in it, for messages.

    Raises:
        UserError: Names the first entry that is missing or of another type.
    """
    found = dict(mapping(value, what))
    for name, kinds in form.items():
        entry = found.get(name)
        if isinstance(kinds, Mapping):
            found[name] = conform(entry, kinds, f"{what}, {name}")
            continue
        fine = isinstance(entry, kinds) and not (isinstance(entry, bool) and bool not in kinds)
        if not fine or (isinstance(entry, float) and not math.isfinite(entry)):
            raise UserError(f"{what}: {name} is {str(entry)[:80]!r}, expected {' or '.join(k.__name__ for k in kinds)}")
        found[name] = safe_name(entry) if isinstance(entry, str) else entry
    return found


def safe_name(value: Any, longest: int = 200) -> str:
    """Return a name found in a file without what a terminal, a page or Markdown would act on.

    Names of data sets and contestants are printed, and end up in reports and on pages. Letters of every script, digits,
    spaces and the punctuation of our own names stay.
    """
    return re.sub(r"[^\w .,:;()+=@/%'°±-]", "", str(value))[:longest]


# ---------------------------------------------------------------------- links and deleting


def refuse_links(root: str | Path) -> None:
    """Refuse a run directory that somebody else may have made, if working in it would lead elsewhere.

    Args:
        root: The folder; it may itself be a link, which the user made.

    Raises:
        UserError: Something directly in it is a link (these are replaced and removed), or a link further down leads
            out of it.
    """
    for folder, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(folder, name)
            if path.is_symlink() and (Path(folder) == Path(root) or not is_inside(path, root)):
                raise UserError(
                    f"{path} is a link to {os.readlink(path)}, expected the file or folder itself: a run directory "
                    "must hold all that is in it, because what lies there is written and replaced"
                )


def remove_tree(path: Path, root: Path) -> None:
    """Delete a folder that lies in another one, without following a link on the way; nothing happens if it is missing.

    Args:
        path: The folder to delete.
        root: The folder that it must really lie in.

    Raises:
        UserError: `path` or a folder between `root` and it is a link.
    """
    if not os.path.lexists(path):
        return
    if path.is_symlink() or path.resolve() != root.resolve() / path.relative_to(root):
        raise UserError(f"{path} was not deleted: there is a link on the way to {path.resolve()}, expected a folder")
    shutil.rmtree(path, ignore_errors=True)
