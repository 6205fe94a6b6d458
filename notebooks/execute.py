"""Make each notebook from its script: convert, run from top to bottom, write the .ipynb beside it.

    python notebooks/execute.py            # all
    python notebooks/execute.py 00 02      # those whose names begin so
    python notebooks/execute.py --quick    # only see whether they run: few steps, nothing is written
    python notebooks/execute.py --prose    # copy changed prose only, keep the outputs

Scripts (`NN_name.py`, py:percent) are the source; nobody edits an .ipynb. The same script gives the same cells with
the same ids, so that a diff shows what changed in the outputs and nothing else. A notebook that fails, or whose
outputs name a folder of this machine, leaves the old file as it was.

Two kinds of cells are told by the metadata in their headers:

    # %% tags=["parameters"] quick={"STEPS": 20}      what a quick run changes, and to what; `RUNS` it always changes
    # %% tags=["check"]                               what was found is as expected; a quick run leaves it out

A quick run needs nothing of Jupyter: the cells run one after the other as plain Python.
"""

import argparse
import ast
import io
import json
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

if TYPE_CHECKING:
    import nbformat

HERE = Path(__file__).resolve().parent
ABSOLUTE = re.compile(r"(?<![\w.:/<])/(?:home|root|tmp|usr|opt|work|var|private|Users|mnt|data)/[\w.]")
LIMIT_MB = 2.0
PATIENCE = 3600
"""Seconds that one cell, or one quick run, may take: the longest needs two minutes, on a busy machine many more."""


# ---------------------------------------------------------------------- reading a script


@dataclass(frozen=True)
class Cell:
    """One cell of a script."""

    kind: str
    """`markdown` or `code`."""
    source: str
    """Its text in the notebook: prose and magics without the `#` that hides them from Python."""
    metadata: dict[str, Any]
    line: int
    """Where its text begins in the script, from 1."""

    def has_tag(self, tag: str) -> bool:
        """Whether its header gives it this tag."""
        return tag in self.metadata.get("tags", [])


def cells_of_script(text: str) -> list[Cell]:
    """The cells of a py:percent script, as jupytext reads them.

    Raises:
        ValueError: something stands before the first cell, or a header is not understood.
    """
    front = re.match(r"# ---\n.*?\n# ---\n", text, flags=re.DOTALL)
    headers = list(re.finditer(r"^# %%(?: \[(markdown)\])?(.*)\n", text, flags=re.MULTILINE))
    if text[front.end() if front else 0 : headers[0].start()].strip():
        raise ValueError("something stands before the first cell")
    cells = []
    for header, end in zip(headers, [*(header.start() for header in headers[1:]), len(text)], strict=True):
        kind = header.group(1) or "code"
        body = text[header.end() : end]
        blank = len(body) - len(body.lstrip("\n"))
        hidden = r"^# ?" if kind == "markdown" else r"^# (?=%[a-z])"
        source = re.sub(hidden, "", body.strip("\n"), flags=re.MULTILINE)
        line = text.count("\n", 0, header.end()) + 1 + blank
        cells.append(Cell(kind, source, metadata_of(header.group(2)), line))
    return cells


def metadata_of(header: str) -> dict[str, Any]:
    """What stands behind `# %%`: `tags=["check"] quick={"STEPS": 20}`, the values in JSON.

    Raises:
        ValueError: it is something else.
    """
    metadata: dict[str, Any] = {}
    rest = header.strip()
    while rest:
        name, _, rest = rest.partition("=")
        try:
            metadata[name.strip()], end = json.JSONDecoder().raw_decode(rest)
        except json.JSONDecodeError as error:
            raise ValueError(f"the header of a cell says '{header.strip()}', expected name=JSON: {error}") from None
        rest = rest[end:].strip()
    return metadata


# ---------------------------------------------------------------------- quick runs


def run_quick(script: Path) -> subprocess.CompletedProcess[str]:
    """Run a script with its quick values, in a process and for a folder of its own, and throw everything away.

    Returns:
        the finished process: `returncode` 0 if all cells ran, otherwise the error in `stderr`.
    """
    command = [sys.executable, "-W", "ignore", "-c", "import sys, execute; execute.run_cells(*sys.argv[1:])"]
    with tempfile.TemporaryDirectory() as runs:
        return subprocess.run(  # noqa: S603 - our own script
            [*command, str(script), runs],
            cwd=HERE,
            env={**os.environ, "MPLBACKEND": "Agg"},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )


