"""The result of a command, for people and for programs."""

import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.errors import printable

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType
    from rich.table import Table


@dataclass
class Report:
    """The result of a command.

    Attributes:
        data: What `--json` prints: anything made of dicts, lists, numbers, strings, arrays and tables.
        text: What a person reads: lines and rich tables.
        status: Exit status of the command.
        silent: Print nothing: another process of the same training does.
    """

    data: Any
    text: list["RenderableType"] = field(default_factory=list)
    status: int = 0
    silent: bool = False

    def print(self, as_json: bool) -> None:
        """Print the data or the text to standard output."""
        if self.silent:
            return
        if as_json:
            print(json.dumps(plain(self.data), indent=2, allow_nan=False))
            return
        from dds_lightning.console.terminal import Terminal

        # A pipe has no width: rich would cut a table at 80 columns, and `grep` would miss what was cut.
        console = Terminal(soft_wrap=True) if sys.stdout.isatty() else Terminal(width=200, soft_wrap=True)
        for line in self.text:
            console.print(printable(line) if isinstance(line, str) else line)


def plain(value: Any) -> Any:
    """Convert tables, arrays, paths and tuples to JSON types; NaN and infinity become null."""
    if hasattr(value, "to_dict") and hasattr(value, "columns"):
        return [plain(row) for row in value.to_dict(orient="records")]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def pairs(lines: Iterable[tuple[str, Any]], title: str | None = None) -> "Table":
    """Draw names and values in two columns; long values wrap beside their names."""
    from rich.table import Table

    drawn = Table(
        title=_title(title), title_justify="left", box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0)
    )
    drawn.add_column(no_wrap=True)
    drawn.add_column(overflow="fold")
    for name, value in lines:
        drawn.add_row(printable(name), printable(str(value)))
    return drawn


def table(frame: "pd.DataFrame", title: str | None = None, digits: int = 3) -> "Table":
    """Draw a DataFrame as a rich table: numbers right-aligned, missing values as a dash."""
    from rich import box
    from rich.table import Table

    drawn = Table(title=_title(title), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in frame.columns:
        numeric = frame[column].dtype.kind in "iuf"
        drawn.add_column(printable(str(column)), justify="right" if numeric else "left", overflow="fold")
    for row in frame.itertuples(index=False):
        drawn.add_row(*(_cell(value, digits) for value in row))
    return drawn


def _cell(value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, float) else printable(str(value))


def _title(text: str | None) -> str | None:
    return None if text is None else printable(text)
