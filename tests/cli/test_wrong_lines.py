"""Sixty wrong command lines: each ends with status 2 and one sentence that says what is wrong; nothing is written.

A line is a row: where it came from does not matter, only that somebody typed it. `S` stands for a training of skills
that would work, `R` for a run of all stages.
"""

import shlex
import sys
from pathlib import Path

import pytest

from tests.fits import QUIET, SKILL, TASK, of_data, told

LINES = [
    # what Lightning refuses
    ("S --trainer.accelerator=gpuu", "trainer.accelerator is gpuu, which does not exist: did you mean"),
    ("S --trainer.accelerator=tpu", "torch_xla"),
    ("S --trainer.strategy=dpp", "trainer.strategy is dpp, which does not exist: did you mean"),
    ("S --trainer.devices=0", "devices"),
    ("S --trainer.devices=many", "--trainer.devices=many"),
    ("S --trainer.profiler=simpel", "did you mean simple?"),
    ("S --trainer.logger=WandbLogger", "pip install -e '.[log]'"),
    ("S --trainer.logger=WandbLoger", "did you mean WandbLogger?"),
    ("S --trainer.logger=CSVLogger", "CSVLogger needs save_dir: give --trainer.logger.save_dir=VALUE"),
    ("S --trainer.callbacks+=EarlyStopping", "EarlyStopping needs monitor"),
    (
        "S --trainer.callbacks+=EarlyStopping --trainer.callbacks.monitor=val_loss",
        "monitor of EarlyStopping is val_loss, which the skill training never logs, expected one of train/codebook, ",
    ),
    ("S --trainer.callbacks+=ModelCheckpoint --trainer.callbacks.monitor=val/los", "did you mean val/loss"),
    ("S --best.monitor=val_loss", "did you mean val/loss"),
    ("S --best.monitor=val/loss --trainer.limit_val_batches=0", "best.monitor is val/loss, which"),
    ("S --best.monitor=val/loss --data.validation_fraction=0", "best.monitor is val/loss, which"),
    ("S --best.monitor=val/loss --best.every_n_steps=-3", "best.every_n_steps is -3, expected at least 1"),
    (
        "S --trainer.callbacks+=EarlyStopping --trainer.callbacks.monitor=val/loss --trainer.callbacks.mode=maxx",
        "mode of EarlyStopping is maxx, expected min or max: did you mean max?",
    ),
    ("S --trainer.callbacks+=Timer --trainer.callbacks.duration=abc", "Timer: `Timer(duration='abc')` is not a valid"),
    (
        "S --trainer.callbacks+=dds_lightning.callbacks.RolloutEvaluation --trainer.callbacks.episodes=0",
        "rollout evaluation: episodes is 0, expected 1 or more",
    ),
    (
        "S --trainer.logger=TensorBoardLogger --trainer.logger.save_dir=x --trainer.logger.version=[1]",
        "version is [1], expected ",  # a whole number, text or null, in an order that depends on the parser's version
    ),
    ("S --trainer.gradient_clip_val=-1", "trainer.gradient_clip_val is -1"),
    ("S --trainer.num_sanity_val_steps=-5", "trainer.num_sanity_val_steps is -5, expected at least 0"),
    ("S --seed_everything=1e10", "seed_everything is 1e10, expected true or false or a whole number (see"),
    ("S --best.monitor=rollout/score", "which only a RolloutEvaluation logs: add --trainer.callbacks+="),
    ("S --stop.when=converged --stop.monitor=loss", "stop.monitor is loss, which the skill training never logs"),
    ("R --policy.stop.when=converged", "policy: stop.monitor is val/loss, which the policy training never logs"),
    ("R --policy.best.monitor=val/reward", "policy: best.monitor is val/reward"),
    ("R --clone.best.monitor=val/rmse", "clone: best.monitor is val/rmse"),
    ("R --online.best.monitor=val/loss", "online: best.monitor is val/loss"),
    (
        "R --policy.trainer.check_val_every_n_epoch=1 --policy.trainer.val_check_interval=50000",
        "policy: trainer.val_check_interval is 50000, but an epoch has at most",
    ),
    ("S --trainer.callbacks+=EarlyStoping", "did you mean EarlyStopping?"),
    (
        "S --trainer.callbacks+=EarlyStopping --trainer.callbacks.moniter=x",
        "has no argument moniter: did you mean monitor",
    ),
    ("S --trainer.precision=16-mixd", "did you mean 16-mixed"),
    ("S --trainer.num_nodes=0", "trainer.num_nodes is 0"),
    ("S --trainer.limit_train_batches=0", "nothing would be trained"),
    ("S --trainer.limit_train_batches=-1", "limit_train_batches"),
    ("S --trainer.max_time=soon", "soon"),
    ("S --trainer.accumulate_grad_batches=0", "at least 1"),
    ("S --trainer.max_steps=-2", "-2"),
    # found by `dds run` before data and skills are made
    ("R --policy.trainer.accelerator=gpuu", "policy: "),
    ("R --policy.trainer.strategy=dpp", "policy: "),
    ("R --clone.trainer.devices=0", "clone: "),
    ("R --skill.model.num_skills=1", "skill: model.num_skills is 1, expected at least 2"),
    ("R --policy.model.tau=2", "policy: model.tau is 2.0, expected in (0, 1)"),
    ("R --policy.model.fourier_seen=9", "policy: model.fourier_seen is 9, expected in [0, 4]"),
    ("R --policy.model.beta_floor=0.1", "policy: model.beta_floor is 0.1, expected in [0, 1/16)"),
    ("R --policy.data.stride=0", "policy: stride is 0, expected at least 1"),
    ("R --policy.data.gamma=2", "policy: gamma is 2.0, expected a discount in (0, 1]"),
    ("R --policy.data.batch_size=0", "policy: data.batch_size is 0, expected at least 1"),
    ("R --skill.data.horizon=0", "skill: horizon: got 0, expected at least 1"),
    ("R --clone.model.lr=-1", "clone: model.lr is -1.0, expected a positive number"),
    ("R --online.model.follow=-1", "online: model.follow is -1.0, expected 0 or more"),
    ("R --online.data.actions=raw", "online: data.actions is raw, expected skills"),
    ("R --policy.trainer.logger=WandbLogger", "pip install -e '.[log]'"),
    ("R --policy.trainer.logger=CSVLogger", "CSVLogger needs save_dir"),
    ("R --policy.trainer.precision=16-mixd", "did you mean 16-mixed"),
    ("R --skill.model.encoder=transfomer", "did you mean transformer?"),
    ("R --skill.model.num_skills=few", "num_skills is few, expected a whole number"),
    # options that do not exist
    ("S --nope", "--nope is not an option of `dds skill fit`"),
    ("S --modle.lr=1", "did you mean --model.lr"),
    ("S --model.lrr=1", "did you mean --model.lr"),
    ("S --data.horzon=5", "did you mean --data.horizon"),
    ("S --trainer.max_stps=3", "see `dds skill fit --help trainer`"),
    ("S --trainer.acelerator=cpu", "did you mean --trainer.accelerator"),
    ("S --checkpont.dirpath=x", "did you mean --checkpoint.dirpath"),
    ("S --best.moniter=x", "did you mean --best.monitor"),
    ("skill fti", "did you mean fit?"),
    ("skil fit", "did you mean skill?"),
    ("R --epsiodes 3", "did you mean --episodes?"),
    ("R --polcy.trainer.max_steps=3", "did you mean --policy?"),
    ("R --policy.trianer.max_steps=3", "did you mean --policy.trainer.max_steps"),
    ("R --skill.model.nope=1", "--skill.model.nope is not an option of `dds skill fit`"),
    ("data colect", "did you mean collect?"),
    ("checkpoints verfy", "did you mean verify?"),
    ("evaluate nowhere --selction greedy", "did you mean --selection?"),
    ("tasks --jsn", "did you mean --json?"),
    # options of another command
    ("R --trainer.max_steps=3", "which training it is for: write --skill.trainer.max_steps or --policy.trainer.max"),
    ("R --model.lr 1e-3", "--model.lr does not say which training it is for: write --skill.model.lr or"),
    (
        "R --data.data=local:x",
        "--data.data is an option of one training, such as `dds skill fit`: here give --data DATA",
    ),
    ("R --config pointmaze/skill.yaml", "here give --preset NAME"),
    ("skill fit --data local:x", "--data is a group of settings: for data write --data.data=local:x"),
    ("S --config pointmaze/skil.yaml", "no file pointmaze/skil.yaml: did you mean pointmaze/skill.yaml"),
    ("S --config pointmaze", "there is no file pointmaze: did you mean pointmaze/policy.yaml or pointmaze/skill.yaml?"),
    ("tasks zzz", "there is no task 'zzz': `dds tasks` lists them"),
    # values that do not fit
    ("S --model.trainable encoder,decoder", "expected all or some of encoder, codebook, decoder; several as [A,B]"),
    ("S --model.lr=fast", "model.lr is fast, expected a number"),
    ("S --model.encoder=transfomer", "did you mean transformer?"),
    ("S --model.lr_scale=1", "a mapping such as"),
    ("S --trainer.max_steps=3.5", "trainer.max_steps is 3.5, expected a whole number"),
    ("S --model.lr", "--model.lr"),
    ("R --until lunch", "until"),
    ("R --episodes 0", "--episodes is 0"),
    # seeds
    ("S --seed_everything=-1", "--seed_everything is -1, expected a whole number from 0"),
    ("S --seed_everything=20261128123456", "20261128123456"),
    ("S --data.seed=-1", "data.seed is -1"),
    ("R --policy.data.seed=-4", "policy: data.seed is -4, expected a whole number from 0"),
    ("R --seed=-1", "--seed is -1"),
    ("R --seed=20261128123456", "--seed is 20261128123456"),
    ("R --skill.seed_everything=-1", "--seed_everything is -1"),
    (f"data collect {TASK} --seed=-1", "--seed is -1"),
    ("evaluate nowhere --seed=-1", "--seed is -1"),
    # checkpoints
    ("S --ckpt_path=last", "there is no last.ckpt in runs/skill/logs"),
    ("S --ckpt_path=none.ckpt", "there is no checkpoint none.ckpt"),
    ("S --model.init_from=none.ckpt", "none.ckpt"),
    ("skill validate", "--ckpt_path is missing"),
    ("policy fit", "data.skill is missing"),
]
LATE = [
    ("--trainer.val_check_interval=5000", "val_check_interval"),
    ("--trainer.callbacks+=BaseFinetuning", "BaseFinetuning cannot be used as it is"),
]
"""What shows only when the training has begun."""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


