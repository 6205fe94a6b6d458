"""Does the verdict name the stage that was spoilt? Spoil a good run in six ways and ask.

    python benchmarks/spoilt_runs.py runs/walker2d-medium-expert --episodes 5

Takes a finished `dds run` and spoils one thing at a time: skills trained for 200 steps only, a codebook that collapsed,
alpha 0, alpha far too large, a critic that hardly trained, and, where episodes end by a fall, data whose terminations
were dropped. What depends on it is trained again, briefly; the agent plays, its stages are examined, and the verdict is
printed beside what was spoilt. A spoilt run that still reaches what its data hold needs no mending, and says so.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from datamodules.relabelled import RelabeledDataModule
from datamodules.sources import load_trajectories
from datamodules.trajectories import Trajectories
from dds_lightning import DDSAgent, PolicyModule, SkillModule
from dds_lightning.rollout.actors import Contestant, single_skills
from dds_lightning.rollout.play import rollout
from dds_lightning.saving.run_directory import read_marker
from dds_lightning.study import evidence
from dds_lightning.study.findings import Findings
from dds_lightning.study.verdict import Verdict, verdict
from dds_lightning.training.stage_cli import command

QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false", "--trainer.logger=false"]


class Bench:
    """A finished run, and what it takes to ask for a verdict on a spoilt copy of its parts."""

    def __init__(self, run: Path, episodes: int, steps: int, work: Path) -> None:
        self.run, self.episodes, self.steps, self.work = run, episodes, steps, work
        self.found = Findings.read(run)
        settings = read_marker(run / "data")["settings"]
        data = settings["data"] or f"local:{run / 'data' / self.found.task.name}"
        self.trajectories = load_trajectories(data, self.found.task)
        self.data, self.task = data, self.trajectories.task
        self.policy_settings = read_marker(run / "policy")["settings"]
        self.evaluation = read_marker(run / "evaluate")["settings"]

    def train(self, stage: str, *arguments: str) -> Path:
        """Train a stage with the family's preset, for a part of its steps; return its checkpoint."""
        out = Path(tempfile.mkdtemp(dir=self.work))
        common = ["--config", f"{self.task.family}/{stage}.yaml", f"--data.task={self.task.name}"]
        common += [f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}", *QUIET]
        command(stage, ["fit", *common, *arguments])()
        return out / "last.ckpt"

    def policy(self, skill: Path, data: str, *arguments: str) -> Path:
        """Train a policy on a skill checkpoint."""
        given = [f"--data.data={data}", f"--data.skill={skill}", f"--data.cache={self.work}"]
        return self.train("policy", *given, f"--trainer.max_steps={self.steps}", *arguments)

    def ask(self, skill: Path, policy: Path, data: str, alpha: float | None = None) -> Verdict:
        """Play, examine, and return the verdict."""
        trajectories = load_trajectories(data, self.task)
        module, skills = PolicyModule.load(policy), SkillModule.load(skill)
        module.hparams.alpha = module.hparams.alpha if alpha is None else alpha
        e = self.evaluation
        agent = DDSAgent(skills, module, e["selection"], e["temperature"], e.get("noise_scale"))
        players = [Contestant("agent", agent, self.episodes), single_skills(agent, max(1, self.episodes // 3))]
        result = rollout(self.task, players, seed=7, progress=False).episodes
        single = result[result.actor != "agent"].groupby("label").score.mean().max()
        scores = {"agent": float(result[result.actor == "agent"].score.mean()), "single": float(single)}
        scores |= {f"data_{name}": value for name, value in self.found.facts("data")["scores"].items()}
        relabelling = {name: self.policy_settings["data"][name] for name in ("gamma", "discount", "stride")}
        relabelling |= {name: self.policy_settings["data"][name] for name in ("reward_scale", "reward_shift")}
        transitions = RelabeledDataModule(
            self.task.name, data, str(skill), cache=str(self.work), seed=e["seed"], **relabelling
        )
        transitions.prepare_data()
        transitions.setup()
        shown = {**evidence.data_evidence(trajectories, self.task), **evidence.skill_evidence(skills, skill)}
        return verdict(scores, {**shown, **evidence.policy_evidence(transitions, module)})

    def without_terminations(self) -> str:
        """Write the data with every termination taken for a time-out; return where."""
        was = self.trajectories
        ends = was.terminations | was.truncations
        dropped = {"terminations": np.zeros_like(ends), "truncations": ends}
        copy = replace(was, name="without terminations", **dropped)
        assert isinstance(copy, Trajectories)
        return f"arrays:{copy.save(self.work / 'dropped')}"

    def spoils(self) -> Iterator[tuple[str, str, Verdict]]:
        """What was spoilt, the stages that may be named, and the verdict."""
        skill, policy = self.run / "skill" / "last.ckpt", self.run / "policy" / "last.ckpt"
        yield "nothing", "", self.ask(skill, policy, self.data)
        yield "alpha 0", "policy", self.ask(skill, policy, self.data, alpha=0.0)
        yield "alpha 1000", "policy", self.ask(skill, policy, self.data, alpha=1000.0)
        untrained = self.policy(skill, self.data, "--trainer.max_steps=20")
        yield "critic of 20 steps", "policy", self.ask(skill, untrained, self.data)
        given = [f"--data.data={self.data}"]
        short = self.train("skill", *given, "--trainer.max_steps=200")
        yield "skills of 200 steps", "skill", self.ask(short, self.policy(short, self.data), self.data)
        collapse = ["--model.codebook_init=normal", "--model.restart_threshold=0", "--model.num_skills=16"]
        few = self.train("skill", *given, "--trainer.max_steps=1000", *collapse)
        yield "a collapsed codebook", "skill", self.ask(few, self.policy(few, self.data), self.data)
        if self.trajectories.terminations.mean() > 0 and self.task.maze_map is None:
            dropped = self.without_terminations()
            yield "terminations dropped", "data", self.ask(skill, self.policy(skill, dropped), dropped)


def main() -> None:
    """Spoil a run and print a table of verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a finished `dds run`")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=3000, help="steps of each policy that is trained again")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
        bench = Bench(arguments.run, arguments.episodes, arguments.steps, Path(folder))
        rows = []
        with contextlib.redirect_stdout(nowhere):
            for spoilt, expected, named in bench.spoils():
                right = named.stage == (expected or None)
                rows.append({"spoilt": spoilt, "named": named.stage or "nothing", "right": right, "text": named.text})
    with pd.option_context("display.max_colwidth", 90, "display.width", 160):
        print(pd.DataFrame(rows).to_string(index=False))


if __name__ == "__main__":
    main()
