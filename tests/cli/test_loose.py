"""Checkpoints that nothing has published, for a goal of one's own: played, published, looked at; and lists of one."""

import json
from pathlib import Path

import pytest

from dds_lightning.cli import main
from dds_lightning.cli.parser import prepare
from dds_lightning.saving.published import load_published
from dds_lightning.skill import SkillModule
from dds_lightning.study.loose import loose_agent
from dds_lightning.tasks import get_task
from tests.fits import POLICY, QUIET, call, of_data, skill_of, told

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
TASK = "pointmaze-umaze-diverse?goal=1,3"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Checkpoints of skills and of a policy, both in folders of `dds STAGE fit`."""
    root = tmp_path_factory.mktemp("loose")
    data = [f"--data.task={TASK}" if word.startswith("--data.task") else word for word in of_data(root)]
    skill = skill_of(data, root / "skill", 3)
    fit = ["policy", "fit", *data, *QUIET, *POLICY, f"--data.skill={skill}", "--trainer.max_steps=3"]
    fit += [f"--checkpoint.dirpath={root / 'policy'}", f"--trainer.default_root_dir={root}"]
    fit[fit.index("--model.hidden_dims=[16]")] = "--model.hidden_dims=16"
    assert call(*fit) == 0
    return skill, root / "policy" / "last.ckpt", data[1].removeprefix("--data.data=")


def answer(capsys, *words):
    capsys.readouterr()
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_they_play_in_the_task_that_they_were_trained_for(trained, capsys):
    skill, policy, _ = trained
    words = ["evaluate", "--skill", skill, "--policy", policy, "--episodes", 1, "--workers", 0]
    found = answer(capsys, *words, "--selection", "greedy")
    assert (found["task"], found["agent"]) == (TASK, str(policy))
    assert [row["actor"] for row in found["results"]] == ["AWR policy, greedy"]
    other = answer(capsys, *words, "--selection=random", "--task", "pointmaze-umaze-diverse")
    assert other["protocol"]["task"] == "pointmaze-umaze-diverse"


@pytest.mark.parametrize(("task", "noise"), [("kitchen-mixed", 0.0), ("hopper-medium", 0.5), (TASK, None)])
def test_their_noise_is_that_of_the_tasks_preset_as_in_a_run(trained, task, noise):
    skill, policy, _ = map(str, trained)
    usual = SkillModule.load(skill).hparams.noise_scale
    agent = loose_agent(skill, policy, get_task(task))
    assert agent.noise_scale == (usual if noise is None else noise)
    assert loose_agent(skill, policy, get_task(task), noise_scale=0.7).noise_scale == 0.7
    assert loose_agent(skill, policy).noise_scale == usual


def test_they_are_published_with_it_and_the_agent_knows_its_goal(trained, capsys, tmp_path):
    skill, policy, data = trained
    facts = answer(capsys, "publish", "-", tmp_path / "agent", "--skill", skill, "--policy", policy)
    assert facts["task"] == load_published(tmp_path / "agent").config["task"] == TASK
    assert answer(capsys, "evaluate", tmp_path / "agent", "--episodes", 1, "--workers", 0)["task"] == TASK
    assert answer(capsys, "checkpoints", "list", tmp_path)[0]["task"] == TASK
    made = answer(capsys, "atlas", skill, "--data", data, "--episodes", 0, "--out", tmp_path / "atlas.html")
    assert made["task"] == TASK


@pytest.mark.parametrize("command", ["evaluate", "publish"])
def test_a_folder_of_a_training_names_the_command_that_helps(trained, capsys, tmp_path, command):
    skill, policy, _ = trained
    for path, words in ((policy, f"--skill SKILL.ckpt --policy {policy}"), (skill, f"--skill {skill}")):
        assert main([command, str(path.parent), *([str(tmp_path / "out")] if command == "publish" else [])]) == 2
        assert f"plays with `dds evaluate {words}` and is published with `dds publish - PLACE {words}`" in told(
            capsys.readouterr().err
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluate"], "give a run or a published checkpoint, or the checkpoints of trainings"),
        (["evaluate", "runs/x", "--skill", "y.ckpt"], "the run is runs/x and --skill is y.ckpt"),
        (["evaluate", "runs/x", "--policy", "y.ckpt"], "--policy is y.ckpt without --skill"),
        (["evaluate", "hf:owner/name"], "there is no folder hf:owner/name"),
        (["export", "-"], "there is no folder -:"),
        (["record", "-"], "there is no folder -:"),
        (["publish", "-", "shared/there"], "run is '-' and --skill is None"),
        (["checkpoints", "list", "no-such-folder"], "there is no folder no-such-folder"),
        (["data", "list", "no-such-folder"], "there is no folder no-such-folder"),
    ],
)
def test_what_fits_nothing_is_refused(capsys, words, message):
    assert main(words) == 2
    assert message in told(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("evaluate r --selection greedy", "evaluate r --selection=[greedy]"),
        ("evaluate r --selection=greedy,sample", "evaluate r --selection=[greedy,sample]"),
        ("evaluate r --selection [greedy]", "evaluate r --selection=[greedy]"),
        ("checkpoints list --root runs", "checkpoints list --root=[runs]"),
        ("atlas r --against a.ckpt --seed 1", "atlas r --against=[a.ckpt] --seed 1"),
        ("run t --selection greedy", "run t --selection greedy"),  # takes one
    ],
)
def test_one_value_is_a_list_of_one(words, expected):
    assert prepare(words.split()) == expected.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run t --fresh --seed 1", "run t --fresh=true --seed 1"),
        ("run t --fresh true --seed 1", "run t --fresh=true --seed 1"),
        ("study run f --plan false", "study run f --plan=false"),
        ("study run --plan f", "study run --plan=true f"),
    ],
)
def test_a_flag_may_be_bare_or_say_true_or_false(words, expected):
    assert prepare(words.split()) == expected.split()


@pytest.mark.parametrize(
    ("held", "asked", "other"),
    [
        ("hopper-medium", "walker2d-medium", True),
        ("pointmaze-umaze-play", "pointmaze-umaze-play?goal=1,3", True),
        ("hopper-medium@v5", "hopper-medium", False),  # the variant of the data
    ],
)
def test_a_run_of_another_task_is_not_put_away(tmp_path, capsys, held, asked, other):
    from types import SimpleNamespace

    from dds_lightning.pipeline.run import _refuse_other_run

    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "stage.json").write_text(json.dumps({"settings": {"task": held}, "state": "finished"}))
    if not other:
        _refuse_other_run(SimpleNamespace(out=tmp_path, task=get_task(asked), asked=get_task(asked)))
        return
    assert main(["run", asked, "--out", str(tmp_path), "--until", "data"]) == 2
    assert f"--out is {tmp_path}, which holds a run of {held}, not of {asked}" in told(capsys.readouterr().err)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "run.lock"]


def test_the_task_that_a_checkpoint_names_is_never_opened(trained, tmp_path, capsys):
    import torch

    skill, _, _ = trained

    stored = torch.load(skill, weights_only=True)
    stored["settings"]["data.task"] = str(tmp_path / "evil.yaml")
    torch.save(stored, tmp_path / "evil.ckpt")
    assert main(["evaluate", "--skill", str(tmp_path / "evil.ckpt"), "--selection", "random"]) == 2
    assert f"was trained for task {tmp_path / 'evil.yaml'}: give --task=" in told(capsys.readouterr().err)
    assert get_task(TASK).goal_cell == (1, 3)


def test_an_agent_is_recorded_in_its_task_and_what_cannot_be_is_refused(trained, capsys, tmp_path, monkeypatch):
    skill, policy, _ = trained
    assert call("publish", "-", tmp_path / "agent", "--skill", skill, "--policy", policy) == 0
    found = answer(capsys, "record", tmp_path / "agent", "--episodes", 2, "--out", tmp_path / "film.gif")
    assert (found["task"], found["pictures"], [row["steps"] for row in found["results"]]) == (TASK, "drawn", [300, 300])
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    for words, message in (
        ([tmp_path / "agent", "--out", tmp_path / "film.avi"], "expected a name that ends in .mp4 or .gif"),
        ([tmp_path / "agent", "--episodes", 0], "--episodes is 0, expected at least 1"),
        ([tmp_path / "nowhere"], "there is no folder"),
        ([tmp_path / "agent", "--task", "hopper-medium"], r"it was trained for another task"),
    ):
        assert main(["record", *map(str, words)]) == 2
        assert message in told(capsys.readouterr().err)


def test_a_table_that_could_not_be_written_is_refused_before_anybody_plays(tmp_path, capsys):
    words = ["evaluate", str(CHECKPOINTS / "pointmaze-large"), "--episodes=1", "--workers=0"]
    (tmp_path / "file").touch()
    for out, sentence in (
        (tmp_path, "a folder: give the name"),
        (tmp_path / "file" / "x", "nothing can be written in"),
    ):
        assert main([*words, f"--out={out}"]) == 2
        assert sentence in " ".join(capsys.readouterr().err.split())
