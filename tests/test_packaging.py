"""The project as pip sees it: metadata, constraints, and the wheel."""

import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

import datamodules
import dds_lightning
from dds_lightning.errors import UserError

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def _pins(file="constraints.txt"):
    lines = (ROOT / file).read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def _sources():
    return [path for folder in ("dds_lightning", "datamodules") for path in (ROOT / folder).rglob("*.py")]


def _sources():
    return [path for folder in ("dds_lightning", "datamodules") for path in (ROOT / folder).rglob("*.py")]


def _requirements():
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    return [re.match(r"[\w-]+", line)[0].lower() for group in groups for line in group]


def test_every_requirement_has_an_exact_version():
    missing = [name for name in _requirements() if name not in _pins()]
    assert missing == []
    assert all(re.fullmatch(r"\d[\w.!+]*", version) for version in _pins().values())


def test_every_exact_version_is_inside_its_range():
    from packaging.requirements import Requirement

    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    for line in (line for group in groups for line in group):
        requirement = Requirement(line)
        assert requirement.specifier.contains(_pins()[requirement.name.lower()]), line


def test_the_oldest_versions_are_the_lower_bounds():
    from packaging.requirements import Requirement
    from packaging.version import Version

    pins = {name.replace("_", "-"): Version(version) for name, version in _pins("constraints-oldest.txt").items()}
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    bounds = {}
    for requirement in (Requirement(line) for group in groups for line in group):
        (bound,) = [part.version for part in requirement.specifier if part.operator == ">="]
        bounds[requirement.name.lower().replace("_", "-")] = Version(bound)
    differing = {name: (bound, pins[name]) for name, bound in bounds.items() if pins[name] != bound}
    assert set(differing) == {"torch"}, f"`make pin-oldest` after changing a lower bound: {differing}"


def test_every_module_imports():
    for package in (dds_lightning, datamodules):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.endswith("__main__") or ".examples." in module.name:
                continue  # a script, which runs when it is imported
            try:
                importlib.import_module(module.name)
            except (ModuleNotFoundError, UserError) as error:
                if "stable-baselines3" not in str(error).replace("_", "-"):  # of the extra `behaviours`
                    raise


def test_nobody_is_told_to_install_this_project_from_an_index():
    """Nobody owns its name there: a stranger could put anything under it. The checkout is named instead."""
    texts = [*ROOT.glob("*.md"), *(ROOT / "notebooks").glob("*.py"), *(ROOT / "checkpoints").rglob("*.md"), *_sources()]
    told = [line for path in texts for line in path.read_text(encoding="utf-8").splitlines() if "pip install" in line]
    assert len(told) >= 3
    alone = "--no-deps -c constraints.txt d3rlpy"  # somebody else's, and no extra can bring it
    assert [line for line in told if not re.search(rf"pip install (-e '?\.|{alone})", line)] == []


def test_every_extra_that_a_message_names_exists():
    source = "".join(path.read_text(encoding="utf-8") for path in _sources())
    named = set(re.findall(r'lacks_extra\(.*, "(\w+)"[,)]', source))
    assert {"hub", "export", "behaviours", "baselines"} <= named <= set(PROJECT["optional-dependencies"])


def test_versions_known_to_be_bad_are_excluded():
    lines = {re.match(r"[\w-]+", line)[0]: line for line in PROJECT["dependencies"]}
    assert lines["lightning"] == "lightning>=2.6.6,<2.7"
    assert lines["mujoco"] == "mujoco>=3.3,<3.5"
    assert lines["torch"] == "torch>=2.6"


def test_the_public_names_import():
    for name in dds_lightning.__all__:
        assert getattr(dds_lightning, name) is not None
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = dds_lightning.no_such_name


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mypy") is None, reason="mypy is in the extra: dev")
def test_a_strict_type_checker_sees_the_types_of_the_public_names(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from datamodules import Trajectories\n"
        "from dds_lightning import DDSAgent, get_task\n"
        "reveal_type(DDSAgent.load('x'))\n"
        "reveal_type(get_task('x').observation_dim)\n"
        "reveal_type(Trajectories.from_episodes)\n"
    )
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--ignore-missing-imports"]
    environment = {"MYPYPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    checked = subprocess.run(
        [*command, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert checked.returncode == 0, checked.stdout
    revealed = re.findall(r'Revealed type is "(.*)"', checked.stdout)
    assert revealed[0].endswith("dds_lightning.agent.DDSAgent")
    assert revealed[1].endswith("int")
    assert "Any" not in revealed[2].split("->")[1], "the result of from_episodes has a type"


@pytest.mark.skipif(find_spec("hatchling") is None, reason="hatchling (extra: dev) builds the wheel")
def test_the_wheel_holds_both_packages_and_the_configurations_and_runs(tmp_path):
    command = [sys.executable, "-m", "pip", "wheel", str(ROOT), "--no-deps", "--no-build-isolation"]
    made = subprocess.run([*command, "-w", str(tmp_path)], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "site")
    configs = (ROOT / "dds_lightning" / "configs").rglob("*.yaml")
    expected = {str(path.relative_to(ROOT)) for path in configs}
    expected |= {"dds_lightning/cli/__init__.py", "datamodules/segments.py"}
    expected |= {"dds_lightning/py.typed", "datamodules/py.typed"}
    templates = [path for package in ("dds_lightning", "datamodules") for path in (ROOT / package).rglob("*.jinja")]
    assert len(templates) >= 3
    expected |= {"dds_lightning/interpret/atlas.css", *(str(path.relative_to(ROOT)) for path in templates)}
    expected.add("datamodules/behaviours/shipped_policies/ant/d4rl.safetensors")
    assert expected <= names
    strangers = {name.split("/")[0] for name in names} - {"dds_lightning", "datamodules"}
    assert all(name.endswith(".dist-info") for name in strangers)
    code = "import dds_lightning; print(dds_lightning.__file__); from dds_lightning.cli import main; main(['tasks'])"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path / "site"), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert str(tmp_path / "site") in ran.stdout
    assert "pointmaze-large-diverse" in ran.stdout
