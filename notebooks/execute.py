"""Make each notebook from its script: convert, run from top to bottom, write the .ipynb beside it.

    python notebooks/execute.py            # all
    python notebooks/execute.py 00 02      # those whose names begin so
    python notebooks/execute.py --prose    # copy changed prose only, keep the outputs

Scripts (`NN_name.py`, py:percent) are the source; nobody edits an .ipynb. The same script gives the same cells with
the same ids, so that a diff shows what changed in the outputs and nothing else. A notebook that fails, or whose
outputs name a folder of this machine, leaves the old file as it was.
"""

import os
import re
import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
ABSOLUTE = re.compile(r"(?<![\w.:/<])/(?:home|root|tmp|usr|opt|work|var|private|Users|mnt|data)/[\w.]")
LIMIT_MB = 2.0


def read(script: Path) -> nbformat.NotebookNode:
    """The notebook of a script, without outputs."""
    notebook = jupytext.read(script)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    return notebook


def copy_prose(script: Path) -> Path:
    """Write the script's prose into the notebook that was executed before, and return its path.

    Raises:
        SystemExit: its code has changed too.
    """
    target = script.with_suffix(".ipynb")
    new, old = read(script), nbformat.read(target, as_version=4)
    code = [[cell.source if cell.cell_type == "code" else None for cell in notebook.cells] for notebook in (new, old)]
    if code[0] != code[1]:
        sys.exit(f"{script.name}: the code has changed too, so execute it")
    for ours, theirs in zip(new.cells, old.cells, strict=True):
        theirs.source = ours.source
    return write(target, nbformat.writes(old))


def execute(script: Path) -> Path:
    """Write the executed notebook of one script and return its path.

    Raises:
        SystemExit: its outputs are not fit to be published.
    """
    notebook = read(script)
    notebook.metadata["kernelspec"] = {"name": "python3", "language": "python", "display_name": "Python 3"}
    NotebookClient(
        notebook,
        timeout=600,
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


def write(target: Path, text: str) -> Path:
    """Write a file whole or not at all."""
    part = target.with_suffix(".part")
    part.write_text(text + "\n", encoding="utf-8")
    os.replace(part, target)
    return target


def main(chosen: list[str]) -> None:
    """Execute the chosen scripts, or all."""
    work = copy_prose if "--prose" in chosen else execute
    chosen = [word for word in chosen if word != "--prose"]
    scripts = [
        script
        for script in sorted(HERE.glob("[0-9][0-9]_*.py"))
        if not chosen or any(script.name.startswith(prefix) for prefix in chosen)
    ]
    if not scripts:
        sys.exit(f"no notebook begins with {' or '.join(chosen)}")
    for script in scripts:
        started = time.monotonic()
        target = work(script)
        seconds, size = time.monotonic() - started, target.stat().st_size / 1e6
        print(f"{target.name}: {seconds:.0f} s, {size:.2f} MB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
