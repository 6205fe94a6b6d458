"""Every packaged configuration parses against the real signatures, and the paper's hold its tables."""

from pathlib import Path

import pytest
import yaml

from dds_lightning.configs import (
    ROOT,
    RUN_DEFAULTS,
    find,
    known_as,
    packaged,
    resolve_configs,
    run_defaults,
)
from dds_lightning.errors import UserError
from dds_lightning.pipeline.settings import RunSettings
from dds_lightning.tasks import get_task, task_names
from dds_lightning.training.stage_cli import settings_of
from dds_lightning.training.stages import preset_configs, run_stages


def _flat(value, prefix=""):
    if isinstance(value, dict):
        return {k: v for key, item in value.items() for k, v in _flat(item, f"{prefix}{key}.").items()}
    return {prefix[:-1]: value}


@pytest.mark.parametrize("name", packaged())
def test_every_packaged_configuration_parses_and_nothing_in_it_is_lost(name):
    stage = name.split("/")[-1].removesuffix(".yaml")
    parsed = _flat(settings_of(stage, ["fit", "--config", name]))
    written = _flat(yaml.safe_load((ROOT / name).read_text()))
    assert {key: parsed[key] for key in written if not key.startswith("trainer.callbacks")} == {
        key: value for key, value in written.items() if not key.startswith("trainer.callbacks")
    }


def test_every_family_of_tasks_has_a_preset_and_so_has_the_paper():
    for family in {get_task(name).family for name in task_names()} | {"paper"}:
        found = preset_configs(family)
        assert {found[name].name for name in run_stages()} == {"skill.yaml", "policy.yaml", "clone.yaml", "online.yaml"}
        assert all(path is None or path.name == f"{name}.yaml" for name, path in found.items())


def test_the_papers_online_settings_are_table_6():
    """H, K and D are the skill model's; the rest is here."""
    settings = settings_of("online", ["fit", "--config", "paper/online.yaml"])
    model, data = settings["model"], settings["data"]
    expected = {"lr": 3e-4, "temperature": 0.1, "target_ema": 0.005, "hidden_dims": [256, 256], "critics": 2}
    assert {name: model[name] for name in expected} == expected
    assert (data["gamma"], data["batch_size"]) == (0.99, 256)


def test_the_papers_skill_settings_are_tables_4_to_6():
    settings = settings_of("skill", ["fit", "--config", "paper/skill.yaml"])
    model, data = settings["model"], settings["data"]
    table_4 = {"encoder_layers": 4, "encoder_heads": 8, "dropout": 0.1, "hidden_dim": 256}
    table_5 = {"diffusion_steps": 5, "beta_min": 0.1, "beta_max": 10.0, "time_dim": 16, "decoder_blocks": 4}
    table_6 = {"lr": 5e-5, "skill_dim": 128, "num_skills": 16, "commitment": 0.25}
    expected = {**table_4, **table_5, **table_6}
    assert {name: model[name] for name in expected} == expected
    assert (model["encoder"], model["decoder"], model["bottleneck"]) == ("transformer", "diffusion", "vq")
    assert (data["batch_size"], data["horizon"]) == (128, 10)
    assert settings["trainer"]["max_steps"] == 500_000


def test_the_papers_policy_settings_are_table_7():
    settings = settings_of("policy", ["fit", "--config", "paper/policy.yaml", "--data.skill", "none.ckpt"])
    model, data = settings["model"], settings["data"]
    expected = {"lr": 1e-4, "tau": 0.7, "target_ema": 0.005, "critic_steps": 1_000_000, "extraction": "after"}
    assert {name: model[name] for name in expected} == expected
    assert model["hidden_dims"] == [256, 256]
    assert (data["batch_size"], data["gamma"], data["discount"]) == (256, 0.99, "per_skill")
    assert settings["trainer"]["max_steps"] - model["critic_steps"] == 500_000


