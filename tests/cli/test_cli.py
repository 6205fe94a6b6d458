"""The command line in-process: what it prints where, its exit status, and that mistakes write nothing."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import warnings
from pathlib import Path

import pytest
import torch
import yaml

from dds_lightning._version import __version__
from dds_lightning.cli import main
from dds_lightning.tasks import task_names

TASK = "pointmaze-umaze-diverse"
TINY = ["--model.hidden_dim=16", "--model.skill_dim=8", "--model.encoder_layers=1", "--model.encoder_heads=2"]
TINY += ["--model.decoder_blocks=1", "--data.batch_size=32", "--data.horizon=5", "--model.num_skills=4"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
QUIET += ["--trainer.accelerator=cpu", "--trainer.limit_val_batches=1", "--trainer.num_sanity_val_steps=0"]


def refused(answer, *parts):
    """The answer is one sentence of error on standard error, status 2, no traceback."""
    assert answer.status == 2
    assert answer.out == ""
    lines = [line for line in answer.err.splitlines() if line.startswith("dds: error: ")]
    assert len(lines) == 1
    assert "Traceback" not in answer.err
    for part in parts:
        assert part in lines[0]


def files(folder="."):
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """2,000 steps of the smallest maze, as `dds data collect` writes them."""
    root = tmp_path_factory.mktemp("data")
    words = ["data", "collect", TASK, "--steps", "2000", "--out", str(root), "--workers", "1"]
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        assert main(words) == 0
    return root / f"{TASK}-v0"


@pytest.fixture(scope="module")
def of_data(data):
    return [f"--data.task={TASK}", f"--data.data=local:{data}", "--data.validation_fraction=0.2"]


@pytest.fixture(scope="module")
def skill(tmp_path_factory, of_data):
    """A skill checkpoint after a few steps."""
    out = tmp_path_factory.mktemp("skill")
    places = [f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}"]
    words = ["skill", "fit", *of_data, *TINY, *QUIET, *places, "--trainer.max_steps=4"]
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        assert main(words) == 0
    return out / "last.ckpt"


# -------------------------------------------------------------------- small commands


def test_the_version_is_printed(dds):
    assert dds("--version").out == f"dds-lightning {__version__}\n"


def test_tasks_are_listed_for_people_and_for_programs(dds):
    assert all(name in dds("tasks").out for name in task_names())
    rows = {row["task"]: row for row in dds("tasks", "--json").json}
    assert list(rows) == list(task_names())
    assert rows["hopper-medium-replay"]["paper"] == 84.6
    assert rows[TASK]["paper"] is None  # a missing number is null, not NaN, which is no JSON


def test_the_table_of_tasks_fits_a_terminal_of_100_columns(dds):
    lines = [line.rstrip() for line in dds("tasks").out.splitlines()]
    rows = [line for line in lines if line.split() and line.split()[0] in task_names()]
    assert len(rows) == len(task_names())
    assert max(map(len, rows)) <= 100


def test_one_task_is_told_in_full(dds):
    told = dds("tasks", "antmaze-medium-diverse").out
    for fact in ("0.1 * (r - 1)", "row 6, column 6, at x 20 m, y 20 m", "within 0.5 m", "d4rl:antmaze-medium-diverse"):
        assert fact in told
    for fact in ("torque of +-30 N m", "torque of +-150 N m", "D4RL's data", "89.1", "hip 4", "1000 steps of 0.1 s"):
        assert fact in told
    maze = told.splitlines()[-8:]
    assert maze[1] == "##S   ####    ##"
    assert maze[6] == "##      ##  G ##"
    row = dds("tasks", "antmaze-medium-diverse@robotics", "--json").json
    assert row["start"] == {"cell": [1, 1], "xy": [-10, 10]}
    assert row["variants"]["antmaze-medium-diverse"]["seconds a step"] == 0.1
    assert row["variants"]["antmaze-medium-diverse@robotics"]["seconds a step"] == row["seconds a step"] == 0.05
    refused(dds("tasks", "antmaze-medium"), "antmaze-medium", "antmaze-medium-play")


@pytest.mark.parametrize("words", [[], ["data"], ["run"], ["skill"], ["policy"], ["relabel"], ["evaluate"]])
def test_every_command_explains_itself(dds, words):
    answer = dds(*words, "--help")
    assert answer.status == 0
    assert "usage: dds" in answer.out
    assert answer.err == ""


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["nonsense"], ["nonsense", "choose from"]),
        (["tasks", "--nope"], ["--nope"]),
        (["run"], ["task", "dds run --help"]),
        (["run", "pointmaze-larg-diverse"], ["pointmaze-larg-diverse", "pointmaze-large-diverse"]),
        (["run", TASK, "--seed", "many"], ["seed", "many"]),
        (["run", TASK, "--episodes", "0"], ["--episodes", "0"]),
        (["run", TASK, "--preset", "nope"], ["preset", "nope", "pointmaze"]),
        (["run", TASK, "--data", "local:nowhere"], ["nowhere"]),
        (["run", TASK, "--skill.model.nope=1"], ["nope"]),
        (["run", TASK, "--skill.model.lr"], ["--skill.model.lr", "VALUE"]),
        (["run", TASK, "--until", "lunch"], ["until", "lunch"]),
        (["evaluate", "nowhere"], ["nowhere"]),
        (["report", "nowhere"], ["nowhere"]),
        (["data", "check", "nowhere"], ["nowhere"]),
        (["data", "check", "nowhere.hdf5"], ["nowhere.hdf5", "d4rl:FILE"]),
        (["data", "collect", "nope"], ["nope"]),
        (["data", "collect", "hopper-medium@v5"], ["hopper-medium@v5", "pointmaze", "dds data fetch hopper-medium"]),
        (["data", "fetch", "nope"], ["nope"]),
        (["data", "fetch", TASK], [TASK, "d4rl", "minari:"]),
        (["data", "fetch", TASK, "--source", "here"], ["here", "dds data fetch --help"]),
        (["data", "show", "nowhere"], ["nowhere"]),
        (["skill", "nonsense"], ["nonsense"]),
        (["skill", "fit", "--config", "nope.yaml"], ["nope.yaml", "pointmaze/skill.yaml"]),
        (["skill", "fit", "--data.task", "nope"], ["nope"]),
        (["skill", "fit", "--model.lr", "fast"], ["lr", "fast"]),
        (["skill", "validate", "--data.task", TASK], ["--ckpt_path"]),
        (["policy", "fit", "--data.task", TASK], ["data.skill"]),
    ],
)
def test_a_mistake_is_one_sentence_status_2_and_no_file(dds, words, parts):
    refused(dds(*words), *parts)
    assert files() == []


# -------------------------------------------------------------------- data


def test_sound_data_are_described(dds, data):
    answer = dds("data", "check", data, "--task", TASK, "--json")
    assert answer.json["sound"] is True
    assert answer.json["facts"]["observation width"] == 4
    assert "is sound" in dds("data", "check", f"local:{data}").out


def test_data_are_listed_with_the_task_they_fit(dds, data):
    (row,) = dds("data", "list", "--root", f"[{data.parent}]", "--json").json
    assert row["steps"] == 2000
    assert row["tasks"] == [TASK]
    assert row["data"] == f"local:{data}"
    assert f"local:{data}" in dds("data", "list", "--root", f"[{data.parent}]").out.replace("\n", "")
    assert "dds data collect" in dds("data", "list").out


def test_data_are_shown_in_tables_and_a_figure(dds, data):
    shown = dds("data", "show", data, "--task", TASK, "--episodes", 1, "--json").json
    assert [d["name"] for d in shown["dimensions"]][:2] == ["x (m)", "y (m)"]
    assert [d["dimension"] for d in shown["dimensions"]][-2:] == ["action 0", "action 1"]
    assert len(shown["episodes"]) == 1
    assert shown["figure"] == f"show/{TASK}-v0.png"
    assert files() == [shown["figure"]]
    assert Path(shown["figure"]).read_bytes().startswith(b"\x89PNG")
    answer = dds("data", "show", data, "--out", "mine.pdf")
    assert "x velocity" not in answer.out
    assert f"it may be {TASK}" in answer.out
    assert Path("mine.pdf").read_bytes().startswith(b"%PDF")


def test_a_figure_is_drawn_only_where_it_can_be_and_is_wanted(dds, data):
    assert dds("data", "show", data, "--no_figure", "--json").json["figure"] is None
    refused(dds("data", "show", data, "--out", "figure.doc"), "figure.doc", ".png")
    refused(dds("data", "show", data, "--episodes", -1), "--episodes", "-1")
    assert files() == []


def test_fetching_without_a_network_is_one_sentence(dds, monkeypatch):
    monkeypatch.setattr("datamodules.sources.download.PAUSE", 0.0)
    monkeypatch.setattr("urllib.request.OpenerDirector.open", _no_network)
    refused(
        dds("data", "fetch", "kitchen-mixed", "--out", "here"), "kitchen_microwave_kettle_bottomburner_light-v0.hdf5"
    )
    assert files() == []


def _no_network(*_, **__):
    raise urllib.error.URLError("name or service not known")


def test_what_was_fetched_is_said_as_it_is_typed(dds, monkeypatch):
    def fetch(task, source, out):
        Path(out).mkdir()
        path = Path(out) / "file.hdf5"
        path.write_bytes(b"")
        return path

    monkeypatch.setattr("datamodules.sources.fetch.fetch", fetch)
    answer = dds("data", "fetch", "kitchen-mixed", "--out", "here", "--json").json
    assert (answer["task"], answer["source"], answer["data"]) == ("kitchen-mixed", "d4rl", "d4rl:here/file.hdf5")


def test_data_of_another_task_are_refused_everywhere(dds, data):
    other = "pointmaze-large-diverse"
    refused(dds("data", "check", data, "--task", other), "PointMaze_UMaze-v3", "PointMaze_Large-v3")
    words = ["skill", "fit", f"--data.task={other}", f"--data.data=local:{data}"]
    refused(dds(*words), "PointMaze_UMaze-v3", "PointMaze_Large-v3")
    assert files() == []


def test_collecting_over_an_existing_data_set_is_refused(dds, data):
    before = (data / "data" / "main_data.hdf5").read_bytes()
    refused(dds("data", "collect", TASK, "--steps", 500, "--out", data.parent), data.name)
    assert (data / "data" / "main_data.hdf5").read_bytes() == before


# -------------------------------------------------------------------- the two trainings


def test_print_config_prints_settings_that_parse_again(dds, tmp_path):
    answer = dds("skill", "fit", "--config", "paper/skill.yaml", "--model.tau=1", "--print_config")
    refused(answer, "tau")
    answer = dds("skill", "fit", "--config", "paper/skill.yaml", "--model.lr=0.5", "--print_config")
    (tmp_path / "mine.yaml").write_text(answer.out)
    assert yaml.safe_load(answer.out)["model"]["lr"] == 0.5
    again = dds("skill", "fit", "--config", tmp_path / "mine.yaml", "--print_config")
    assert yaml.safe_load(again.out) == yaml.safe_load(answer.out)


def test_dimensions_come_from_the_data(skill):
    trained = torch.load(skill, weights_only=True)["hyper_parameters"]
    assert (trained["observation_dim"], trained["action_dim"], trained["horizon"]) == (4, 2, 5)


def test_a_fit_says_as_json_what_it_made(dds, of_data):
    words = [*of_data, *TINY, *QUIET, "--trainer.max_steps=2", "--json"]
    answer = dds("skill", "fit", *words, "--trainer.log_every_n_steps=1")
    assert answer.json["steps"] == 2
    assert Path(answer.json["checkpoint"]).is_file()
    assert answer.json["metrics"]["train/loss"] > 0
    logs = Path(answer.json["logs"])
    assert {"config.yaml", "metrics.csv"} <= {path.name for path in logs.iterdir()}
    again = dds("skill", "fit", *words)
    assert again.json["checkpoint"] != answer.json["checkpoint"]  # a second launch replaces nothing


def test_the_saved_configuration_repeats_the_run(dds, of_data):
    words = [*of_data, *TINY, *QUIET, "--trainer.max_steps=2", "--json", "--checkpoint.dirpath=a"]
    logs = Path(dds("skill", "fit", *words).json["logs"])
    dds("skill", "fit", "--config", logs / "config.yaml", "--checkpoint.dirpath=b")
    first, second = (torch.load(f"{name}/last.ckpt", weights_only=True)["state_dict"] for name in "ab")
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_validation_and_prediction_need_no_training(dds, of_data, skill):
    words = [*of_data, *QUIET, "--data.horizon=5", f"--ckpt_path={skill}", "--json"]
    metrics = dds("skill", "validate", *words).json["metrics"]
    assert 1 <= metrics["val/codes_used"] <= 4
    assert metrics["val/codes_used"] + metrics["val/dead_codes"] == 4
    codes = dds("skill", "predict", *words).json
    assert sum(row["count"] for row in codes["codes"]) == codes["rows"] > 1000
    assert Path(codes["file"]).is_file()


def test_one_code_is_refused(dds, of_data):
    refused(dds("skill", "fit", *of_data, "--model.num_skills=1"), "num_skills", "1", "at least 2")
    assert files() == []


def test_a_horizon_longer_than_every_episode_is_refused(dds, of_data):
    refused(dds("skill", "fit", *of_data, *TINY, *QUIET, "--data.horizon=5000"), "horizon", "5000")
    assert files() == []


def test_resuming_ends_with_the_same_bits_as_training_through(dds, of_data):
    words = [*of_data, *TINY, *QUIET, "--model.dropout=0.1"]
    dds("skill", "fit", *words, "--trainer.max_steps=8", "--checkpoint.dirpath=through")
    dds("skill", "fit", *words, "--trainer.max_steps=5", "--checkpoint.dirpath=half")
    resumed = ["--trainer.max_steps=8", "--ckpt_path=half/last.ckpt", "--checkpoint.dirpath=rest"]
    answer = dds("skill", "fit", *words, *resumed)
    assert answer.status == 0, answer.err
    one, two = (torch.load(f"{n}/last.ckpt", weights_only=True)["state_dict"] for n in ("through", "rest"))
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_a_setting_that_contradicts_the_resumed_checkpoint_is_refused(dds, of_data, skill):
    words = [*of_data, "--data.horizon=5", f"--ckpt_path={skill}", "--model.lr=0.5"]
    refused(dds("skill", "fit", *words), "--model.lr", "0.5", "5e-05")
    assert files() == []


def test_a_checkpoint_of_other_dimensions_is_refused(dds, of_data, skill):
    words = [*of_data, *QUIET, "--data.horizon=7", f"--ckpt_path={skill}"]
    refused(dds("skill", "validate", *words), "horizon 5", "7")
    assert files() == []


def test_a_missing_damaged_or_strange_checkpoint_is_refused(dds, of_data, skill, tmp_path):
    refused(dds("skill", "test", *of_data, "--ckpt_path=none.ckpt"), "none.ckpt")
    Path("cut.ckpt").write_bytes(skill.read_bytes()[:-2000])
    refused(dds("skill", "test", *of_data, "--ckpt_path=cut.ckpt"), "cut.ckpt")
    words = ["policy", "fit", *of_data, f"--data.skill={skill}", f"--ckpt_path={skill}"]
    refused(dds(*words), "of stage skill, expected policy")
    assert files() == ["cut.ckpt"]


# -------------------------------------------------------------------- relabelling and policy


def test_relabelling_and_a_policy_upon_it(dds, data, of_data, skill):
    answer = dds("relabel", skill, data, "--task", TASK, "--out", "relabelled.safetensors", "--json")
    assert answer.json["segments"] > 1000
    assert len(answer.json["codes"]) == 4
    fit = ["policy", "fit", *of_data, f"--data.skill={skill}", "--data.cache=."]
    fit += ["--data.relabelled=relabelled.safetensors", *QUIET, "--model.hidden_dims=[16]", "--data.batch_size=32"]
    made = dds(*fit, "--trainer.max_steps=3", "--json")
    assert made.json["steps"] == 3
    trained = torch.load(made.json["checkpoint"], weights_only=True)["hyper_parameters"]
    assert (trained["observation_dim"], trained["num_skills"], trained["hidden_dims"]) == (4, 4, [16])


def test_the_policy_that_scores_best_while_training_is_kept(dds, of_data, skill):
    rollouts = "dds_lightning.callbacks.RolloutEvaluation"
    fit = ["policy", "fit", *of_data, f"--data.skill={skill}", "--data.cache=.", *QUIET, "--model.hidden_dims=[16]"]
    fit += [f"--trainer.callbacks+={rollouts}", "--trainer.callbacks.episodes=2", "--trainer.callbacks.workers=0"]
    fit += ["--trainer.max_steps=4", "--trainer.val_check_interval=2", "--trainer.check_val_every_n_epoch=null"]
    made = dds(*fit, "--best.monitor=rollout/success", "--checkpoint.dirpath=out", "--json").json
    assert Path(made["best"]).resolve() == Path("out/best.ckpt").resolve()
    assert 0 <= made["metrics"]["rollout/success"] <= 100


def test_a_relabelled_file_of_another_checkpoint_is_refused(dds, data, of_data, skill):
    dds("relabel", skill, data, "--task", TASK, "--out", "relabelled.safetensors")
    words = [*of_data, *TINY, *QUIET, "--trainer.max_steps=1", "--checkpoint.dirpath=other"]
    dds("skill", "fit", *words, "--seed_everything=7", "--trainer.default_root_dir=other")
    before = files()
    words = [*of_data, "--data.skill=other/last.ckpt", "--data.relabelled=relabelled.safetensors"]
    refused(dds("policy", "fit", *words), "relabelled.safetensors", "skill")
    assert files() == before


# -------------------------------------------------------------------- stopping


def test_sigterm_saves_ends_with_143_and_says_how_to_go_on(dds, of_data):
    sender = threading.Thread(target=_signal_when, args=(Path("out/last.ckpt"), signal.SIGTERM))
    sender.start()
    fit = ["skill", "fit", *of_data, *TINY, *QUIET, "--checkpoint.dirpath=out", "--trainer.max_steps=100000"]
    answer = dds(*fit, "--checkpoint.every_n_steps=3")
    sender.join()
    assert answer.status == 143
    assert "--ckpt_path out/last.ckpt" in answer.err
    stopped = torch.load("out/last.ckpt", weights_only=True)["global_step"]
    assert stopped >= 3
    command = next(line for line in answer.err.splitlines() if line.startswith("  dds skill fit"))
    words = [*command.split()[1:], f"--trainer.max_steps={stopped + 2}"]
    assert dds(*words).status == 0
    assert torch.load("out/last.ckpt", weights_only=True)["global_step"] == stopped + 2


def _signal_when(path, signum):
    for _ in range(1200):
        if path.exists():
            os.kill(os.getpid(), signum)
            return
        time.sleep(0.05)


def test_a_loss_that_is_not_finite_keeps_the_last_good_checkpoint(dds, of_data, skill, monkeypatch):
    from dds_lightning.skill import SkillModule

    real = SkillModule.training_step

    def poisoned(self, batch, batch_idx):
        loss = real(self, batch, batch_idx)
        return loss * float("nan") if self.global_step >= 4 else loss

    monkeypatch.setattr(SkillModule, "training_step", poisoned)
    words = [*of_data, *TINY, *QUIET, "--checkpoint.dirpath=out", "--checkpoint.every_n_steps=2"]
    refused(dds("skill", "fit", *words, "--trainer.max_steps=50"), "nan")
    saved = torch.load("out/last.ckpt", weights_only=True)
    assert saved["global_step"] == 4
    assert all(torch.isfinite(value).all() for value in saved["state_dict"].values() if value.is_floating_point())


# -------------------------------------------------------------------- the process


def test_light_commands_import_nothing_heavy():
    code = (
        "import sys; from dds_lightning.cli import main; main(['tasks']); main(['--version']);"
        "print([name for name in ('torch', 'lightning', 'matplotlib', 'mujoco') if name in sys.modules])"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "[]"


def test_a_reader_that_leaves_early_is_no_error():
    ran = subprocess.run(
        f"{sys.executable} -m dds_lightning tasks --json | head -1",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stdout == "[\n"
    assert ran.stderr == ""


def test_a_warning_is_a_sentence_without_a_place_in_the_code(capsys, monkeypatch):
    def warn(words):
        warnings.warn("two of nine episodes\n are short", stacklevel=1)
        return 0

    monkeypatch.setattr("dds_lightning.cli._dispatch", warn)
    assert main(["tasks"]) == 0
    assert capsys.readouterr().err == "dds: warning: two of nine episodes are short\n"
