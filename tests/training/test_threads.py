"""The number of threads of a training: measured on the training itself, shown, overruled, kept in its checkpoints."""

import contextlib
import itertools
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator

from dds_lightning.policy import PolicyModule
from dds_lightning.training import fit as fitting
from dds_lightning.training import threads
from dds_lightning.training.stage_cli import parsed
from dds_lightning.training.stages import STAGES
from tests.fits import QUIET, SKILL, TASK, of_data


@pytest.mark.parametrize(
    ("seconds", "chosen"),
    [
        ({1: 1.0, 2: 1.3}, 1),  # a policy: the second thread costs
        ({1: 1.0, 2: 0.9}, 1),  # it brings too little
        ({1: 1.0, 2: 0.7}, 2),
        ({1: 1.0, 2: 0.9, 4: 0.5}, 4),
        ({1: 1.0, 2: 0.5, 4: 0.45, 8: 3.0}, 2),
        ({1: 1.0, 2: 12.0}, 1),  # another program has the second core
    ],
)
def test_a_thread_that_brings_little_is_not_used(seconds, chosen):
    assert threads.worthwhile(seconds) == chosen


def test_every_number_of_threads_is_measured_in_turn_and_the_old_one_comes_back(monkeypatch):
    clock = itertools.count()
    monkeypatch.setattr(threads.time, "perf_counter", lambda: 0.01 * next(clock))
    seen, before = [], torch.get_num_threads()
    assert set(threads.times(lambda: seen.append(torch.get_num_threads()), [1, 2])) == {1, 2}
    assert seen[:4] == [1, 2, 1, 2]
    assert len(seen) <= 2 * threads.MOST
    assert torch.get_num_threads() == before


def test_a_number_of_threads_that_waits_for_a_busy_core_is_tried_once(monkeypatch):
    clock = [0.0]

    def work():
        clock[0] += {1: 0.01, 2: 5.0}[torch.get_num_threads()]

    monkeypatch.setattr(threads.time, "perf_counter", lambda: clock[0])
    assert threads.times(work, [1, 2]) == {1: pytest.approx(0.01), 2: pytest.approx(5.0)}
    assert clock[0] < 6


class Data:
    """A data module of one batch."""

    def prepare_data(self):
        torch.rand(3)  # someone else's data may draw

    def setup(self, stage):
        assert stage == "fit"

    def train_dataloader(self):
        rows = {name: torch.zeros(8) for name in ("rewards", "discounts", "dones")}
        observations = {name: torch.zeros(8, 3) for name in ("observations", "next_observations")}
        return [{**rows, **observations, "codes": torch.zeros(8, dtype=torch.int64)}]


def trainer(**settings):
    plugin = SimpleNamespace(forward_context=contextlib.nullcontext)
    usual = {"accelerator": CPUAccelerator(), "world_size": 1, "precision_plugin": plugin, "callbacks": []}
    return SimpleNamespace(**{**usual, **settings})


def test_the_measurement_changes_neither_the_module_nor_the_random_streams(monkeypatch, capsys):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(threads, "times", lambda work, counts: work() or {1: 0.5, 2: 1.0})
    module = PolicyModule(3, 4, hidden_dims=[8])
    state, weights = torch.get_rng_state(), module.fingerprint()
    assert threads.settle_threads(trainer(), module, Data()) == 1
    assert torch.equal(torch.get_rng_state(), state)
    assert module.fingerprint() == weights
    assert all(parameter.grad is None for parameter in module.parameters())
    assert "threads: 1 of 2 (2 would be 0.5 times as fast)" in capsys.readouterr().err


@pytest.mark.parametrize("settings", [{"accelerator": None}, {"world_size": 2}])
def test_nothing_is_measured_where_threads_do_not_decide(monkeypatch, settings):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert threads.settle_threads(trainer(**settings), PolicyModule(3, 4, hidden_dims=[8]), Data()) is None


def test_a_number_that_is_given_or_the_stages_own_is_not_measured_and_every_checkpoint_keeps_it(tmp_path_factory, dds):
    data = of_data(tmp_path_factory.mktemp("data"))
    words = [*data, *QUIET, *SKILL, "--trainer.max_steps=2", "--checkpoint.dirpath=out"]
    answer = dds("skill", "fit", *words, "--threads=1")
    assert answer.status == 0, answer.err
    assert "threads:" not in answer.err
    assert torch.load("out/last.ckpt", weights_only=True)["settings"]["threads"] == 1
    for given, expected in ((), 1), (("--threads=2",), 2):
        cli = parsed("skill", ["fit", *words, *given])
        cli.resume("out/last.ckpt")
        assert cli.settings.threads == expected


@pytest.mark.parametrize("count", [0, -1])
def test_no_thread_at_all_is_refused(dds, count):
    answer = dds("skill", "fit", f"--data.task={TASK}", f"--threads={count}")
    assert answer.status == 2
    assert f"--threads is {count}, expected at least 1" in answer.err


def test_stages_of_small_networks_have_a_number_of_their_own():
    assert {name: stage.threads for name, stage in STAGES.items()} == {
        **dict.fromkeys(STAGES, 1),
        **dict.fromkeys(("skill", "policy")),
    }
    assert fitting.settle_threads is threads.settle_threads
