"""What `dds run` refuses before it begins, and what its trainings depend on."""

import pytest

from dds_lightning.errors import UserError
from dds_lightning.pipeline.context import Run
from dds_lightning.pipeline.seeds import run_seeds
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.pipeline.steps import STEPS, reading_starts
from tests.pipeline.test_run import SMALL, TASK, call


def test_raw_actions_are_refused_at_once_with_the_command_that_has_them(capsys, tmp_path):
    out = tmp_path / "raw"
    status, _, err = call(capsys, "--out", out, *SMALL, "--until=online", "--online.data.actions=raw")
    assert status == 2
    assert f"use `dds online fit --data.task={TASK} --data.actions=raw`" in err
    assert not out.exists()


def test_learning_online_is_done_again_when_the_policy_it_starts_from_was(tmp_path):
    def online(path):
        """Its step in a run, and what its result depends on."""
        asked = RunSettings.with_preset(TASK, tmp_path / "run", stages={"online": (f"--model.offline={path}",)})
        run = Run(asked)
        step = reading_starts(STEPS["online"], run)
        return step.reads, step.settings(run), step.former(run)

    own = ("data", "skill", "relabel")
    assert online(tmp_path / "run" / "policy" / "last.ckpt")[0] == (*own, "policy")
    assert online(tmp_path / "run" / "agent")[0] == (*own, "evaluate")
    with pytest.raises(UserError, match=r"online: model\.offline: there is no checkpoint"):
        online(tmp_path / "other.ckpt")
    (tmp_path / "other.ckpt").write_bytes(b"weights")
    reads, settings, former = online(tmp_path / "other.ckpt")
    assert reads == own
    assert online(tmp_path / "other.ckpt")[1] == settings
    (tmp_path / "other.ckpt").write_bytes(b"weights of another training")
    assert online(tmp_path / "other.ckpt")[1] != settings
    assert online(tmp_path / "other.ckpt")[2] == former == {k: v for k, v in settings.items() if k != "starts"}


def test_several_seeds_do_not_start_from_the_policy_of_one(tmp_path):
    path = tmp_path / "runs" / "seed-4" / "policy" / "last.ckpt"
    asked = RunSettings.with_preset(TASK, tmp_path / "runs", seed=3, stages={"online": (f"--model.offline={path}",)})
    with pytest.raises(UserError, match=r"online: model\.offline is .*, of seed 4 alone, but with --seeds 2"):
        run_seeds(asked, 2)
    assert not (tmp_path / "runs").exists()
