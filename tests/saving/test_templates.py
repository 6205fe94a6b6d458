"""Documents from templates: what is escaped, and that nothing is silently left out."""

import sys

import pytest
from jinja2 import UndefinedError

from dds_lightning.saving.templates import render


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with one template in two formats."""
    (tmp_path / "made_for_a_test").mkdir()
    (tmp_path / "made_for_a_test" / "__init__.py").touch()
    for name in ("page.html.jinja", "card.md.jinja"):
        (tmp_path / "made_for_a_test" / name).write_text("{% if text %}\n{{ text | twice }}\n{% endif %}\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield "made_for_a_test"
    sys.modules.pop("made_for_a_test", None)


def test_html_is_escaped_and_markdown_is_not(package):
    twice = {"twice": lambda text: text + text}
    assert render(package, "page.html.jinja", {"text": "<b>"}, filters=twice) == "&lt;b&gt;&lt;b&gt;\n"
    assert render(package, "card.md.jinja", {"text": "<b>"}, filters=twice) == "<b><b>\n"


def test_a_missing_value_is_an_error(package):
    with pytest.raises(UndefinedError, match="'text' is undefined"):
        render(package, "card.md.jinja", {}, filters={"twice": str})