@pytest.mark.parametrize("stage", ["skill", "clone"])
def test_the_split_and_the_order_of_data_follow_the_seed_unless_they_have_their_own(stage):
    assert settings_of(stage, ["fit"])["data"]["seed"] == 0
    assert settings_of(stage, ["fit", "--seed_everything=5"])["data"]["seed"] == 5
    assert settings_of(stage, ["fit", "--seed_everything=5", "--data.seed=2"])["data"]["seed"] == 2


def test_a_packaged_name_is_found_with_and_without_its_ending():
    assert find("pointmaze/skill") == find("pointmaze/skill.yaml") == ROOT / "pointmaze" / "skill.yaml"


def test_a_file_of_the_users_goes_before_a_packaged_one(tmp_path):
    own = tmp_path / "pointmaze" / "skill.yaml"
    own.parent.mkdir()
    own.write_text("model: {}\n")
    assert find("pointmaze/skill.yaml").resolve() == own.resolve()


def test_both_spellings_of_the_option_are_resolved():
    path = str(ROOT / "paper" / "skill.yaml")
    assert resolve_configs(["fit", "--config", "paper/skill"]) == ["fit", "--config", path]
    assert resolve_configs(["fit", "--config=paper/skill"]) == ["fit", f"--config={path}"]
    assert resolve_configs(["fit", "-c", "paper/skill"]) == ["fit", "-c", path]


def test_an_unknown_configuration_or_preset_lists_the_packaged_ones(tmp_path):
    with pytest.raises(UserError, match=r"no file nope.yaml.*paper/skill.yaml"):
        find("nope.yaml")
    with pytest.raises(UserError, match=r"no folder nope.*paper, pointmaze"):
        preset_configs("nope")
    with pytest.raises(UserError, match=r"has no skill.yaml"):
        preset_configs(str(tmp_path))


def test_a_presets_run_fills_in_what_was_not_asked_for(tmp_path):
    for stage in run_stages():
        (tmp_path / f"{stage}.yaml").write_text(preset_configs("pointmaze")[stage].read_text())
    assert run_defaults(str(tmp_path)) == RUN_DEFAULTS
    (tmp_path / "run.yaml").write_text("data_steps: 1000\ntemperature: 1\nselection: greedy\n")
    wanted = RunSettings.with_preset("hopper-medium", Path("out"), str(tmp_path), selection=None, temperature=0.5)
    assert (wanted.data_steps, wanted.selection, wanted.temperature, wanted.clone_steps) == (
        1000,
        "greedy",
        0.5,
        16_000,
    )
    for family in ("antmaze", "kitchen", "locomotion", "paper", "pointmaze"):
        assert run_defaults(family)["data_steps"] >= 100_000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps: 3", "run.yaml sets steps, expected only data_steps, clone_steps, episodes_per_skill, selection"),
        ("data_steps: many", "run.yaml sets data_steps to 'many', expected a value like 200000"),
        ("- 3", "run.yaml is not a mapping"),
        ("selection: [greedy", "run.yaml is not valid YAML: while parsing a flow sequence"),
    ],
)
def test_a_presets_run_file_that_is_malformed_is_refused(tmp_path, text, message):
    (tmp_path / "run.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        run_defaults(str(tmp_path))


def test_a_run_tells_the_command_that_makes_it_again():
    plain = RunSettings.with_preset("hopper-medium", Path("out"))
    assert plain.command() == "dds run hopper-medium --seed=0"
    asked = RunSettings.with_preset(
        "hopper-medium",
        Path("out"),
        seed=3,
        data_steps=5000,
        noise_scale=0.25,
        stages={"policy": ("--model.alpha=10",)},
    )
    assert asked.command() == (
        "dds run hopper-medium --seed=3 --data_steps=5000 --noise_scale=0.25 --policy.model.alpha=10"
    )


def test_a_command_names_a_packaged_configuration_as_people_type_it():
    assert known_as(str(find("pointmaze/skill.yaml"))) == "pointmaze/skill.yaml"
    assert [known_as(word) for word in ("--config", "pointmaze/skill.yaml", "/elsewhere/skill.yaml")] == [
        "--config", "pointmaze/skill.yaml", "/elsewhere/skill.yaml"
    ]  # fmt: skip
