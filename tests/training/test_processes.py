"""More than one device: who starts whom, one report, and the same skills everywhere."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.accelerators import CPUAccelerator

from dds_lightning.console import interrupts
from dds_lightning.console.reports import Report
from dds_lightning.errors import ToldAlreadyError, UserError
from dds_lightning.pipeline.settings import RunSettings, Trainings
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task
from dds_lightning.training import alone
from tests.fits import QUIET, SKILL, TASK, of_data, skill_of

ROOT = Path(__file__).parents[2]
SMALL = {"hidden_dim": 16, "skill_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1}
TWO = ["--trainer.devices=2", "--trainer.accelerator=cpu"]


def trainings(**stages):
    settings = RunSettings.with_preset(TASK, Path("run"), stages={name: tuple(words) for name, words in stages.items()})
    return Trainings(settings, get_task(TASK))


def test_a_run_takes_one_device_where_auto_finds_two(monkeypatch):
    """Its story: Lightning started `dds run` once more as the second process, which found the folder locked."""
    usual = trainings().cache_key_settings("skill")
    monkeypatch.setattr(CPUAccelerator, "auto_device_count", staticmethod(lambda: 2))
    made = trainings()
    assert made.settings("skill")["trainer"]["devices"] == 1
    assert "--trainer.devices=1" in made.command("skill", "local:x", None, None).split()
    assert made.cache_key_settings("skill") == usual  # what was done before stays done
    assert usual["trainer"]["devices"] == "auto"


def test_more_devices_are_taken_when_they_are_asked_for_in_processes_of_their_own(monkeypatch):
    started = []
    monkeypatch.setattr("dds_lightning.pipeline.settings.run_alone", lambda words: started.append(words) or Report({}))
    made = trainings(skill=TWO)
    made.fit("skill", "local:x")
    assert started[0][:2] == ["skill", "fit"]
    assert "--trainer.devices=2" in started[0]
    assert made.cache_key_settings("skill")["trainer"]["devices"] == "2"


class Ended(SimpleNamespace):
    """A process that has ended."""

    def communicate(self):
        return self.answer, None


@pytest.mark.parametrize(
    ("status", "error"),
    [(2, ToldAlreadyError), (143, interrupts.Interrupted), (-15, interrupts.Interrupted), (1, RuntimeError)],
)
def test_how_a_training_of_its_own_ended_is_passed_on(monkeypatch, status, error):
    monkeypatch.setattr(alone.subprocess, "Popen", lambda *a, **k: Ended(returncode=status, answer=""))
    with pytest.raises(error):
        alone.run_alone(["skill", "fit"])


def test_a_mistake_that_another_process_has_told_is_not_told_twice(dds, monkeypatch):
    def fit(self, *_):
        raise ToldAlreadyError("told")

    monkeypatch.setattr(Trainings, "fit", fit)
    answer = dds("run", TASK, "--data_steps=300", "--workers=1", "--until=skill")
    assert answer.status == 2
    assert "dds: error" not in answer.err


def signalled(*signals):
    """Send signals to this process while they are deferred; what was pending after the last of them."""
    with interrupts.caught(), interrupts.deferred():
        for signum in signals:
            os.kill(os.getpid(), signum)
            time.sleep(0.01)
        noted = interrupts.pending()
        interrupts._Mark.signum = None
        return noted


def test_signals_of_a_terminal_and_of_a_parent_are_one_request():
    assert signalled(signal.SIGTERM, signal.SIGINT) == signal.SIGTERM


def test_a_later_signal_is_not_deferred(monkeypatch):
    monkeypatch.setattr(interrupts, "TOGETHER", 0.0)
    with pytest.raises(interrupts.Interrupted):
        signalled(signal.SIGTERM, signal.SIGTERM)


def test_every_process_has_the_skills_of_the_first():
    """Its story: each started and revived its codes from its own share of the data, and they drifted apart."""
    first, second = (SkillModule(4, 2, 5, num_skills=4, **SMALL) for _ in range(2))
    with torch.no_grad():
        first.bottleneck.vectors.fill_(3.0)
    sent = (first.bottleneck.state_dict(), [torch.tensor([1])])
    strategy = SimpleNamespace(broadcast=lambda mine: sent)
    second._trainer = SimpleNamespace(world_size=2, strategy=strategy)
    assert second.agree(second.bottleneck, [torch.tensor([0])])[0].tolist() == [1]
    assert torch.equal(second.bottleneck.vectors, first.bottleneck.vectors)


def test_usage_counts_the_codes_of_all_processes(monkeypatch):
    codebook = SkillModule(4, 2, 5, num_skills=4, **SMALL).bottleneck
    other = torch.tensor([0.0, 0.0, 0.0, 2.0])
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda values: values.add_(other))
    before = codebook.usage.clone()
    codebook._observe(torch.zeros(2, 8), torch.tensor([0, 1]))
    assert torch.allclose(codebook.usage, before.lerp(torch.tensor([0.25, 0.25, 0.0, 0.5]), 0.02))


def test_the_processes_of_a_training_have_one_precision(monkeypatch):
    from jsonargparse import Namespace

    from dds_lightning.nn.precision import Choice
    from dds_lightning.training import precision

    def settled(choice):
        monkeypatch.setattr(precision, "fastest_precision", lambda gpu: Choice(choice, 2.0))
        return precision.settle_precision(
            Namespace(precision="auto", trainer=Namespace(precision=None, accelerator="cpu"))
        )

    monkeypatch.setenv("DDS_PRECISION", "")
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    assert settled("bf16-mixed") == "bf16-mixed"
    assert settled("32-true") == "32-true"  # another training of the same process measures anew
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert settled("bf16-mixed") == "32-true"


LEAVE = """
import atexit, sys, torch
from dds_lightning.__main__ import leave
class Kept:
    def __del__(self):
        sys.__stdout__.write("taken down")
