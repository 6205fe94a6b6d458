"""The notebooks: each .ipynb is what its script says, was run from top to bottom, and runs again."""

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from dds_lightning.cli.parser import build_parser, prepare
from dds_lightning.training.fitting import settings_of

HERE = Path(__file__).parents[1] / "notebooks"
SCRIPTS = sorted(HERE.glob("[0-9][0-9]_*.py"))
ABSOLUTE = re.compile(r"(?<![\w.:/<-])(?:/(?:home|root|tmp|usr|opt|work|var|private|Users|mnt)/|[A-Z]:\\)\w")
IPYTHON = """Image = dict

def display(*args, **kwargs):
    return type("Handle", (), {"update": lambda *args: None})()
"""
each_script = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def cells_of_script(text):
    """The cells of a py:percent script as (type, source), as jupytext reads them."""
    body = re.sub(r"\A# ---\n.*?\n# ---\n", "", text, flags=re.DOTALL)
    parts = re.split(r"^# %%(.*)\n", body, flags=re.MULTILINE)
    assert not parts[0].strip(), "something stands before the first cell"
    cells = []
    for header, source in zip(parts[1::2], parts[2::2], strict=True):
        markdown = "[markdown]" in header
        pattern = r"^# ?" if markdown else r"^# (?=%[a-z])"  # prose is commented, so are magics
        source = re.sub(pattern, "", source.strip("\n"), flags=re.MULTILINE)
        cells.append(("markdown" if markdown else "code", source))
    return cells


def notebook_of(script):
    return json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))


def outputs_of(script):
    return [output for cell in notebook_of(script)["cells"] for output in cell.get("outputs", [])]


def text_of(output):
    """Everything in an output that is no picture."""
    data = {kind: value for kind, value in output.get("data", {}).items() if not kind.startswith("image/")}
    return "".join(output.get("text", [])) + "".join("".join(value) for value in data.values())


def commands_of(script):
    """The words of each `dds` command in the prose."""
    prose = "\n".join(source for kind, source in cells_of_script(script.read_text()) if kind == "markdown")
    blocks = re.findall(r"^```bash\n(.*?)^```", prose, flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("dds ")]


def test_there_are_notebooks_and_each_has_its_script():
    assert len(SCRIPTS) >= 4
    assert [path.stem for path in sorted(HERE.glob("*.ipynb"))] == [script.stem for script in SCRIPTS]


@each_script
def test_script_and_notebook_agree(script):
    found = [(cell["cell_type"], "".join(cell["source"])) for cell in notebook_of(script)["cells"]]
    expected = cells_of_script(script.read_text(encoding="utf-8"))
    assert found == expected, "python notebooks/execute.py makes the notebook anew"


@pytest.mark.skipif(find_spec("jupytext") is None, reason="jupytext is not installed (make notebooks-env)")
@each_script
def test_jupytext_reads_the_script_as_this_test_does(script):
    import jupytext

    cells = [(cell["cell_type"], cell["source"]) for cell in jupytext.read(script)["cells"]]
    assert cells == cells_of_script(script.read_text(encoding="utf-8"))


@each_script
def test_it_was_run_once_from_top_to_bottom_without_an_error(script):
    cells = notebook_of(script)["cells"]
    counts = [cell["execution_count"] for cell in cells if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    kinds = {(output["output_type"], output.get("name")) for output in outputs_of(script)}
    assert not [kind for kind in kinds if kind[0] == "error" or kind[1] == "stderr"]


@each_script
def test_its_outputs_name_no_machine_and_are_small(script):
    named = [match.group() for output in outputs_of(script) if (match := ABSOLUTE.search(text_of(output)))]
    assert named == []
    assert script.with_suffix(".ipynb").stat().st_size < 2_000_000


@each_script
def test_it_shows_something_and_ends_with_what_one_should_see(script):
    pictures = [output for output in outputs_of(script) if "image/png" in output.get("data", {})]
    assert len(pictures) >= 3
    prose = "\n".join(source for kind, source in cells_of_script(script.read_text()) if kind == "markdown")
    for heading in ("**What you will see:**", "**Time:**", "## What you should see", "## Exercises"):
        assert heading in prose
    assert 'assert checks["fine"].all()' in script.read_text()


@each_script
def test_it_uses_public_names_only(script):
    tree = ast.parse(script.read_text(encoding="utf-8"))
    names = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            names += [*(node.module or "").split("."), *(alias.name for alias in node.names)]
    assert [name for name in names if name.startswith("_") and not name.endswith("__")] == []


@each_script
def test_its_commands_parse(script):
    commands = commands_of(script)
    assert commands
    for words in commands:
        if words[0] in ("skill", "policy"):
            assert settings_of(words[0], words[1:])["data"]["task"] == "pointmaze-large-diverse"
        else:
            build_parser()[0].parse_args(prepare(words))


@pytest.mark.slow
@each_script
def test_it_runs_as_plain_python(script, tmp_path):
    """With few steps: the numbers mean nothing then, and their checks know it."""
    environment = {**os.environ, "DDS_NOTEBOOK_STEPS": "20", "DDS_NOTEBOOK_RUNS": str(tmp_path / "runs")}
    if find_spec("IPython") is None:  # two names of it are all that the notebooks use
        (tmp_path / "IPython").mkdir()
        stand_in = (
            "def display(*a, **k):\n    return type('Handle', (), {'update': lambda *a: None})()\n\n\nImage = dict\n"
        )
        (tmp_path / "IPython" / "display.py").write_text(stand_in)
        (tmp_path / "IPython" / "__init__.py").write_text("version_info = (9, 0, 0)\n")  # matplotlib asks for it
        environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment.get("PYTHONPATH", "")])
    command = [sys.executable, "-W", "ignore", script.name]
    ran = subprocess.run(command, cwd=HERE, env=environment, capture_output=True, text=True, timeout=400, check=False)
    assert ran.returncode == 0, ran.stderr
