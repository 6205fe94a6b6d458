"""Study files: what they span, and how a wrong one is answered."""

from dataclasses import replace

import pytest
import yaml

from dds_lightning.errors import UserError
from dds_lightning.grid.file import find_study, packaged_studies, read_study
from dds_lightning.grid.nodes import in_order, plan
from dds_lightning.training.stages import STAGES

TASK = "pointmaze-umaze-diverse"
TINY = {"title": "Tiny", "tasks": [TASK]}


def study(tmp_path, scale=1.0, **keys):
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump({**TINY, **keys}, sort_keys=False))
    return read_study(path, scale)


def nodes(found):
    cells = plan(found)
    return in_order(node for _, node in cells.values())


def kinds(found):
    made = [node.kind for node in nodes(found).values()]
    return {kind: made.count(kind) for kind in dict.fromkeys(made)}


def test_a_grid_is_every_combination_and_shares_what_can_be_shared(tmp_path):
    found = study(tmp_path, seeds=[0, 1], grid={"skill.model.num_skills": [4, 8], "policy.model.alpha": [1.0, 3.5]})
    assert len(list(found.cells())) == 8
    # One skill model and one relabelling serve both policies; one data set serves all.
    assert kinds(found) == {"data": 1, "skill": 4, "relabel": 4, "policy": 8, "evaluate": 8}


def test_ways_of_acting_share_all_trainings(tmp_path):
    found = study(tmp_path, variants={"noiseless": {"evaluate.noise_scale": 0}, "held": {"evaluate.hold": 5}})
    assert kinds(found) == {"data": 1, "skill": 1, "relabel": 1, "policy": 1, "evaluate": 3}


def test_a_setting_that_is_given_as_the_preset_has_it_changes_no_key(tmp_path):
    plain, given = study(tmp_path), study(tmp_path, settings={"skill.model.skill_dim": 64, "policy.model.lr": "1e-3"})
    assert list(plan(plain)) == list(plan(given))
    assert list(plan(plain)) != list(plan(study(tmp_path, settings={"skill.model.skill_dim": 32})))


def test_a_setting_that_came_later_changes_no_key_until_it_does_something(tmp_path):
    """What was trained before it existed is not trained again."""
    clone = next(node for node in nodes(study(tmp_path, methods=["clone"])).values() if node.kind == "clone")
    assert not [name for name in clone.settings if "fourier" in name]
    more = study(tmp_path, methods=["clone"], settings={"clone.model.fourier_features": 8})
    seen = next(node for node in nodes(more).values() if node.kind == "clone")
    assert seen.settings["model.fourier_features"] == 8


def test_a_method_that_came_to_train_otherwise_takes_no_earlier_result_for_its_own(tmp_path, monkeypatch):
    asked = study(tmp_path, methods=["iql", "clone"])
    before = nodes(asked)
    monkeypatch.setitem(STAGES, "clone", replace(STAGES["clone"], revision=1))
    after = nodes(asked)
    assert [before[key].kind for key in before.keys() - after.keys() if before[key].kind != "evaluate"] == ["clone"]
    assert len(before.keys() & after.keys()) == 3  # data, and the other method's two


def test_a_task_has_settings_of_its_own_and_a_variant_still_departs_from_them(tmp_path):
    found = study(
        tmp_path,
        tasks=[TASK, "hopper-medium-expert"],
        settings={"policy.trainer.max_steps": 10},
        task_settings={TASK: {"policy.trainer.max_steps": 20}},
        variants={"longer": {"policy.trainer.max_steps": 30}},
    )
    steps = {(cell.task, cell.place["variant"]): cell.settings["policy.trainer.max_steps"] for cell in found.cells()}
    runner = "hopper-medium-expert"
    assert steps == {(TASK, "base"): 20, (TASK, "longer"): 30, (runner, "base"): 10, (runner, "longer"): 30}


def test_scale_divides_every_budget(tmp_path):
    full, small = (
        {node.kind: node.settings for node in nodes(study(tmp_path, scale)).values()} for scale in (1.0, 0.01)
    )
    assert (full["data"]["steps"], small["data"]["steps"]) == (200_000, 2_000)
    assert (full["skill"]["trainer.max_steps"], small["skill"]["trainer.max_steps"]) == (1000, 10)
    assert (full["policy"]["trainer.max_steps"], small["policy"]["trainer.max_steps"]) == (8_000, 80)
    assert (full["evaluate"]["episodes"], small["evaluate"]["episodes"]) == (100, 2)
    runner = study(tmp_path, 0.01, tasks=["hopper-medium-expert"])
    (skill,) = (node.settings for node in nodes(runner).values() if node.kind == "skill")
    named = ("model.freeze_codes_after", "trainer.max_steps", "stop.decay")
    assert tuple(skill[name] for name in named) == (40, 280, 20)


