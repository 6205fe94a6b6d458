"""Benchmarks are run seldom: at least what they import must be there."""

import runpy
import sys
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_every_benchmark_can_be_imported(path, monkeypatch):
    """Its story: a class had a new name, and one of them had not run since."""
    monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
    assert runpy.run_path(str(path), run_name="imported")["__doc__"]


def test_the_benchmark_for_a_gpu_runs_on_a_processor(monkeypatch, tmp_path, capsys):
    """It waits for a machine that has one: its code must run until then."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    words = ["--device", "cpu", "--steps", "2", "--rows", "600", "--variants", "host", "device", "--stages", "clone"]
    monkeypatch.setattr(sys, "argv", ["accelerator.py", *words, "--out", str(tmp_path)])
    runpy.run_path(str(ROOT / "benchmarks" / "accelerator.py"), run_name="__main__")
    table = pd.read_parquet(tmp_path / "accelerator.parquet")
    assert len(table) == 3
    assert (table["steps_per_s"] > 0).all()
    assert (tmp_path / "accelerator.md").read_text().strip() == capsys.readouterr().out.strip()


def test_discrete_and_continuous_skills_are_compared(monkeypatch, tmp_path, dds):
    """It had not run since trainings are built before they are executed."""
    from benchmarks import compare_bottlenecks

    words = ["pointmaze-large-diverse", "--steps", "3000", "--out", tmp_path, "--workers", "1"]
    assert dds("data", "collect", *words).status == 0
    asked = ["--data", f"local:{tmp_path}/pointmaze-large-diverse-v0", "--skills", "2", "--seeds", "1", "--steps", "2"]
    monkeypatch.setattr(sys, "argv", ["compare_bottlenecks.py", *asked, "--out", str(tmp_path / "out")])
    monkeypatch.setattr(compare_bottlenecks, "STATES", 4)
    compare_bottlenecks.main()
    models = pd.read_csv(tmp_path / "out" / "models-2.csv")
    assert models["seed"].tolist() == [0, 0]
    assert (models["chance"] >= 0.5).all()
    assert (tmp_path / "out" / "comparison-2.png").is_file()
