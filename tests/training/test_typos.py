"""What the early answer to a typo knows is what the libraries know, and what they take passes."""

import lightning.pytorch.callbacks
import lightning.pytorch.loggers
import lightning.pytorch.profilers
import lightning.pytorch.strategies
import pytest
from lightning.pytorch.accelerators import AcceleratorRegistry
from lightning.pytorch.strategies import StrategyRegistry

import dds_lightning.callbacks
from dds_lightning.errors import UserError
from dds_lightning.training.source import classes_in, parameters_of
from dds_lightning.training.stages import preset_configs
from dds_lightning.training.typos import WORDS, refuse_typos


def test_all_words_of_lightnings_registries_are_known():
    assert set(StrategyRegistry.available_strategies()) <= set(WORDS["trainer.strategy"])
    assert set(AcceleratorRegistry.available_accelerators()) <= set(WORDS["trainer.accelerator"])


def test_all_words_for_profilers_are_known():
    from lightning.pytorch import Trainer

    for word in WORDS["trainer.profiler"][:3]:
        Trainer(profiler=word, logger=False, enable_checkpointing=False, accelerator="cpu")
    with pytest.raises(Exception, match="can only be one of") as refused:
        Trainer(profiler="none such", logger=False, accelerator="cpu")
    assert all(f"'{word}'" in str(refused.value) for word in WORDS["trainer.profiler"])


@pytest.mark.parametrize(
    "room",
    [
        lightning.pytorch.callbacks,
        lightning.pytorch.loggers,
        lightning.pytorch.profilers,
        lightning.pytorch.strategies,
        dds_lightning.callbacks,
    ],
)
def test_the_classes_of_a_package_are_found_in_its_source(room):
    found = classes_in(room.__name__)
    offered = [name for name in getattr(room, "__all__", vars(room)) if isinstance(getattr(room, name), type)]
    assert set(offered) <= set(found)


def test_the_arguments_of_a_class_are_found_in_its_source():
    address = classes_in("lightning.pytorch.callbacks")["EarlyStopping"]
    assert {"monitor", "patience", "mode"} <= set(parameters_of(address))


@pytest.mark.parametrize(
    "words",
    [
        "--trainer.strategy=ddp_find_unused_parameters_true --trainer.accelerator=cpu",
        "--trainer.strategy=DDPStrategy --trainer.strategy.find_unused_parameters=true",
        "--trainer.strategy=lightning.pytorch.strategies.SingleDeviceStrategy",
        "--trainer.strategy=horovod",  # far from any name: Lightning says what it thinks of it
        "--trainer.profiler=simple",
        "--trainer.profiler=AdvancedProfiler --trainer.profiler.dirpath=x",
        "--trainer.logger=false",
        "--trainer.logger=CSVLogger --trainer.logger.save_dir=x",
        "--trainer.callbacks+=EarlyStopping --trainer.callbacks.monitor=val/loss --trainer.callbacks.mode=min",
        "--trainer.callbacks+=dds_lightning.callbacks.RolloutEvaluation --best.monitor=rollout/score",
        "--trainer.callbacks+=my_project.Watcher --best.monitor=my/metric",
        "--trainer.callbacks+=EarlyStopping --trainer.callbacks.monitor=x --trainer.callbacks.strict=false",
        "--trainer.max_steps=-2 --trainer.max_steps=5",
        "--seed_everything=true",
        "--data.task=my_project.tasks:reach",
        "--data.task=pointmaze-large-diverse?goal=1,1",
        "--model.init_from=hf:somebody/something",
        "--best.monitor=step",
        "--stop.monitor=my/metric",  # nothing stops by it
    ],
)
def test_what_may_be_right_passes(words):
    refuse_typos("skill", ["fit", *words.split()])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("model: {encoder: transfomer}", "did you mean transformer"),
        ("model: {num_skills: few}", "num_skills is few, expected a whole number"),
        ("trainer: {strategy: dpp}", "trainer.strategy is dpp"),
        ("data: {seed: -3}", "data.seed is -3"),
        ("best: {monitor: val/los}", "did you mean val/loss"),
        ("seed_everything: -1", "seed_everything is -1"),
    ],
)
def test_values_in_a_file_are_judged_too(tmp_path, text, told):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(UserError, match=told):
        refuse_typos("skill", ["fit", f"--config={tmp_path / 'mine.yaml'}"])


def test_a_file_with_callbacks_may_log_anything(tmp_path):
    (tmp_path / "mine.yaml").write_text("trainer: {callbacks: [{class_path: my.Watcher}]}\nbest: {monitor: my/metric}")
    refuse_typos("skill", ["fit", f"--config={tmp_path / 'mine.yaml'}"])


@pytest.mark.parametrize("preset", ["pointmaze", "locomotion", "antmaze", "kitchen", "default", "paper"])
def test_packaged_configurations_hold_no_typo(preset):
    for name, config in preset_configs(preset).items():
        refuse_typos(name, ["fit", *(["--config", str(config)] if config else [])])
