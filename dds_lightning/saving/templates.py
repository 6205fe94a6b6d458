"""Documents from jinja2 templates that lie beside the code which fills them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined


def render(
    package: str,
    name: str,
    values: Mapping[str, Any],
    *,
    filters: Mapping[str, Callable[..., Any]] | None = None,
    tests: Mapping[str, Callable[..., bool]] | None = None,
) -> str:
    """Render a template.

    Args:
        package: The package that holds the template.
        name: Its file name; values are escaped where it contains ".html".
        values: The names that the template uses; one that is missing is an error.
        filters: Filters of the template, beside jinja2's own.
        tests: Tests of the template, beside jinja2's own.
    """
    environment = Environment(
        autoescape=".html" in name,  # noqa: S701 - the others are Markdown
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= filters or {}
    environment.tests |= tests or {}
    return environment.from_string(files(package).joinpath(name).read_text(encoding="utf-8")).render(values)
