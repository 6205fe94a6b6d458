"""Make each notebook from its script: convert it, run it from top to bottom, write the .ipynb beside it.

    python notebooks/execute.py            # all notebooks
    python notebooks/execute.py 00 02      # those whose names start like this
    python notebooks/execute.py --quick    # only check that they run: few steps, nothing is written
    python notebooks/execute.py --prose    # copy changed prose only, keep the outputs

The scripts (`NN_name.py`, py:percent) are the source; nobody edits an .ipynb. The same script gives the same cells with
the same ids, so that a diff shows what changed in the outputs and nothing else. A notebook that fails, or whose
outputs name a folder of this machine, leaves the old file as it was.

Two kinds of cells are marked by the metadata in their headers:

    # %% tags=["parameters"] quick={"STEPS": 20}      what a quick run changes, and to what; it always changes `RUNS`
    # %% tags=["check"]                               the results are as expected; a quick run leaves this cell out

A quick run needs jupytext, but no Jupyter: the cells run one after the other as plain Python.
"""

import argparse
import ast
import io
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import jupytext

if TYPE_CHECKING:
    import nbformat

HERE = Path(__file__).resolve().parent
ABSOLUTE = re.compile(r"(?<![\w.:/<])/(?:home|root|tmp|usr|opt|work|var|private|Users|mnt|data)/[\w.]")
LIMIT_MB = 2.0
TIMEOUT = 3600
"""Seconds that one cell, or one quick run, may take: the longest needs two minutes, on a busy machine many more."""


# ---------------------------------------------------------------------- reading a script


@dataclass(frozen=True)
class Cell:
    """One cell of a script.

    Attributes:
        kind: "markdown" or "code".
        source: Its text in the notebook: prose and magics without the `#` that hides them from Python.
        metadata: The metadata in its header.
        line: Line of the script, from 1, where its text begins.
    """

    kind: str
    source: str
    metadata: dict[str, Any]
    line: int

    def has_tag(self, tag: str) -> bool:
        """Whether its header gives it this tag."""
        return tag in self.metadata.get("tags", [])


def parse(text: str) -> "nbformat.NotebookNode":
    """The notebook of a py:percent script, without outputs."""
    notebook = jupytext.reads(text, fmt="py:percent")
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("lines_to_next_cell", None)  # jupytext's note of the blank lines in the script
    return notebook


def cells_of_script(text: str) -> list[Cell]:
    """The cells of a py:percent script.

    Raises:
        ValueError: There is text before the first cell, or a header is neither empty nor NAME=JSON.
    """
    lines = text.splitlines()
    headers = [number for number, line in enumerate(lines, 1) if line.startswith("# %%")]
    notebook = parse(text)
    if len(notebook.cells) != len(headers):
        raise ValueError(f"got {len(notebook.cells)} cells for {len(headers)} headers; put no text before the first")
    cells = []
    for cell, header in zip(notebook.cells, headers, strict=True):
        if {"title", "incorrectly_encoded_metadata"} & cell.metadata.keys():
            raise ValueError(f"the header of a cell is '{lines[header - 1]}', expected NAME=JSON after '# %%'")
        cells.append(Cell(cell.cell_type, cell.source, dict(cell.metadata), header + 1))
    return cells


# ---------------------------------------------------------------------- quick runs


def run_quick(script: Path) -> subprocess.CompletedProcess[str]:
    """Run a script with its quick values, in a process and a temporary folder of its own.

    Returns:
        The finished process: `returncode` is 0 if all cells ran, otherwise `stderr` holds the error.
    """
    command = [sys.executable, "-W", "ignore", "-c", "import sys, execute; execute.run_cells(*sys.argv[1:])"]
    with tempfile.TemporaryDirectory() as runs:
        return subprocess.run(  # noqa: S603 - our own script
            [*command, str(script), runs],
            cwd=HERE,
            env={**os.environ, "MPLBACKEND": "Agg"},
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )


def run_cells(script: str, runs: str) -> None:
    """Run a script's code cells in this process, as plain Python, with quick values and without `check` cells.

    What a cell displays is drawn and discarded, so that a figure that cannot be drawn fails here too.

    Args:
        script: Path of the script; errors name its lines.
        runs: The folder that replaces `RUNS`, where the notebook writes.
    """
    stand_in_for_ipython()
    names = vars(sys.modules["__main__"])  # pickle looks for classes of a notebook here
    for cell in cells_of_script(Path(script).read_text(encoding="utf-8")):
        if cell.kind != "code" or cell.has_tag("check"):
            continue
        plain = re.sub(r"^%", "# %", cell.source, flags=re.MULTILINE)  # magics are not Python
        tree = ast.parse("\n" * (cell.line - 1) + plain, script)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, script, "exec"), names)  # noqa: S102 - our own script
        if isinstance(last, ast.Expr):
            show(eval(compile(ast.Expression(last.value), script, "eval"), names))  # noqa: S307
        if cell.has_tag("parameters"):
            names.update(cell.metadata["quick"], RUNS=Path(runs))


