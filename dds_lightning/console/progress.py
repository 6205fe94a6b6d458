"""Progress on standard error: bars that are redrawn on a terminal, and plain lines or silence elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from rich import progress as bars

from dds_lightning.console.terminal import Terminal

T = TypeVar("T")

COLUMNS: dict[str, Callable[[], bars.ProgressColumn]] = {
    "bar": bars.BarColumn,
    "bytes": bars.DownloadColumn,
    "count": bars.MofNCompleteColumn,
    "elapsed": bars.TimeElapsedColumn,
    "percent": bars.TaskProgressColumn,
    "remaining": bars.TimeRemainingColumn,
    "speed": bars.TransferSpeedColumn,
    "spinner": bars.SpinnerColumn,
}
"""Names that a layout may use for rich's columns; anything else in a layout is text, such as "{task.description}"."""


def on_terminal() -> bool:
    """Whether standard error is a terminal."""
    return Terminal(stderr=True).is_terminal


@contextmanager
def progress_bar(
    layout: Sequence[str],
    total: float | None,
    description: str = "",
    *,
    shown: bool = True,
    transient: bool = True,
    console: Terminal | None = None,
    **fields: Any,
) -> Iterator[Callable[..., None]]:
    """Show a bar on standard error while the block runs.

    Args:
        layout: The columns from left to right: names of `COLUMNS`, or text that may use `{task.description}` and
            `{task.fields[NAME]}`.
        total: What the bar counts to; None if that is not known yet.
        description: Text of the task.
        shown: Draw anything at all. Most callers pass `on_terminal()`; without a terminal rich writes one line at the
            end.
        transient: Remove the bar at the end.
        console: The console to draw on; by default standard error.
        **fields: First values of the fields that the layout names.

    Yields:
        A function that takes `advance`, `completed`, `total`, `description` and fields; see rich's `Progress.update`.
    """
    if not shown:  # not rich's `disable`: in rich 13.7 that writes an empty line
        yield lambda **changes: None
        return
    columns = [COLUMNS[name]() if name in COLUMNS else bars.TextColumn(name, markup=False) for name in layout]
    console = console or Terminal(stderr=True)
    with bars.Progress(*columns, console=console, transient=transient) as progress:
        yield partial(progress.update, progress.add_task(description, total=total, **fields))


def track(
    items: Iterable[T],
    layout: Sequence[str],
    total: float,
    description: str,
    size: Callable[[T], float] = lambda item: 1,
    **settings: Any,
) -> Iterator[T]:
    """Iterate over items and advance a bar by `size(item)` after each; `**settings` go to `progress_bar`."""
    with progress_bar(layout, total, description, **settings) as update:
        for item in items:
            yield item
            update(advance=size(item))


@contextmanager
def announcements(total: int) -> Iterator[Callable[[str], None]]:
    """Announce what is being done: beside a bar on a terminal, as plain lines elsewhere, notebooks included.

    Args:
        total: Number of announcements, for the bar.

    Yields:
        A function that takes the next announcement.
    """
    notebook = Terminal().is_jupyter  # plain lines are what a notebook can show, whatever its streams claim to be
    console = Terminal(stderr=True, force_jupyter=False, force_terminal=False if notebook else None)
    shown = console.is_terminal
    with progress_bar(
        ("spinner", "bar", "{task.description}", "elapsed"), total, shown=shown, console=console
    ) as update:

        def announce(text: str) -> None:
            update(advance=1, description=text)
            if not shown:
                console.print(text)

        yield announce