def words_of(line, data):
    first, *rest = shlex.split(line)
    before = {"S": ["skill", "fit", *data, *QUIET, *SKILL, "--trainer.max_steps=3"], "R": ["run", TASK]}
    return [*before.get(first, [first]), *rest]


def test_there_are_sixty():
    assert len(LINES) >= 60


@pytest.mark.parametrize(("line", "part"), LINES, ids=[line for line, _ in LINES])
def test_a_wrong_line_is_one_sentence_status_2_and_no_file(dds, data, line, part):
    answer = dds(*words_of(line, data))
    assert (answer.status, answer.out) == (2, "")
    assert part in told(answer.err)
    assert list(Path().rglob("*")) == []


@pytest.mark.parametrize(("words", "part"), LATE)
def test_what_shows_only_in_training_is_one_sentence_too(dds, data, words, part):
    answer = dds(*words_of(f"S {words}", data))
    assert answer.status == 2
    assert part in told(answer.err)


def test_a_file_where_checkpoints_should_go_is_one_sentence(dds, data):
    Path("taken").touch()
    answer = dds(*words_of("S --checkpoint.dirpath=taken", data))
    assert answer.status == 2
    assert "checkpoint.dirpath is taken, but taken is a file: give a folder" in told(answer.err)


def test_slurm_variables_that_do_not_fit_are_one_sentence(dds, data, monkeypatch):
    monkeypatch.setenv("SLURM_NTASKS", "4")
    answer = dds(*words_of("S", data))
    assert answer.status == 2
    assert "--ntasks" in told(answer.err)


