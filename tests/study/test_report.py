"""A report is drawn from the run's files alone, and twice the same."""

import dataclasses
import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.interpret.draw import clip
from dds_lightning.policy import PolicyModule
from dds_lightning.rollout.result import RolloutPath, RolloutResult
from dds_lightning.skill import SkillModule
from dds_lightning.study import findings, skill_replays
from dds_lightning.study import report as report_module
from dds_lightning.study.report import report, summary_lines, write_report
from dds_lightning.study.skill_replays import junctions, replay_skills
from dds_lightning.tasks import get_task

TASK = get_task("pointmaze-umaze-diverse")
SKILLS = 2
HOW = {
    "task": TASK.name,
    "environment": TASK.env_id,
    "episodes": 4,
    "seed": 3,
    "checkpoint": "last",
    "noise_scale": 0.5,
}
HOW |= {"sampler": "ddim", "temperature": 1.0, "horizon": 5}
LINE = f"{TASK.name} ({TASK.env_id}): 4 episodes each, seed 3, last checkpoint, decoder noise 0.5 (ddim)"


def result() -> RolloutResult:
    """The policy fails one of four episodes in the start cell; each skill alone plays twice and fails."""
    rows, paths = [], {}
    random = np.random.default_rng(0)

    def play(actor, label, episode, success, code):
        length = 40 + episode
        end = TASK.goal_xy() if success else TASK.start_xy()
        line = np.linspace(TASK.start_xy(), end, length + 1) + 0.05 * random.standard_normal((length + 1, 2))
        codes = np.full(length, code, np.int16)
        rows.append(
            {
                "actor": actor,
                "label": label,
                "episode": episode,
                "seed": episode,
                "return": float(success),
                "score": 100.0 * success,
                "success": success,
                "terminated": success,
                "length": length,
                "final_x": float(end[0]),
                "final_y": float(end[1]),
                "final_code": code,
                "codes": [code] * (length // 10) if code >= 0 else [],
            }
        )
        paths[actor, episode] = RolloutPath(line.astype(np.float32), codes)

    for episode in range(4):
        play("AWR policy, sampled", "AWR policy, sampled", episode, episode != 2, episode % SKILLS)
    for episode in range(4):
        play("single skill", f"skill {episode % SKILLS}", episode, False, episode % SKILLS)
    for episode in range(4):
        play("behaviour cloning", "behaviour cloning", episode, False, -1)
    return RolloutResult(TASK.name, pd.DataFrame(rows), paths)


@pytest.fixture(scope="module", autouse=True)
def _small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_module, "DPI", 40)
        patch.setattr(clip, "write_clip", functools.partial(clip.write_clip, frames=6, fps=2))
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run directory as `dds run` leaves it, made without training."""
    root = tmp_path_factory.mktemp("report") / "run"
    result().save(root / "evaluate")
    torch.manual_seed(0)
    sizes = {"hidden_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 4}
    skill = SkillModule(4, 2, num_skills=SKILLS, horizon=5, **sizes)
    policy = PolicyModule(4, SKILLS, hidden_dims=[8])
    policy.support_mask.fill_(True)
    DDSAgent(skill, policy).save(root / "agent")
    (root / "relabel").mkdir()
    codes = {"code": [0, 1], "share": [0.75, 0.25], "dx": [0.5, -0.1], "dy": [0.0, 0.2], "distance": [0.6, 0.4]}
    codes["reward"] = [-1.0, -0.5]
    pd.DataFrame(codes).to_csv(root / "relabel" / "codes.csv", index=False)
    for launch, steps in enumerate(([0, 50, 100], [60, 110])):
        folder = root / "skill" / "logs" / f"version_{launch}"
        folder.mkdir(parents=True)
        frame = pd.DataFrame({"step": steps, "train/denoising": [10.0 * launch + s for s in steps]})
        frame["val/reconstruction_rmse"] = [0.5 / 2**i for i in range(len(steps))]
        frame.to_csv(folder / "metrics.csv", index=False)
    facts = {"protocol": HOW, "start_value": {"mean": -0.25, "low": -10.0, "high": 0.0}}
    marker = {"seconds": 65.0, "settings": {"seed": 3}, "facts": facts}
    (root / "evaluate" / "stage.json").write_text(json.dumps(marker))
    return root


@pytest.fixture(scope="module")
def made(run):
    """What the first report of `run` returned."""
    return write_report(run)


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_report_twice_is_the_same_to_the_byte_and_names_every_path(run, made, capsys):
    before = contents(run / "report")
    again = report(run)
    assert again.data == made
    assert contents(run / "report") == before
    assert not [name for name in before if name.startswith(".")]
    again.print(as_json=False)
    out = capsys.readouterr().out
    assert "AWR policy, sampled" in out
    assert "30.1 to 95.4" in out
    assert LINE in out
    assert f"({TASK.start_cell[0]}, {TASK.start_cell[1]})" in out
    assert all(f"{name}: {path}" in out for name, path in made.items() if name.endswith(("report", "clip")))
    again.print(as_json=True)
    assert json.loads(capsys.readouterr().out)["main"] == "AWR policy, sampled"


def test_every_file_of_a_maze_report_is_there_and_linked(run, made):
    text = made["report"].read_text()
    maze = {"trajectories", "clip", "failed_ends", "values"}
    pictures = maze | {"single_skills", "starts_by_skill", "skills_by_start", "training"}
    assert pictures <= made.keys()
    for name in pictures:
        assert made[name].stat().st_size > 1000
        assert f"]({made[name].name})" in text
    assert made["clip"].stat().st_size < 1_500_000
    assert "**75.0 %** of 4 episodes" in text
    assert "seed 3" in text
    assert LINE in text
    assert "| V at the start, in learning rewards | -0.25 (possible: -10 to 0) |" in text
    assert "| error of decoded actions (RMSE, held-out segments) | 0.25 |" in text
    assert "1 min 5 s" in text
    assert str(run) not in text
    assert {path.name for path in made.values() if isinstance(path, Path)} >= {
        "summary.csv",
        "failures.csv",
        "skills.csv",
    }


def test_facts_are_plain_json_and_say_where_the_main_contestant_failed(made):
    facts = {name: made[name] for name in ("task", "main", "protocol", "table", "failures", "diagnosis")}
    assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    row, column = TASK.start_cell
    assert facts["failures"] == [{"row": row, "column": column, "skill": 0, "episodes": 1, "share": 1.0}]
    assert [entry["success"] for entry in facts["table"]] == [75.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_facts_read_back_from_a_marker_are_told_alike(made):
    facts = {name: made[name] for name in ("task", "main", "protocol", "table", "failures")}
    assert len(summary_lines(json.loads(json.dumps(facts)))) == 3
    del facts["protocol"]  # a run of an older version
    assert summary_lines(facts)[0] == TASK.name


def test_what_a_killed_launch_logged_too_much_is_left_out(run, tmp_path):
    path = report_module._metrics(run, "skill", tmp_path)
    table = pd.read_csv(path)
    assert table["step"].tolist() == [0, 50, 60, 110]
    assert table["train/denoising"].tolist() == [0.0, 50.0, 70.0, 120.0]


def test_a_task_without_a_maze_has_tables_and_no_maze_figures(run, tmp_path, monkeypatch):
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("report"))
    plain_task = dataclasses.replace(TASK, maze_map=None, start_cell=None, goal_cell=None)
    monkeypatch.setattr(findings, "known_task", lambda name: plain_task)
    made = write_report(tmp_path / "run")
    assert made.keys() & {"trajectories", "clip", "values", "failed_ends"} == set()
    assert made["failures"][0]["row"] is None
    assert {"training", "scores"} <= made.keys()


def test_a_runner_is_reported_by_score_and_return(run, tmp_path):
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("report", "agent"))
    played = result()
    table = played.episodes.assign(success=pd.array([None] * 12, dtype="boolean"), final_x=np.nan, final_y=np.nan)
    RolloutResult("hopper-medium", table).save(tmp_path / "run" / "evaluate")
    pd.DataFrame({"code": [0, 1], "share": 0.5, "reward": [0.1, 2.0]}).to_csv(tmp_path / "run/relabel/codes.csv")
    (tmp_path / "run" / "data").mkdir()
    facts = {"facts": {"scores": {"mean": 45.0, "best": 98.0}}}
    (tmp_path / "run" / "data" / "stage.json").write_text(json.dumps(facts))
    made = report(tmp_path / "run")
    assert {"scores", "training"} <= made.data.keys()
    assert made.data.keys() & {"trajectories", "failures_table", "failed_ends", "clip", "values"} == set()
    assert made.data["failures"] == []
    assert all(row["success"] is None for row in made.data["table"])
    text = made.data["report"].read_text()
    assert "success" not in text
    assert "Where failed episodes ended" not in text
    assert "**AWR policy, sampled**: normalised score **75.0 ± 25.0** over 4 episodes, mean return 0.8" in text
    assert "The paper reports 84.7, measured with D4RL's data" in text
    assert [row["who"] for row in made.data["diagnosis"]["scores"]] == [
        "the data, mean episode",
        "the data, best episode",
        "behaviour cloning",
        "best single skill (all alike)",
        "AWR policy, sampled",
    ]
    assert any("The paper reports 84.7" in str(line) for line in made.text)


def test_without_paths_agent_or_logs_the_rest_is_still_told(tmp_path):
    dataclasses.replace(result(), paths={}).save(tmp_path / "evaluate")
    made = write_report(tmp_path)
    assert {"report", "summary", "failed_ends"} <= made.keys()
    assert made.keys() & {"trajectories", "values", "training"} == set()


def test_a_directory_without_an_evaluation_is_refused_and_left_alone(tmp_path):
    with pytest.raises(UserError, match="holds no evaluation"):
        write_report(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_replays_begin_in_their_cells_and_stay_in_the_maze(run):
    agent = DDSAgent.load(run / "agent")
    arrays = replay_skills(TASK, agent, steps=7)
    cells = junctions(TASK)
    assert cells[0] == TASK.start_cell
    assert set(cells) == set(TASK.free_cells()) - {TASK.goal_cell}
    assert arrays["positions"].shape == (6 * SKILLS, 8, 2)
    assert arrays["codes"].tolist() == [0] * 6 + [1] * 6
    np.testing.assert_array_equal(TASK.xy_to_cell(arrays["positions"][:, 0]), list(cells) * SKILLS)
    np.testing.assert_array_equal(arrays["starts"][:6], arrays["starts"][6:])  # one panel a cell
    np.testing.assert_array_equal(np.isnan(arrays["positions"][:, 1:, 0]), ~arrays["alive"])
    again = replay_skills(TASK, agent, steps=7)
    np.testing.assert_array_equal(arrays["positions"], again["positions"])


# ---------------------------------------------------------------- a stranger's run


@pytest.fixture
def other(run, tmp_path):
    """A copy of the run without its report."""
    shutil.copytree(run, tmp_path / "other", ignore=shutil.ignore_patterns("report"))
    return tmp_path / "other"


def episodes(**columns):
    """Writes the run's table with other columns; None leaves one out."""

    def change(path):
        table = pd.read_parquet(path)
        for name, value in columns.items():
            table = table.drop(columns=name) if value is None else table.assign(**{name: value})
        table.attrs = {"task": TASK.name}
        table.to_parquet(path)

    return change