kept = Kept()
if sys.argv[1] == "several":
    torch.distributed.init_process_group("gloo", rank=0, world_size=1, store=torch.distributed.HashStore())
atexit.register(print, "sent")
print("told")
leave(3)
"""


@pytest.mark.parametrize(("processes", "said"), [("one", "told sent taken down"), ("several", "told sent")])
def test_one_of_several_processes_leaves_before_python_is_taken_down(processes, said):
    """Its story: a thread of Gloo released a tensor too late, and a finished training ended with status -6."""
    ran = subprocess.run([sys.executable, "-c", LEAVE, processes], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout.split()) == (3, said.split())


def dds(*words):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "dds_lightning", *words]
    ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)  # one document, and nothing else


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["ddp", "ddp_spawn"])
def test_two_processes_train_and_report_once(strategy, tmp_path_factory):
    data = of_data(tmp_path_factory.mktemp("data"))
    words = [*data, *QUIET, *SKILL, "--trainer.max_steps=30", "--model.restart_every=10", "--checkpoint.dirpath=out"]
    words += ["--model.freeze_codes_after=20"]  # the processes ended here: they waited for gradients that never came
    made = dds("skill", "fit", *words, *TWO, f"--trainer.strategy={strategy}", "--json")
    assert (made["steps"], made["checkpoint"]) == (30, "out/last.ckpt")
    assert {"train/loss", "val/loss", "val/codes_used"} <= set(made["metrics"])
    saved = torch.load("out/last.ckpt", weights_only=True)
    assert saved["global_step"] == 30
    assert len(saved["rng"]) == 2


RANKS = ["--trainer.callbacks+=tests.training.ranks.KeepRank", *TWO, "--trainer.strategy=ddp", "--trainer.max_steps=12"]


def refuse_differences():
    """Refuse two processes that differ in any weight or buffer, at the start or at the end; return the end."""
    ranks = [torch.load(f"rank-{rank}.pt", weights_only=True) for rank in (0, 1)]
    for first, second in zip(*ranks, strict=True):
        assert first.keys() == second.keys()
        assert [name for name in first if not torch.equal(first[name], second[name])] == []
    return ranks[0]


@pytest.mark.slow
@pytest.mark.parametrize("ema", ["null", "0.9"])
def test_two_processes_have_one_codebook_from_its_start_through_every_restart(ema, tmp_path_factory):
    """Start by k-means, moving averages, usage and revived codes, each from what both processes see."""
    data = of_data(tmp_path_factory.mktemp("data"))
    words = [*data, *QUIET, *SKILL, *RANKS, "--checkpoint.dirpath=out", f"--model.codebook_ema={ema}"]
    words += ["--model.restart_every=2", "--model.restart_threshold=1.5", "--model.codebook_init=kmeans"]
    dds("skill", "fit", *words, "--json")
    start, end = refuse_differences()
    assert bool(start["bottleneck.initted"])
    moved = (start["bottleneck.vectors"] != end["bottleneck.vectors"]).any(dim=1)
    assert bool(moved.all())
    assert torch.isfinite(end["bottleneck.vectors"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("extraction", ["joint", "after"])
def test_two_processes_have_one_policy(extraction, tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    data = of_data(root)
    skill = skill_of(data, root / "skill", 5)
    words = [*data, *QUIET, *RANKS, f"--data.skill={skill}"]
    words += ["--model.hidden_dims=[16]", f"--model.extraction={extraction}", "--model.critic_steps=6"]
    words += ["--model.alpha_unit=spread", "--checkpoint.dirpath=out"]
    dds("policy", "fit", *words, "--json")
    start, end = refuse_differences()
    learnt = [name for name in start if name.startswith(("actor.", "critic.", "value.", "target_critic."))]
    assert all(not torch.equal(start[name], end[name]) for name in learnt)
    assert float(end["advantage_spread"]) != 1.0


@pytest.mark.slow
def test_a_run_trains_skills_and_a_policy_in_two_processes_each():
    small = ["--skill.model.hidden_dim=16", "--skill.model.num_skills=2", "--policy.model.hidden_dims=[16]"]
    small += ["--policy.model.extraction=after", "--policy.model.critic_steps=5", "--evaluate_every=10"]
    for stage in ("skill", "policy"):
        small += [f"--{stage}.{word.removeprefix('--')}" for word in [*TWO, "--trainer.strategy=ddp"]]
        small += [f"--{stage}.{word}" for word in ("trainer.max_steps=10", "data.batch_size=32")]
    made = dds("run", TASK, "--data_steps=2000", "--workers=1", "--until=policy", *small, "--json")
    assert Path(made["outputs"]["policy"]["checkpoint"]).is_file()


def test_a_wrong_strategy_of_a_later_stage_is_found_at_once():
    with pytest.raises(UserError, match=r"policy: .*dpp"):
        trainings(policy=["--trainer.strategy=dpp"])