TYPOS = [
    ["skill", "fit", "--model.lrr=1"],
    ["skill", "fit", "--model.encoder=transfomer"],
    ["skill", "fit", "--data.task=pointmaze-larg-diverse"],
    ["skill", "fit", "--ckpt_path=runs/skil/last.ckpt"],
    ["skill", "fit", "--seed_everything=-1"],
    ["skill", "fit", "--best.monitor=val/los"],
    *(
        ["skill", "fit", *(f"--trainer.{one}" for one in line.split())]
        for line in (
            "strategy=dpp",
            "accelerator=gpuu",
            "profiler=simpel",
            "logger=WandbLoger",
            "callbacks+=EarlyStoping",
            "callbacks+=EarlyStopping callbacks.moniter=val/loss",
            "callbacks+=EarlyStopping callbacks.monitor=val/los",
            "callbacks+=EarlyStopping callbacks.monitor=val/loss callbacks.mode=maxx",
            "precision=16-mixd",
            "num_nodes=0",
        )
    ),
    ["run", TASK, "--policy.trainer.strategy=dpp"],
    ["run", TASK, "--policy.trianer.max_steps=3"],
    ["policy", "fti"],
    ["run", TASK, "--preset=pointmase"],
    ["run", "pointmaze-larg-diverse"],
    *(
        [command, "checkpoints/pointmaz-large", *more]
        for command, more in {"evaluate": [], "record": [], "export": [], "publish": ["shared/there"]}.items()
    ),
]


@pytest.mark.parametrize("words", [["skill", "fit", "--help"], ["skill", "fit", "--help", "trainer"], *TYPOS])
def test_help_and_typos_are_answered_at_once(words):
    """In a new process, three seconds of processor time; torch alone would take two more."""
    import resource
    import subprocess

    code = "import sys; from dds_lightning.cli import main; status = main(sys.argv[1:]);"
    code += "assert 'torch' not in sys.modules; sys.exit(status)"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    ran = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert ran.returncode == (0 if "--help" in words else 2), ran.stderr
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 3.0