def arrays(**changes):
    def change(path):
        with np.load(path) as stored:
            held = {**stored}
        for name, value in changes.items():
            held[name] = value(held[name])
        np.savez(path, **held)

    return change


def content(data):
    return lambda path: path.write_bytes(data)


def protocol(**changes):
    def change(path):
        marker = json.loads(path.read_text())
        marker["facts"]["protocol"] |= changes
        path.write_text(json.dumps(marker))

    return change


FOREIGN = {
    "a table that is none": ("evaluate/episodes.parquet", content(b"PAR1 and no more")),
    "an empty table": ("evaluate/episodes.parquet", content(b"")),
    "a table of something else": ("evaluate/episodes.parquet", lambda p: pd.DataFrame({"a": [1]}).to_parquet(p)),
    "no actor": ("evaluate/episodes.parquet", episodes(actor=None)),
    "actors that are numbers": ("evaluate/episodes.parquet", episodes(actor=3)),
    "actors that are missing": ("evaluate/episodes.parquet", episodes(actor=pd.Series([None] * 12, dtype="str"))),
    "lengths that are text": ("evaluate/episodes.parquet", episodes(length="long")),
    "negative lengths": ("evaluate/episodes.parquet", episodes(length=-5)),
    "a score of NaN": ("evaluate/episodes.parquet", episodes(score=float("nan"))),
    "codes that are numbers": ("evaluate/episodes.parquet", episodes(codes=3)),
    "codes of a billion": ("evaluate/episodes.parquet", episodes(codes=[[10**9]] * 12)),
    "a final code of a billion": ("evaluate/episodes.parquet", episodes(final_code=10**9)),
    "an episode twice": ("evaluate/episodes.parquet", episodes(episode=0)),
    "an end far away": ("evaluate/episodes.parquet", episodes(final_x=1e300)),
    "success of text": ("evaluate/episodes.parquet", episodes(success="yes")),
    "paths that are none": ("evaluate/paths.npz", content(b"PK\x03\x04")),
    "paths of nothing": ("evaluate/paths.npz", lambda p: np.savez(p, a=np.zeros(1))),
    "paths too short": ("evaluate/paths.npz", arrays(positions=lambda a: a[:-1])),
    "paths of three columns": ("evaluate/paths.npz", arrays(positions=lambda a: np.repeat(a, 2, axis=1))),
    "paths of text": ("evaluate/paths.npz", arrays(codes=lambda a: a.astype(str))),
    "codes that are none": ("relabel/codes.csv", content(b"\xff\xfe\x00")),
    "codes without a share": ("relabel/codes.csv", content(b"code\n0\n1\n")),
    "codes of markup": ("relabel/codes.csv", content(b"code,share,dx,dy,distance\n0,<script>,1,1,1\n")),
    "a code twice": ("relabel/codes.csv", content(b"code,share,dx,dy,distance\n0,1,1,1,1\n0,1,1,1,1\n")),
    "metrics that are none": ("skill/logs/version_0/metrics.csv", content(b"a,b\n1,x\n")),
    "a protocol of markup": ("evaluate/stage.json", protocol(episodes="<script>")),
    "a protocol without noise": ("evaluate/stage.json", protocol(noise_scale=None)),
    "a task that is a list": ("task.yaml", content(b"- 1\n")),
    "a task of tags": ("task.yaml", content(b"!!python/object/apply:os.mkdir [ran]")),
}


