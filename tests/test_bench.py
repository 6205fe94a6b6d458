"""The benchmark of all trainings: what it counts, and the peer that is written here."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    """The script, whose neighbours lie beside it."""
    sys.path.insert(0, str(HERE))
    try:
        spec = importlib.util.spec_from_file_location("bench", HERE / "bench.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(HERE))


def test_ratios_are_against_the_limit_the_papers_loop_and_the_fastest_peer(bench, monkeypatch):
    def contender(stage, name, seconds, flops=0, ours=False):
        return bench.Contender(stage, name, "32-true", lambda steps: seconds * steps, flops, ours)

    everyone = [
        contender("policy", "module alone", 0.01, flops=5_000_000, ours=True),
        contender("policy, smaller", "module alone", 0.005, flops=5_000_000, ours=True),
        contender("policy", "a peer", 0.02),
        contender("policy", "a slower peer", 0.04),
        contender("policy", "the paper's configuration, plain loop", 0.1),
    ]
    monkeypatch.setattr(bench, "contenders", lambda: iter(everyone))
    monkeypatch.setattr(bench, "product_speed", lambda kind: 1e9)
    table = bench.measure(rounds=1, budget=0.1)
    assert table["steps_per_s"].tolist() == pytest.approx([100, 200, 50, 25, 10])
    assert table["of_limit"].tolist()[:2] == pytest.approx([0.5, 1.0])
    assert table["against_peer"].tolist()[:2] == pytest.approx([2, 4])
    assert table["against_paper"].tolist()[:2] == pytest.approx([10, 20])
    assert table[["of_limit", "against_peer", "against_paper"]].iloc[2:].isna().all(axis=None)


def test_a_peer_that_is_missing_is_told_and_left_out(bench, monkeypatch, capsys):
    def missing(batch, skills):
        raise ImportError("No module named 'd3rlpy'")

    chosen = {"clone": bench.ours()["clone"]}
    monkeypatch.setattr(bench, "PEERS", {"clone": {"d3rlpy BC": missing}})
    monkeypatch.setattr(bench, "ours", lambda: chosen)
    monkeypatch.setattr(bench, "skill_model", lambda **_: torch.nn.Linear(1, 1))
    found = [(one.stage, one.name) for one in bench.contenders()]
    assert found[:2] == [("clone", "module alone"), ("clone", "through the Trainer")]
    assert not any(name == "d3rlpy BC" for _, name in found)
    assert "d3rlpy BC is left out: No module named 'd3rlpy'" in capsys.readouterr().err


def test_the_single_file_peer_learns_what_a_batch_pays(bench):
    torch.manual_seed(0)
    batch = bench.transitions(32)
    update = bench.peers.single_file_iql({**batch, "dones": torch.ones(32)}, bench.SKILLS)
    networks = dict(zip(update.__code__.co_freevars, (cell.cell_contents for cell in update.__closure__), strict=True))
    observations, codes = batch["observations"], batch["codes"][:, None]

    def error():
        q = networks["critics"][0](observations).gather(1, codes).squeeze(-1)
        return float((q - batch["rewards"]).square().mean().detach())

    before = error()
    for _ in range(200):
        update()
    assert error() < 0.2 * before


def test_a_finished_run_gives_its_seconds_and_the_score_it_is_about(bench, tmp_path):
    table = [{"contestant": "a", "score": 1.0}, {"contestant": "b", "score": 97.5}]
    for name, marker in {
        "skill": {"seconds": 60.0},
        "report": {"seconds": 2.5, "facts": {"task": "maze", "main": "b", "table": table}},
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "stage.json").write_text(json.dumps(marker))
    (row,) = bench.parts.finished_runs([tmp_path]).to_dict("records")
    assert (row["task"], row["score"], row["seconds"], row["skill"]) == ("maze", 97.5, 62.5, 60.0)
