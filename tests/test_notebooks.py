"""The notebooks: each .ipynb is what its script says, was run from top to bottom, and runs again."""

import ast
import json
import re
import shlex
from pathlib import Path

import pytest

from dds_lightning.cli.parser import build_parser, prepare
from dds_lightning.tasks import task_names
from dds_lightning.training.stage_cli import settings_of
from notebooks.execute import cells_of_script, run_quick

HERE = Path(__file__).parents[1] / "notebooks"
SCRIPTS = sorted(HERE.glob("[0-9][0-9]_*.py"))
ABSOLUTE = re.compile(r"(?<![\w.:/<-])(?:/(?:home|root|tmp|usr|opt|work|var|private|Users|mnt)/|[A-Z]:\\)\w")
each_script = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def cells_of(script, kind=None, tag=None):
    cells = cells_of_script(script.read_text(encoding="utf-8"))
    return [cell for cell in cells if kind in (None, cell.kind) and (tag is None or cell.has_tag(tag))]


def prose_of(script):
    return "\n".join(cell.source for cell in cells_of(script, "markdown"))


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
    blocks = re.findall(r"^```bash\n(.*?)^```", prose_of(script), flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("dds ")]


def test_each_notebook_has_a_number_its_script_and_its_row():
    stems = [script.stem for script in SCRIPTS]
    assert len({stem[:2] for stem in stems}) == len(stems) >= 9
    assert [path.stem for path in sorted(HERE.glob("*.ipynb"))] == stems
    linked = re.findall(r"^\| \[.*?\]\((.*?)\.ipynb\)", (HERE / "README.md").read_text(), flags=re.MULTILINE)
    assert linked == stems


@each_script
def test_script_and_notebook_agree(script):
    found = [(cell["cell_type"], "".join(cell["source"]), cell["metadata"]) for cell in notebook_of(script)["cells"]]
    expected = [(cell.kind, cell.source, cell.metadata) for cell in cells_of(script)]
    assert found == expected, "python notebooks/execute.py makes the notebook anew"


def test_a_cell_has_a_line_and_metadata_or_its_header_is_refused():
    text = '# %% [markdown]\n# prose\n\n# %% tags=["check"] quick={"A": 1, "B": [2]}\n# %time\nx = 1\n'
    first, second = cells_of_script(text)
    assert (first.kind, first.source, first.line) == ("markdown", "prose", 2)
    assert (second.source, second.line) == ("%time\nx = 1", 5)
    assert second.metadata == {"tags": ["check"], "quick": {"A": 1, "B": [2]}}
    for header in ("# %% a title", "# %% tags=[broken"):
        with pytest.raises(ValueError, match=re.escape(f"is '{header}', expected NAME=JSON")):
            cells_of_script(f"{header}\nx = 1\n")
    with pytest.raises(ValueError, match="got 2 cells for 1 headers; put no text before the first"):
        cells_of_script("x = 1\n# %%\ny = 2\n")


@each_script
def test_its_parameters_are_in_one_cell_that_says_what_is_quick(script):
    (cell,) = cells_of(script, "code", "parameters")
    statements = ast.parse(cell.source).body
    assert {type(statement) for statement in statements} == {ast.Assign}, "a quick run replaces values, nothing else"
    names = {name.id for node in statements for target in node.targets for name in ast.walk(target)
             if isinstance(name, ast.Name)}  # fmt: skip
    assert "RUNS" in names
    assert cell.metadata["quick"].keys() <= names - {"RUNS"}
    assert [other.line for other in cells_of(script) if "quick" in other.metadata] == [cell.line]


@each_script
def test_one_cell_checks_what_was_found(script):
    (cell,) = cells_of(script, "code", "check")
    assert 'assert checks["fine"].all(), checks' in cell.source


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
    prose = prose_of(script)
    for heading in ("**What you will see:**", "**Time:**", "## What you should see", "## Exercises"):
        assert heading in prose


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
            task = settings_of(words[0], words[1:])["data"]["task"]
            assert task is None or task.partition("@")[0] in task_names()  # own data have no task
        else:
            build_parser()[0].parse_args(prepare(words))


def written_by(words):
    """Where a command of the prose writes."""
    if words[0] == "publish":
        return words[2:3]
    return [words[i + 1] for i, word in enumerate(words[:-1]) if word in ("--out", "--checkpoint.dirpath")]


def test_commands_read_only_what_the_repository_the_notebook_or_an_earlier_command_holds():
    there = []
    for script in SCRIPTS:
        number, code = script.stem[:2], "\n".join(cell.source for cell in cells_of(script, "code"))
        for words in commands_of(script):
            made = written_by(words)
            for word in words:
                path = word.partition(":")[2] or word
                if not path.startswith(("runs/", "data/", "checkpoints/", "shared/")) or word in made:
                    continue
                own = path.removeprefix(f"runs/notebooks/{number}/")
                ours = own != path and f'RUNS / "{own.split("/")[0]}"' in code
                earlier = any(path == one or path.startswith(f"{one}/") for one in there)
                assert ours or earlier or (HERE.parent / path).exists(), f"{script.stem}: {path} in {' '.join(words)}"
            there += made


@each_script
def test_each_exercise_has_its_answer(script):
    exercises, _, answers = prose_of(script).partition("## Exercises")[2].partition("<summary>Answers</summary>\n\n")
    numbers = [re.findall(r"^(\d)\. ", part.partition("</details>")[0], re.MULTILINE) for part in (exercises, answers)]
    assert numbers[0] == numbers[1] == [str(i + 1) for i in range(len(numbers[0]))] != []


@pytest.mark.slow
@each_script
def test_it_runs(script):
    """With quick values: the numbers mean nothing then, and the cell that checks them is left out."""
    ran = run_quick(script)
    assert ran.returncode == 0, ran.stderr


SMALL = """# %%
# %matplotlib inline
from pathlib import Path
from IPython.display import Image, display

# %% tags=["parameters"] quick={"STEPS": 2}
STEPS = 1_000
RUNS = Path("runs")

# %%
assert STEPS == 2
assert RUNS.is_dir()
assert RUNS != Path("runs")
display(STEPS, display_id=True).update(Image(data=b""))
SHOWN

# %% tags=["check"]
assert STEPS == 1_000
"""


def test_a_quick_run_replaces_values_and_leaves_the_check_out(tmp_path):
    script = tmp_path / "small.py"
    script.write_text(SMALL.replace("SHOWN", "STEPS"), encoding="utf-8")
    ran = run_quick(script)
    assert ran.returncode == 0, ran.stderr


def test_a_quick_run_draws_what_a_cell_shows_and_errors_name_the_line(tmp_path):
    script = tmp_path / "small.py"
    bad = "import matplotlib.figure\nmatplotlib.figure.Figure(figsize=(-1, 1))"
    script.write_text(SMALL.replace("SHOWN", bad), encoding="utf-8")
    ran = run_quick(script)
    assert ran.returncode == 1
    assert f'"{script}", line 16' in ran.stderr