@pytest.mark.parametrize("case", FOREIGN)
def test_a_damaged_or_foreign_file_of_a_run_is_named_in_one_sentence(other, case):
    name, change = FOREIGN[case]
    change(other / name)

    def read():
        findings.Findings.read(other)
        report_module._metrics(other, "skill", other)

    with pytest.raises(UserError) as told:
        read()
    message = str(told.value)
    assert str(other / name) in message
    assert "\n" not in message
    assert len(message) < 600
    assert not Path("ran").exists()


MARKERS = [b"", b"{", b"[]", b"3", b'{"facts": 1}', b'{"settings": [1]}', b'{"state": 3}', b'{"seconds": "long"}']
MARKERS += [
    b'{"outputs": {"a": 1}}',
    b'{"outputs": {"a": "../../../etc/passwd"}}',
    b'{"outputs": {"a": "b"}, "files": {}}',
]


@pytest.mark.parametrize("data", MARKERS)
def test_a_damaged_marker_is_named_and_the_report_does_without_it(other, data):
    (other / "evaluate" / "stage.json").write_bytes(data)
    with pytest.warns(
        UserWarning, match=r"evaluate/stage\.json.*the stage counts as not done, and `dds run` does it again"
    ):
        assert findings.Findings.read(other).protocol is None


