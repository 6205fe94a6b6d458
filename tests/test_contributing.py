"""CONTRIBUTING.md, CHANGELOG.md and CITATION.cff: commands run, paths exist, versions agree."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from dds_lightning._version import __version__

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```bash\n(.*?)^```", GUIDE, flags=re.MULTILINE | re.DOTALL)
LINES = [line for block in BLOCKS for line in block.splitlines()]
NAMED = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", GUIDE, flags=re.MULTILINE | re.DOTALL))
PLACES = ("dds_lightning/", "datamodules/", "tests/", "notebooks/", "benchmarks/", ".ci/")


@pytest.mark.parametrize("line", LINES)
def test_a_command_that_is_shown_runs(line):
    program, *arguments = shlex.split(line)
    assert program in ("python", "make")
    ran = subprocess.run(
        [sys.executable if program == "python" else program, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout


def test_every_path_that_is_named_exists():
    paths = [name for name in NAMED if name.startswith(PLACES) or re.fullmatch(r"[\w-]+\.(md|toml|txt|cff)", name)]
    assert len(paths) > 30
    assert [path for path in paths if "NN_" not in path and not (ROOT / path).exists()] == []


def test_every_make_target_that_is_named_exists():
    targets = {name.split()[1] for name in NAMED if name.startswith("make ")}
    rules = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE))
    assert targets <= rules


def test_every_room_has_its_line():
    faces = [*ROOT.glob("dds_lightning/*/__init__.py"), *ROOT.glob("datamodules/*/__init__.py")]
    rooms = {face.parent.relative_to(ROOT).as_posix() for face in faces} - {"dds_lightning/examples"}
    assert {room for room in rooms if f"`{room}/`" not in GUIDE} == set()


def test_the_citation_names_the_version_and_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == __version__
    assert [author["family-names"] for author in citation["preferred-citation"]["authors"]] == [
        *("Qiao", "Cheng", "Dai", "Tian", "Lv")
    ]


def test_the_changelog_has_the_version():
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert __version__ in headings