@pytest.mark.parametrize("name", packaged_studies())
def test_packaged_studies_can_be_planned(name):
    found = read_study(find_study(name))
    assert found.budget
    assert found.seeds == (0, 1, 2)
    assert len(plan(found)) == len(list(found.cells()))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"methods": ["ddss"]}, r"methods: there is no method ddss: did you mean dds"),
        ({"tasks": ["pointmaze-umase-diverse"]}, "pointmaze-umase-diverse"),
        ({"tasks": []}, "tasks is missing or empty"),
        (
            {"task_settings": {"pointmaze-umaze": {"skill.model.lr": 1e-3}}},
            "pointmaze-umaze is not a task of this study: did",
        ),
        ({"task_settings": {TASK: 3}}, f"task_settings: {TASK} is 3, expected settings"),
        (
            {"task_settings": {TASK: {"skil.model.lr": 1}}},
            "skil.model.lr is not a setting: did you mean skill",
        ),
        (
            {"grid": {"skill.model.num_skills": []}},
            r"skill.model.num_skills is \[\], expected a list with at",
        ),
        ({"grid": {"skill.model.num_skills": [4, 8, 4]}}, "skill.model.num_skills lists 4 twice"),
        ({"seeds": [0, 0]}, "seeds lists 0 twice"),
        ({"seeds": [-1]}, "seeds is -1, expected a whole number from 0"),
        ({"seeds": [0.5]}, "seeds lists 0.5, expected whole numbers"),
        (
            {"grid": {"skill.model.num_skils": [4]}},
            r"--skill.model.num_skils is not an option of `dds skill fit`: did you mean --skill.model.num_skills or",
        ),
        ({"settings": {"skill.model.num_skills": "many"}}, "num_skills is many, expected a whole number"),
        ({"settings": {"skil.model.num_skills": 4}}, r"is not a setting: did you mean skill.model.num_skills"),
        ({"settings": {"clone.model.lr": 0.1}}, "clone.model.lr is a setting of clone, but the methods of this"),
        ({"settings": {"policy.data.skill": "x.ckpt"}}, "policy.data.skill is set by the study itself"),
        (
            {"settings": {"evaluate.noise": 0.5}},
            r"evaluate.noise is not a setting .*mean evaluate.noise_scale or",
        ),
        ({"settings": {"evaluate.selection": "best"}}, "evaluate.selection is 'best', expected greedy, sample"),
        ({"variants": {"same": {"skill.model.skill_dim": 64}}}, "two cells are the same, .* and '.*same"),
        (
            {"variants": {"one": {"policy.model.alpha": 7}, "other": {"policy.model.alpha": 7.0}}},
            "two cells are the same, '.*one.*' and '.*other",
        ),
        ({"variants": {"base": {"skill.model.skill_dim": 32}}}, "base is added without being named"),
        ({"gird": {}}, r"gird is not a setting of a study: did you mean grid\?"),
        ({"seeds": 3}, "seeds is 3, expected a list"),
        (
            {"columns": ["skill.model.num_skills"]},
            "columns names skill.model.num_skills, which the study does not have",
        ),
        ({"watch": -1}, "watch is -1, expected 0"),
        ({"settings": {"evaluate.episodes": 0}}, "evaluate.episodes is 0, expected a whole number of at least 1"),
        ({"settings": {"evaluate.hold": 5.0}}, r"evaluate.hold is 5\.0, expected a whole number"),
        ({"settings": {"evaluate.hold": 11}}, "evaluate.hold is 11, expected at most 10, the steps that skills last"),
        ({"settings": {"evaluate.temperature": 0}}, "evaluate.temperature is 0, expected a number above 0"),
        ({"settings": {"evaluate.noise_scale": float("inf")}}, "noise_scale is inf, expected a number of at least 0"),
        ({"methods": ["clone"], "settings": {"evaluate.hold": 5}}, "evaluate.hold is for agents over skills, .* BC "),
        ({"settings": {"data.steps": 0.5}}, r"data.steps is 0\.5, expected a whole number of at least 1"),
        ({"settings": {"data.seed": -1}}, "data.seed is -1, expected 0 to"),
        ({"settings": {"data.step": 5}}, "data.step is not a setting .*did you mean data.steps"),
        ({"data": "local:x", "settings": {"data.steps": 5}}, "data.steps is for data that are collected, and data is"),
        ({"budget": -1}, "budget is -1, expected core-minutes, more than 0"),
        ({"paper": "table4"}, "paper is table4, expected .*did you mean table"),
        ({"reference": "iql"}, "reference names iql, which the study does not have, expected some of dds"),
        ({"labels": {"K": "skills"}}, "labels names K, which the study does not have"),
        ({"rows": ["task"], "columns": ["task"]}, "rows and columns name task twice"),
        ({"tasks": [["a"]]}, r"tasks lists \['a'\], expected names"),
        ({"methods": [["dds"]]}, r"methods lists \['dds'\], expected names"),
        (
            {"grid": {"policy.model.alpha": [1, 2]}, "labels": {1: "x", 2: "x"}},
            "of policy.model.alpha, 1 and 2 are both called x",
        ),
        ({"variants": {"a": {"skill.model.skill_dim": 32}}, "labels": {"base": "a"}}, "base and a are both called a"),
        ({"settings": {"skill.model.num_skills": 1}}, "skill.model.num_skills is 1, expected at least 2"),
        ({"settings": {"policy.model.lr": -1e-3}}, r"policy.model.lr is -0\.001, expected positive"),
        ({"grid": {"skill.data.stride": [1, 0]}}, "skill.data.stride: got 0, expected at least 1"),
        ({"settings": {"policy.data.gamma": 2.0}}, r"policy.data.gamma is 2\.0, expected a discount in"),
        ({"methods": ["idql"], "settings": {"idql.model.lr": 0.0}}, r"idql.model.lr is 0\.0, expected positive"),
        ({"methods": ["iql"], "settings": {"iql.model.tau": 1.5}}, r"iql.model.tau is 1\.5, expected in \(0, 1\)"),
        ({"methods": ["dt"], "settings": {"dt.model.heads": 3}}, "dt.model.heads is 3, expected a divisor of hidden"),
        ({"methods": ["online"], "settings": {"online.model.critics": 0}}, "online.model.critics is 0, expected at l"),
        (
            {"methods": ["online"], "settings": {"online.data.updates": 0}},
            r"online.data.updates is 0\.0, expected positive",
        ),
        ({"methods": ["online"], "settings": {"online.data.stride": 0}}, "online.data.stride is 0, expected at least"),
        (
            {"methods": ["online"], "settings": {"online.data.actions": "raw", "online.model.follow": 1e-4}},
            r"online.model.follow is 0\.0001, expected 0: there are no skills",
        ),
        (
            {"methods": ["opal"], "settings": {"evaluate.selection": "argmax_q"}},
            "evaluate.selection is argmax_q, which needs codes, and the skills of OPAL are continuous",
        ),
    ],
)
def test_a_wrong_study_is_answered_in_one_sentence(tmp_path, keys, message):
    with pytest.raises(UserError, match=message) as told:
        plan(study(tmp_path, **keys))
    assert "\n" not in str(told.value)


