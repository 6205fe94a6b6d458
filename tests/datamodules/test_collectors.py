"""Which family has a collector, and how given data are told from changed ones."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from datamodules.collect.collectors import COLLECTORS, collect, collection_command, refuse_uncollectable
from datamodules.sources.stat_hash import locate, signature
from dds_lightning.errors import UserError
from dds_lightning.tasks import get_task, task_names


def test_each_family_has_a_collector_that_can_be_imported_or_says_where_data_come_from(monkeypatch):
    import importlib

    for module, *names in COLLECTORS.values():
        assert all(callable(getattr(importlib.import_module(module), name)) for name in names if name)
    monkeypatch.setattr("datamodules.collect.collectors.COLLECTORS", {})
    for name in task_names():
        with pytest.raises(UserError, match=rf"'{name}'.*d4rl:FILE.*minari:ID.*dds data fetch {name}"):
            refuse_uncollectable(get_task(name))


def test_collecting_goes_to_the_collector_of_the_family(monkeypatch):
    import datamodules.collect.pointmaze as module

    def collector(*given, **options):
        return given, options

    monkeypatch.setattr(module, "collect_pointmaze", collector)
    task = get_task("pointmaze-umaze-play")
    given, options = collect(task.name, 100, 3, "out", 2, dataset_id="mine")
    assert given == (task, 100, 3, "out", 2)
    assert options == {"dataset_id": "mine", "overwrite": False}


def test_a_recipe_says_what_the_behaviour_does(monkeypatch):
    import datamodules.collect.antmaze as ants
    import datamodules.collect.pointmaze as points

    monkeypatch.setattr(ants, "collect_antmaze", lambda *given, **options: options)
    options = collect("antmaze-umaze", 100, recipe={"action_noise": 0.1, "end_when_flipped": True})
    assert options["recipe"] == ants.AntMazeRecipe(action_noise=0.1, end_when_flipped=True)
    called = {}

    def collector(*given, speed=4.5, dataset_id=None, overwrite=False):
        called.update(speed=speed)

    monkeypatch.setattr(points, "collect_pointmaze", collector)
    collect("pointmaze-umaze-play", 100, recipe={"speed": 3})
    assert called == {"speed": 3}


@pytest.mark.parametrize(
    ("task", "recipe", "message"),
    [
        ("antmaze-umaze", {"noise": 0.1}, r"recipe.noise: 'antmaze-umaze' has no such setting; it has action_noise, "),
        ("antmaze-umaze", {"action_noise": -1}, "action_noise: found -1, expected"),
        ("hopper-medium", {"action_noise": "much"}, "recipe.action_noise: found 'much', expected a number"),
        ("pointmaze-umaze-play", {"overwrite": True}, "recipe.overwrite: .* has no such setting; it has episode_steps"),
    ],
)
def test_a_recipe_that_is_none_is_refused(task, recipe, message, tmp_path):
    with pytest.raises(UserError, match=message):
        collect(task, 100, out=tmp_path, recipe=recipe)
    assert list(tmp_path.iterdir()) == []


def test_a_signature_changes_with_names_sizes_and_times(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setenv("D4RL_DATASET_DIR", str(tmp_path / "d4rl"))
    file = tmp_path / "set" / "data.hdf5"
    file.parent.mkdir()
    file.write_bytes(b"abc")
    (tmp_path / "d4rl").mkdir()
    (tmp_path / "d4rl" / "one.hdf5").write_bytes(b"abc")
    specs = [f"local:{tmp_path}/set", "minari:set", f"d4rl:{file}", "d4rl:one.hdf5", f"arrays:{tmp_path}/set"]
    before = {spec: signature(spec) for spec in specs}
    assert before == {spec: signature(spec) for spec in specs}
    assert before["local:" + str(tmp_path / "set")] == before["minari:set"]
    os.utime(file, ns=(1, 1))
    changed = [spec for spec in specs if signature(spec) != before[spec]]
    assert changed == [spec for spec in specs if spec != "d4rl:one.hdf5"]
    assert locate("d4rl:one.hdf5") == tmp_path / "d4rl" / "one.hdf5"


@pytest.mark.parametrize(
    "spec", ["local:nowhere", "minari:nowhere", "d4rl:no/where.hdf5", "ftp:there", "local:", "d4rl:"]
)
def test_what_is_not_there_is_said_in_one_sentence(spec):
    with pytest.raises(UserError, match=r"nothing at|missing"):
        signature(spec)
    assert list(Path().iterdir()) == []


def test_a_collected_set_tells_the_command_that_makes_it_again(tmp_path):
    recipe = {"action_noise": 0.06}
    folder = collect("hopper-medium", 40, seed=3, out=tmp_path, workers=1, recipe=recipe)
    assert collection_command(folder) == (
        "dds data collect hopper-medium --steps=40 --seed=3 --recipe.action_noise=0.06"
    )
    point = collect("pointmaze-umaze-diverse", 40, out=tmp_path, workers=1, recipe={"speed": 3, "episode_steps": 20})
    assert collection_command(point) == (
        "dds data collect pointmaze-umaze-diverse --steps=40 --seed=0 --recipe.episode_steps=20 --recipe.speed=3"
    )
    (folder / "data" / "metadata.json").write_text('{"collection": {"task": "mine"}}')
    assert collection_command(folder) is None
    assert collection_command(tmp_path) is None