def test_names_of_a_strangers_table_are_names_and_nothing_else(other):
    table = pd.read_parquet(other / "evaluate" / "episodes.parquet")
    evil = "AWR <img src=x onerror=alert(1)>\x1b]0;owned\x07 ![](http://tracker) |"
    table["actor"] = table["actor"].replace("AWR policy, sampled", evil)
    table["label"] = table["label"].replace("AWR policy, sampled", evil)
    table.attrs = {"task": TASK.name}
    table.to_parquet(other / "evaluate" / "episodes.parquet")
    protocol(checkpoint="<script>\x1b[2J")(other / "evaluate" / "stage.json")
    made = write_report(other)
    text = made["report"].read_text(encoding="utf-8")
    assert "AWR img src" in text
    for written in (text, *(path.read_text(encoding="utf-8") for path in (other / "report").glob("*.csv"))):
        assert not re.search(r"[<\x1b\x07]|!\[\]\(http", written)
    assert "\x1b" not in repr(summary_lines(made)[0])


REPLAYS = {
    "none": content(b"PK"),
    "empty": content(b""),
    "codes out of range": arrays(codes=lambda a: a + 50),
    "other shapes": arrays(positions=lambda a: a[:, :-1]),
    "text": arrays(alive=lambda a: a.astype(str)),
}


@pytest.mark.parametrize("case", REPLAYS)
def test_damaged_replays_are_named_and_played_again(run, made, tmp_path, monkeypatch, case):
    path = tmp_path / "replays.npz"
    shutil.copy(run / "report" / "replays.npz", path)
    with np.load(path) as stored:
        sound = {name: stored[name] for name in ("starts", "positions", "codes", "alive")}
    REPLAYS[case](path)
    monkeypatch.setattr(skill_replays, "replay_skills", lambda task, agent: sound)
    with pytest.warns(UserWarning, match=r"replays\.npz is damaged.*the skills are played again"):
        again = skill_replays.stored_replays(path, TASK, run / "agent")
    assert again["codes"].tolist() == sound["codes"].tolist()
