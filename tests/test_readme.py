"""What README and its pages tell people to type exists: every command parses, the cheap ones run."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from datamodules import load_trajectories
from dds_lightning.cli import main
from dds_lightning.cli.parser import build_parser, prepare
from dds_lightning.training.stage_cli import settings_of

ROOT = Path(__file__).parents[1]
PAGES = {
    name: (ROOT / name).read_text()
    for name in ("README.md", "notebooks/training.md", "notebooks/my_data.md", "dds_lightning/baselines/README.md")
}
README = PAGES["README.md"]
TEXT = "\n".join(PAGES.values())
PYTHON = re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)
BLOCKS = re.findall(r"^```bash\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)
LINES = [line for block in BLOCKS for line in block.replace("\\\n", " ").splitlines() if line.strip()]
LINES = [line for line in LINES if not line.startswith("#")]
DDS = [shlex.split(line, comments=True)[1:] for line in LINES if line.startswith("dds ")]


def test_there_is_something_to_check():
    assert len(DDS) >= 5


def test_the_first_block_is_the_two_commands():
    assert BLOCKS[0].split("\n")[:2] == ["make demo", "make test"]


@pytest.mark.parametrize("words", [w for w in DDS if w[1:2] != ["fit"]], ids=" ".join)
def test_a_command_of_ours_parses(words):
    parser, _ = build_parser()
    parser.parse_args(prepare(words))


@pytest.mark.parametrize("words", [w for w in DDS if w[1:2] == ["fit"]], ids=" ".join)
def test_a_training_command_parses(words):
    settings = settings_of(words[0], words[1:])
    assert settings["data"]["task"] == "pointmaze-large-diverse"


@pytest.mark.parametrize("words", [w for w in DDS if w[0] in ("tasks", "--version")], ids=" ".join)
def test_a_cheap_command_runs(words, capsys):
    assert main(words) == 0
    assert capsys.readouterr().out


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("line", [line for line in LINES if line.startswith("make ")])
def test_a_make_target_exists(line):
    ran = subprocess.run(["make", "-n", *line.split()[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("page", PAGES)
def test_every_file_that_a_page_links_to_exists(page):
    links = re.findall(r"\]\((?!https?:|#)([^)]+)\)", PAGES[page])
    assert [link for link in links if not ((ROOT / page).parent / link.split("#")[0]).exists()] == []


def test_python_blocks_are_valid_python():
    for block in PYTHON:
        compile(block, "README.md", "exec")


def test_a_robot_of_ones_own_gets_from_arrays_to_a_score_as_shown(capsys):
    """The commands of the section, with a training of a few steps."""
    (block,) = [block for block in PYTHON if "from_episodes" in block]
    (text,) = re.findall(r"^```yaml\n# reacher.yaml\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
    Path("reacher.yaml").write_text(text)
    assert len(block.strip().splitlines()) <= 10
    exec(compile(block, "README.md", "exec"), {})
    data = load_trajectories("arrays:data/reacher", "reacher.yaml")
    assert (data.num_steps, data.num_episodes, data.observation_dim) == (2000, 40, 10)
    check, run, evaluate = (words for words in DDS if "reacher" in " ".join(words))
    assert main(check) == 0
    few = ["--clone_steps=3", "--episodes=1", "--episodes_per_skill=1", "--workers=0", "--evaluate_every=0"]
    few += [f"--{stage}.trainer.{name}" for stage in ("skill", "policy") for name in ("max_steps=3", "accelerator=cpu")]
    few += ["--skill.model.hidden_dim=16", "--skill.model.num_skills=2", "--policy.model.hidden_dims=[16]"]
    assert main([*run, *few]) == 0
    Path("reacher.yaml").unlink()  # the run keeps its task
    assert main([*evaluate[:-1], "1", "--workers=0"]) == 0
    assert main(["publish", "runs/reacher", "agent"]) == 0
    assert main(["evaluate", "agent", "--episodes=1", "--workers=0", "--json"]) == 0
    assert '"task": "reacher"' in capsys.readouterr().out


def test_a_checkpoint_is_fine_tuned_as_shown():
    """Both commands, with the presets of today and agents that were trained before them; a few steps on a few data."""
    assert main(["data", "collect", "pointmaze-large-diverse", "--steps=1000", "--workers=1", "--out=data"]) == 0
    Path("checkpoints").symlink_to(ROOT / "checkpoints")
    tuning = [words for words in DDS if "--model.init_from" in words]
    assert [words[0] for words in tuning] == ["skill", "policy"]
    for words in tuning:
        few = ["--trainer.max_steps=2", "--trainer.accelerator=cpu", "--trainer.limit_val_batches=1"]
        assert main([*words, *few, "--stop.when=steps" if words[0] == "skill" else "--trainer.logger=false"]) == 0
        assert Path("runs", f"{words[0]}-tuned", "last.ckpt").is_file()


def test_scripts_of_ones_own_train_as_shown():
    """The plain Trainer, with our data modules and with a loader of one's own; a few steps on a few data."""
    task = "pointmaze-large-diverse"
    assert main(["data", "collect", task, "--steps=1000", "--workers=1", "--out=data"]) == 0
    blocks = [block for block in PYTHON if "L.Trainer(" in block]
    assert len(blocks) == 2
    for block in blocks:
        code = re.sub(r"max_steps=[\d_]+", "max_steps=2, accelerator='cpu', logger=False, limit_val_batches=1", block)
        names: dict = {}
        exec(compile(code, "README.md", "exec"), names)
        assert bool(names["skill"].bottleneck.initted)