def test_a_key_that_stands_twice_is_refused_with_its_line(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(TINY) + "grid:\n  skill.model.lr: [0.1]\n  skill.model.lr: [0.2]\n")
    with pytest.raises(UserError, match=r"skill\.model\.lr is given twice, the second time in line 6"):
        read_study(path)


def test_numbers_that_yaml_reads_as_text_are_numbers(tmp_path):
    found = study(tmp_path, settings={"data.steps": "2e5", "policy.model.lr": "1e-3"})
    assert found.settings == {"data.steps": 200_000, "policy.model.lr": 0.001}


def test_a_training_is_titled_by_what_it_depends_on(tmp_path):
    found = study(
        tmp_path,
        grid={"skill.model.num_skills": [4, 8], "policy.model.alpha": [1.0, 3.5]},
        variants={"held": {"evaluate.hold": 5}, "wide": {"policy.model.hidden_dims": [64, 64]}},
    )
    titles = {node.title for node in nodes(found).values() if node.kind in ("skill", "policy")}
    assert {title for title in titles if title.startswith("skill")} == {
        f"skill {TASK}, num_skills {count}, seed 0" for count in (4, 8)
    }
    assert f"policy {TASK}, DDS, num_skills 4, alpha 1, seed 0" in titles
    assert f"policy {TASK}, DDS, num_skills 8, alpha 3.5, variant wide, seed 0" in titles
    assert len(titles) == 2 + 8


@pytest.mark.parametrize("name", ["no/such/table2.yaml", "table2.yaml", "./table2"])
def test_a_file_that_is_not_there_is_never_taken_for_a_packaged_study(name):
    with pytest.raises(UserError, match=f"there is no file {name}, and the packaged studies are baselines, figure5"):
        find_study(name)


def test_wrong_scales_and_files_are_refused(tmp_path, dds):
    with pytest.raises(UserError, match=r"--scale is 0\.0, expected more than 0"):
        study(tmp_path, 0.0)
    answer = dds("study", "run", "tabel2")
    assert answer.status == 2
    assert "there is no file tabel2: did you mean table2 or table3?" in answer.err
    assert dds("study", "report", tmp_path).err.count("holds no study") == 1
