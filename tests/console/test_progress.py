"""Progress: what a terminal, a file and a notebook show, always on standard error."""

import io
import re

import pytest
from rich.console import Console

from dds_lightning.console import progress


def on(monkeypatch, terminal):
    """Let standard error be a terminal of 80 columns, or a file."""
    monkeypatch.setattr("rich.console.Console.is_terminal", property(lambda self: terminal))
    return progress.on_terminal()


def test_a_bar_shows_its_columns_in_order_and_the_fields_that_were_updated():
    console = Console(file=io.StringIO(), width=80)
    layout = ("episodes", "bar", "count", "mean {task.fields[mean]:.0f} %", "remaining")
    with progress.progress_bar(layout, 4, transient=False, console=console, mean=0.0) as update:
        update(advance=3, mean=75.0)
    assert re.fullmatch(r"episodes [━╸ ]+ 3/4 mean 75 % -:--:--", console.file.getvalue().strip())


def test_a_hidden_bar_writes_nothing(capsys):
    with progress.progress_bar(("bar",), 2, shown=False) as update:
        update(advance=1)
    assert capsys.readouterr() == ("", "")


def test_tracked_items_come_in_order_and_advance_by_their_size(capsys):
    words = ["a", "bcd", "ef"]
    layout = ("{task.description}", "count")
    assert list(progress.track(words, layout, 6, "letters", len, transient=False)) == words
    out, err = capsys.readouterr()
    assert out == ""
    assert err.strip() == "letters 6/6"  # a file gets the last state only


@pytest.mark.parametrize("terminal", [True, False])
def test_announcements_are_lines_where_there_is_no_terminal(monkeypatch, capsys, terminal):
    assert on(monkeypatch, terminal) == terminal
    with progress.announcements(2) as announce:
        announce("replaying skills")
        announce("drawing")
    out, err = capsys.readouterr()
    assert out == ""
    assert (err == "replaying skills\ndrawing\n") == (not terminal)


def test_a_notebook_gets_plain_lines_even_where_colours_are_forced(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    with progress.announcements(1) as announce:
        announce("replaying skills")
    assert capsys.readouterr() == ("", "replaying skills\n")