def run_cells(script: str, runs: str) -> None:
    """Run a script's code cells in this process, as plain Python: quick values, `check` cells left out.

    What a cell shows is drawn and then forgotten, so that a figure that cannot be drawn fails here too.

    Args:
        script: its path; errors name its lines.
        runs: what the notebook writes goes there, see `RUNS` in its parameters.
    """
    stand_in_for_ipython()
    names = vars(sys.modules["__main__"])  # where classes made here are looked for, as in a notebook
    for cell in cells_of_script(Path(script).read_text(encoding="utf-8")):
        if cell.kind != "code" or cell.has_tag("check"):
            continue
        plain = re.sub(r"^%", "# %", cell.source, flags=re.MULTILINE)  # magics mean nothing to Python
        tree = ast.parse("\n" * (cell.line - 1) + plain, script)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, script, "exec"), names)  # noqa: S102 - our own script
        if isinstance(last, ast.Expr):
            show(eval(compile(ast.Expression(last.value), script, "eval"), names))  # noqa: S307
        if cell.has_tag("parameters"):
            names.update(cell.metadata["quick"], RUNS=Path(runs))


def show(*values: Any, **settings: Any) -> SimpleNamespace:
    """Make of values what a notebook would show, and forget it; in the place of IPython's `display`."""
    for value in values:
        if hasattr(value, "savefig"):
            value.savefig(io.BytesIO(), format="png")
        elif hasattr(value, "_repr_html_"):
            value._repr_html_()
        else:
            repr(value)
    return SimpleNamespace(update=show)


def stand_in_for_ipython() -> None:
    """Put something in IPython's place, whether it is installed or not: there is nobody to show things to."""
    package, shown = ModuleType("IPython"), ModuleType("IPython.display")
    vars(package).update(display=shown, version_info=(9, 0, 0), get_ipython=lambda: None)  # matplotlib asks for both
    nothing = dict.fromkeys(("HTML", "Image", "Markdown", "SVG", "Video", "clear_output"), lambda *_, **__: None)
    vars(shown).update(nothing, display=show)
    sys.modules.update({"IPython": package, "IPython.display": shown})


def quick(script: Path) -> str:
    """See whether a script runs, and return what to say.

    Raises:
        SystemExit: it does not.
    """
    ran = run_quick(script)
    if ran.returncode:
        sys.exit(f"{script.name} does not run with its quick values:\n{ran.stderr}")
    return "runs"


# ---------------------------------------------------------------------- notebooks


def read(script: Path) -> "nbformat.NotebookNode":
    """The notebook of a script, without outputs."""
    import jupytext

    notebook = jupytext.read(script)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("lines_to_next_cell", None)  # jupytext's own note of blank lines in the script
    return notebook


def copy_prose(script: Path) -> str:
    """Write the script's prose into the notebook that was executed before, and return what to say.

    Raises:
        SystemExit: its code has changed too.
    """
    import nbformat

    target = script.with_suffix(".ipynb")
    new, old = read(script), nbformat.read(target, as_version=4)
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
    """Write the executed notebook of one script and return what to say.

    Raises:
        SystemExit: its outputs are not fit to be published.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = read(script)
    notebook.metadata["kernelspec"] = {"name": "python3", "language": "python", "display_name": "Python 3"}
    NotebookClient(
        notebook,
        timeout=PATIENCE,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(HERE)}},
        extra_arguments=["--IPKernelApp.log_level=40"],
    ).execute()
    notebook.metadata["language_info"] = {"name": "python"}
    text = nbformat.writes(notebook)
    found = ABSOLUTE.search(text)
    if found:
        context = text[found.start() - 80 : found.end() + 80]
        sys.exit(f"{script.name}: an output names a folder of this machine: {context}")
    if len(text) > LIMIT_MB * 1e6:
        sys.exit(f"{script.name}: the notebook has {len(text) / 1e6:.1f} MB, expected less than {LIMIT_MB:g}")
    return write(script.with_suffix(".ipynb"), text)


def write(target: Path, text: str) -> str:
    """Write a file whole or not at all, and return its size in words."""
    part = target.with_suffix(".part")
    part.write_text(text + "\n", encoding="utf-8")
    os.replace(part, target)
    return f"{target.stat().st_size / 1e6:.2f} MB"


def main() -> None:
    """Do with the chosen scripts, or all, what the command line says."""
    parser = argparse.ArgumentParser(description="Make each notebook from its script, run from top to bottom.")
    parser.add_argument("names", nargs="*", help="how their names begin, for example 00 02; without it all")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--quick", action="store_true", help="only see whether they run, with few steps; write nothing")
    way.add_argument("--prose", action="store_true", help="copy changed prose only, keep the outputs")
    arguments = parser.parse_args()
    scripts = [
        script
        for script in sorted(HERE.glob("[0-9][0-9]_*.py"))
        if not arguments.names or script.name.startswith(tuple(arguments.names))
    ]
    if not scripts:
        sys.exit(f"no notebook begins with {' or '.join(arguments.names)}")
    work = quick if arguments.quick else copy_prose if arguments.prose else execute
    for script in scripts:
        started = time.monotonic()
        said = work(script)
        print(f"{script.stem}: {time.monotonic() - started:.0f} s, {said}", flush=True)


if __name__ == "__main__":
    main()
