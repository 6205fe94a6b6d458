"""The console that everything is printed on: names from files reach the terminal as text and as nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from dds_lightning.errors import printable


class Terminal(Console):
    """Rich's console without markup, emoji and highlighting, on which escape sequences of a text are shown as codes.

    Paths and names may hold square brackets, which are no markup, and whatever a stranger wrote into them.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{"markup": False, "emoji": False, "highlight": False, **settings})

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render as rich does; what a segment says is made printable, its style and rich's own controls stay."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)
