"""Mutated files of every kind that is read: refused in one sentence or loaded, and nothing else happens.

Marked `faults`: `make faults` prints the counts that README tells. A few files of each target are always read.
"""

import json
from collections import Counter
from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
import yaml

from datamodules.behaviours.policy import MLPPolicy
from datamodules.relabel import Relabelled, refuse_other_transitions, relabel
from datamodules.relabelling import Relabelling
from datamodules.sources import load_trajectories
from datamodules.trajectories import Trajectories
from dds_lightning.console.terminal import Terminal
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.saving.files import sha256
from dds_lightning.saving.published import CONTENTS, SUMS
from dds_lightning.saving.run_directory import RunDirectory, locked
from dds_lightning.sharing.verify import find_published, verify_published
from dds_lightning.skill import SkillModule
from dds_lightning.study import report, skill_replays
from dds_lightning.study.diagnosis import diagnose
from dds_lightning.study.findings import Findings
from dds_lightning.study.page import page
from dds_lightning.study.subject import find_subject
from dds_lightning.tasks import definition, get_task, known_task
from dds_lightning.tasks.own import load_task
from tests.faults.fuzzing import BAD, Target, fuzz
from tests.interpret.tiny import tiny_agent, tiny_skill
from tests.minari_recordings import write_minari_set
from tests.modules import fit
from tests.recordings import record, write_d4rl_file

TASK = get_task("pointmaze-umaze-play")


@cache
def episodes():
    return record(TASK, 40, episode_steps=20)


@cache
def trajectories():
    return Trajectories.from_episodes("recorded", episodes())


def resealed(folder, changed):
    """What an attacker does: hashes that fit the changed files."""
    agent = changed.parent
    names = (name for name in CONTENTS if (agent / name).is_file())
    (agent / SUMS).write_text("".join(f"{sha256(agent / name)}  {name}\n" for name in names))


# ---------------------------------------------------------------- what is read


def make_published(folder):
    tiny_agent(TASK).save(folder / "agent", task=TASK.name, metrics={"seed": 0, "results": [{"score": 1.0}]})


def read_published(folder):
    find_published([folder])
    verify_published(folder / "agent")


def make_checkpoint(folder):
    torch.manual_seed(0)
    skill = tiny_skill(TASK)
    trainer = fit(skill, segments(), 2)
    trainer.save_checkpoint(folder / "last.ckpt")


def segments():
    from datamodules.segments import SegmentDataModule

    return SegmentDataModule.from_trajectories(trajectories(), horizon=5, batch_size=8, validation_fraction=0.0)


def read_resumed(folder):
    """What `--ckpt_path` does with a checkpoint."""
    from dds_lightning.training.fit import resuming

    with resuming(folder / "last.ckpt"):
        fit(tiny_skill(TASK), segments(), 3, ckpt_path=folder / "last.ckpt")


def read_data(spec):
    return lambda folder: load_trajectories(spec.format(folder), TASK)


def make_relabelled(folder):
    relabel(trajectories(), tiny_skill(TASK)).save(folder / "r.safetensors", {"data": "d"})


def read_relabelled(folder):
    found = Relabelled.load(folder / "r.safetensors", {"data": "d"})
    refuse_other_transitions(found, trajectories(), tiny_skill(TASK), Relabelling(), folder / "r.safetensors")


def make_behaviour(folder):
    rng = np.random.default_rng(0)
    sizes = [(4, 8), (8, 2)]
    weights = tuple(rng.standard_normal(size, dtype=np.float32) for size in sizes)
    biases = tuple(np.zeros(size[1], np.float32) for size in sizes)
    numbers = (np.zeros(4, np.float32), np.ones(4, np.float32), np.zeros(2, np.float32))
    MLPPolicy(weights, biases, *numbers, metadata={"steps": 1}).save(folder / "p.safetensors")


def make_task(folder):
    values = definition(get_task("hopper-medium")) | {"name": "mine", "family": "default"}
    (folder / "mine.yaml").write_text(yaml.safe_dump(values))


def make_run(folder):
    make_published(folder)
    rows, paths = [], {}
    for actor, label in (("AWR policy, sampled", None), ("single skill", "skill"), ("random skills", None)):
        for episode in range(3):
            length = 5 + episode
            name = f"{label} {episode}" if label else actor
            row = {"actor": actor, "label": name, "episode": episode, "seed": 1, "return": 1.0, "score": 50.0}
            row |= {"success": bool(episode % 2), "terminated": False, "length": length, "final_x": 0.0, "final_y": 0.0}
            rows.append({**row, "final_code": episode, "codes": [episode, 0]})
            line = np.tile(np.float32(TASK.start_xy()), (length + 1, 1))
            paths[actor, episode] = RolloutPath(line, np.zeros(length, np.int16))
    (folder / "relabel").mkdir()
    (folder / "relabel" / "codes.csv").write_text(
        "code,segments,share,reward,dx,dy,distance,terminations\n0,9,0.5,-1.0,0.1,0.2,0.3,0\n1,5,0.25,-1.0,0.1,0.2,0.3,0\n"
        "2,5,0.25,-1.0,0.1,0.2,0.3,1\n"
    )
    logs = folder / "skill" / "logs" / "version_0"
    logs.mkdir(parents=True)
    (logs / "metrics.csv").write_text("epoch,step,train/loss,val/codes_used\n0,49,0.5,\n0,99,0.25,3\n")
    replays = {"starts": np.zeros((6, 2), np.float32), "positions": np.zeros((6, 5, 2), np.float32)}
    replays |= {"codes": np.array([0, 1, 2] * 2), "alive": np.ones((6, 4), bool)}
    key = json.dumps({"task": TASK.name, "agent": (folder / "agent" / SUMS).read_text()})
    (folder / "report").mkdir()
    np.savez(folder / "report" / "replays.npz", key=np.array(key), **replays)
    with locked(folder):
        do_steps(folder, RolloutResult(TASK.name, pd.DataFrame(rows), paths))