def show(*values: Any, **settings: Any) -> SimpleNamespace:
    """Render values as a notebook would and discard the result; replaces IPython's `display`."""
    for value in values:
        if hasattr(value, "savefig"):
            value.savefig(io.BytesIO(), format="png")
        elif hasattr(value, "_repr_html_"):
            value._repr_html_()
        else:
            repr(value)
    return SimpleNamespace(update=show)


def stand_in_for_ipython() -> None:
    """Replace IPython, whether it is installed or not: nobody looks at what a quick run displays."""
    package, shown = ModuleType("IPython"), ModuleType("IPython.display")
    vars(package).update(display=shown, version_info=(9, 0, 0), get_ipython=lambda: None)  # matplotlib asks for both
    nothing = dict.fromkeys(("HTML", "Image", "Markdown", "SVG", "Video", "clear_output"), lambda *_, **__: None)
    vars(shown).update(nothing, display=show)
    sys.modules.update({"IPython": package, "IPython.display": shown})


def quick(script: Path) -> str:
    """Check that a script runs, and return a message.

    Raises:
        SystemExit: The script fails.
    """
    ran = run_quick(script)
    if ran.returncode:
        sys.exit(f"{script.name} does not run with its quick values:\n{ran.stderr}")
    return "runs"


# ---------------------------------------------------------------------- notebooks


def copy_prose(script: Path) -> str:
    """Copy the script's prose into the executed notebook, and return a message.

    Raises:
        SystemExit: The code has changed too.
    """
    import nbformat

    target = script.with_suffix(".ipynb")
    new, old = parse(script.read_text(encoding="utf-8")), nbformat.read(target, as_version=4)
    code = [
        [(cell.source, cell.metadata) if cell.cell_type == "code" else None for cell in notebook.cells]
        for notebook in (new, old)
    ]
    if code[0] != code[1]:
        sys.exit(f"{script.name}: the code has changed too, so execute it")
    for ours, theirs in zip(new.cells, old.cells, strict=True):
        theirs.source = ours.source
    return write(target, nbformat.writes(old))


def execute(script: Path) -> str:
    """Execute a script, write its notebook, and return a message.

    Raises:
        SystemExit: The outputs name a folder of this machine, or the notebook is too large.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = parse(script.read_text(encoding="utf-8"))
    notebook.metadata["kernelspec"] = {"name": "python3", "language": "python", "display_name": "Python 3"}
    NotebookClient(
        notebook,
        timeout=TIMEOUT,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(HERE)}},
        extra_arguments=["--IPKernelApp.log_level=40"],
    ).execute()
    notebook.metadata["language_info"] = {"name": "python"}
    text = nbformat.writes(notebook)
    if match := ABSOLUTE.search(text):
        context = text[match.start() - 80 : match.end() + 80]
        sys.exit(f"{script.name}: an output names a folder of this machine: {context}")
    if len(text) > LIMIT_MB * 1e6:
        sys.exit(f"{script.name}: the notebook has {len(text) / 1e6:.1f} MB, expected less than {LIMIT_MB:g}")
    return write(script.with_suffix(".ipynb"), text)


def write(target: Path, text: str) -> str:
    """Write a file completely or not at all, and return its size as text."""
    part = target.with_suffix(".part")
    part.write_text(text + "\n", encoding="utf-8")
    os.replace(part, target)
    return f"{target.stat().st_size / 1e6:.2f} MB"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Make each notebook from its script, executed from top to bottom.")
    parser.add_argument("names", nargs="*", help="how the names start, for example 00 02 (default: all)")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--quick", action="store_true", help="only check that they run, with few steps; write nothing")
    mode.add_argument("--prose", action="store_true", help="copy changed prose only; keep the outputs")
    arguments = parser.parse_args()
    scripts = [
        script
        for script in sorted(HERE.glob("[0-9][0-9]_*.py"))
        if not arguments.names or script.name.startswith(tuple(arguments.names))
    ]
    if not scripts:
        sys.exit(f"no notebook's name starts with {' or '.join(arguments.names)}")
    work = quick if arguments.quick else copy_prose if arguments.prose else execute
    for script in scripts:
        started = time.monotonic()
        message = work(script)
        print(f"{script.stem}: {time.monotonic() - started:.0f} s, {message}", flush=True)


if __name__ == "__main__":
    main()
