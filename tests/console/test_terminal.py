"""What is printed is text: brackets are no markup, and nothing that a stranger wrote acts on the terminal."""

import io
import json

import pandas as pd
import pytest

from dds_lightning.cli import _complain, _warn
from dds_lightning.console.progress import progress_bar
from dds_lightning.console.reports import Report, pairs, table
from dds_lightning.console.terminal import Terminal
from dds_lightning.errors import UserError, printable
from dds_lightning.saving.run_directory import RunDirectory

EVIL = "a\x1b[2J\x1b]0;owned\x07\x9b31m\u202etxt.exe\r"
SHOWN = r"a\x1b[2J\x1b]0;owned\x07\x9b31m\u202etxt.exe\r"
BRACKETS = "local:[/b]/d [red]x[/] :smile:"


def test_what_a_terminal_acts_on_is_shown_as_its_code():
    assert printable(EVIL) == SHOWN
    assert printable("Grüße\n\t✓ ±") == "Grüße\n\t✓ ±"
    assert printable("\ud800") == r"\ud800"
    assert str(UserError(f"task: {EVIL}")) == f"task: {SHOWN}"
    long = str(UserError(f"task is {'x' * 10**6}, expected the name of a task"))
    assert len(long) < 1100
    assert long.endswith("x, expected the name of a task")


@pytest.mark.parametrize(
    "shown",
    [
        str,
        lambda text: pairs([(text, text)], title=text),
        lambda text: table(pd.DataFrame({text: [text]}), title=text),
    ],
)
def test_reports_show_texts_as_they_are_and_never_act(capsys, shown):
    Report({"name": EVIL}, [shown(BRACKETS), shown(EVIL)]).print(as_json=False)
    out = capsys.readouterr().out
    assert BRACKETS in out
    assert SHOWN in out.replace("\n", "")
    assert not set(out) & set("\x1b\x07\x9b\u202e\r")
    Report({"name": EVIL}).print(as_json=True)
    out = capsys.readouterr().out
    assert json.loads(out) == {"name": EVIL}
    assert "\x1b" not in out


def test_colours_of_our_own_still_reach_a_terminal():
    file = io.StringIO()
    Terminal(file=file, force_terminal=True, color_system="standard").print("done \x1b[2J", style="bold")
    assert file.getvalue() == "\x1b[1mdone \\x1b[2J\x1b[0m\n"


def test_errors_and_warnings_of_commands_are_text(capsys):
    _complain(f"no {EVIL}")
    _warn(f"old {EVIL}")
    assert capsys.readouterr().err == f"dds: error: no {SHOWN}\ndds: warning: old {SHOWN}\n"


def test_a_bar_shows_its_description_as_text():
    file = io.StringIO()
    with progress_bar(
        ("{task.description}",), 1, f"{BRACKETS} {EVIL}", transient=False, console=Terminal(file=file, width=200)
    ):
        pass
    assert BRACKETS in file.getvalue()
    assert "\\x1b[2J" in file.getvalue()
    assert "\x1b" not in file.getvalue()


def test_brackets_in_the_settings_of_a_run_are_no_markup(tmp_path):
    """Its story: `--data local:[/b]/d` ended in an error of rich's markup."""
    file = io.StringIO()
    for data in (BRACKETS, EVIL):
        steps = RunDirectory(tmp_path, Terminal(file=file, width=400))
        steps.do("data", f"data {data}", {"data": data}, [], lambda folder, resuming: {})
    assert BRACKETS in file.getvalue()
    assert "\x1b" not in file.getvalue()