def do_steps(folder, result=None):
    """Two steps of a run; those that are done are skipped."""
    steps = RunDirectory(folder, Terminal(quiet=True))
    how = {"task": TASK.name, "environment": TASK.env_id, "episodes": 3, "seed": 0, "checkpoint": "last"}
    how |= {"noise_scale": 1.0, "sampler": "ddpm", "temperature": 1.0, "horizon": 5}
    scores = {"mean": 1.0, "best": 2.0}
    data = steps.do("data", "data", {"data": "local:[/b]/x"}, [], lambda place, resuming: {"scores": scores})
    start = {"mean": -1.0, "low": -10.0, "high": None}

    def evaluate(place, resuming):
        result.save(place) if result else (place / "episodes.parquet").write_bytes(b"")
        return {"episodes": place / "episodes.parquet", "protocol": how, "start_value": start}

    steps.do("evaluate", "evaluate", {"seed": 0}, [data], evaluate)


def read_run(folder):
    """What `dds report` and `dds atlas` read of a run, without drawing it."""
    skill_replays.replay_skills = lambda task, agent: {"codes": np.zeros(1)}
    find_subject(folder)
    found = Findings.read(folder)
    logs = {stage: path for stage in ("skill", "policy") if (path := report._metrics(folder, stage, folder / "report"))}
    page(found, {}, diagnose(found, logs))
    if (folder / "agent" / SUMS).is_file():
        skill_replays.stored_replays(folder / "report" / "replays.npz", known_task(found.result.task), folder / "agent")
    with locked(folder):
        do_steps(folder)


TARGETS = [
    Target("published agents", make_published, ("agent/*.yaml", "agent/*.json"), read_published, resealed),
    Target("weights", make_published, ("agent/*.safetensors",), read_published, resealed),
    Target("hashes", make_published, ("agent/SHA256SUMS",), read_published),
    Target("checkpoints", make_checkpoint, ("last.ckpt",), lambda folder: SkillModule.load(folder / "last.ckpt")),
    Target("checkpoints that go on", make_checkpoint, ("last.ckpt",), read_resumed),
    Target(
        "D4RL's files",
        lambda folder: write_d4rl_file(folder / "a.hdf5", TASK, episodes()),
        ("a.hdf5",),
        read_data("d4rl:{}/a.hdf5"),
    ),
    Target(
        "Minari's data sets",
        lambda folder: write_minari_set(folder, "set-v0", TASK, episodes()),
        ("set-v0/data/*",),
        read_data("local:{}/set-v0"),
    ),
    Target("arrays", lambda folder: trajectories().save(folder / "set"), ("set/*",), read_data("arrays:{}/set")),
    Target("relabelled data", make_relabelled, ("*.safetensors",), read_relabelled),
    Target("behaviour policies", make_behaviour, ("p.safetensors",), lambda f: MLPPolicy.load(f / "p.safetensors")),
    Target("task files", make_task, ("mine.yaml",), lambda folder: load_task(str(folder / "mine.yaml"))),
    Target("markers of runs", make_run, ("*/stage.json",), read_run),
    Target("tables of runs", make_run, ("evaluate/*.parquet", "evaluate/*.npz", "report/*.npz"), read_run),
    Target("logs of runs", make_run, ("relabel/codes.csv", "skill/logs/*/metrics.csv"), read_run),
]
CASES = {"checkpoints that go on": 40, "published agents": 140, "weights": 140, "tables of runs": 140}
"""Target -> mutated files of `make faults`; 100 for the others."""
COUNTS: Counter[str] = Counter()


def check(target, cases, root, seed):
    tally = fuzz(target, cases, root, seed)
    story = "\n".join(f"case {number}, {outcome}, {name}: {said}" for number, outcome, name, said in tally.stories[:8])
    assert not [outcome for outcome in BAD if tally.counts[outcome]], f"{target.name}: {dict(tally.counts)}\n{story}"
    return tally.counts


@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_few_mutated_files_do_no_harm(target, tmp_path):
    check(target, 4, tmp_path / "fuzz", 10_000)


@pytest.mark.faults
@pytest.mark.filterwarnings("ignore:.*use of fork.*:DeprecationWarning")
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_mutated_files_are_refused_in_one_sentence_or_loaded(target, tmp_path):
    counts = check(target, CASES.get(target.name, 100), tmp_path / "fuzz", 0)
    COUNTS.update(counts)
    print(f"\n{target.name}: {counts.total()} files, {counts['refused']} refused, {counts['loaded']} loaded")


@pytest.mark.faults
def test_there_were_a_thousand_of_them():
    print(f"\n{COUNTS.total()} mutated files: {COUNTS['refused']} refused, {COUNTS['loaded']} loaded, nothing else")
    assert COUNTS.total() >= 1000
    assert set(COUNTS) <= {"refused", "loaded"}
