"""The metrics that each stage declares are those that its training logs."""

import json

import pytest

from dds_lightning.callbacks.rollouts import RolloutEvaluation
from dds_lightning.training.stages import STAGES
from tests.fits import POLICY, QUIET, SKILL, of_data, skill_of

WAYS = ["sample", "greedy"]
ROLLOUTS = {"episodes": 1, "every_n_steps": 3, "workers": 0, "selections": WAYS}
ROLLOUTS = {"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": ROLLOUTS}
USUAL = ["--trainer.log_every_n_steps=1", "--trainer.val_check_interval=1", "--trainer.max_steps=3", "--json"]
TRAININGS = {
    "skill": [[], ["--model.bottleneck=gaussian"]],
    "policy": [[*POLICY]],
    "clone": [["--model.hidden_dims=[8]"]],
    "online": [["--model.hidden_dims=[8]", "--data.random_steps=20", "--data.num_envs=2"]],
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def skill(data, tmp_path_factory):
    return skill_of(data, tmp_path_factory.mktemp("skill"), 2)


@pytest.mark.parametrize("stage", [name for name, stage in STAGES.items() if stage.metrics])
def test_what_a_training_logs_is_what_its_stage_declares(dds, data, skill, stage):
    words = [one for one in [*data, *QUIET] if stage != "online" or "validation_fraction" not in one]
    words += {"skill": SKILL, "clone": []}.get(stage, [f"--data.skill={skill}"])
    watched = stage in ("skill", "policy")
    words += [f"--trainer.callbacks+={json.dumps(ROLLOUTS)}"] if watched else []
    logged = set()
    for own in TRAININGS[stage]:
        answer = dds(stage, "fit", *words, *own, *USUAL)
        assert answer.status == 0, answer.err
        logged |= set(json.loads(answer.out)["metrics"])
    played = {name for name in logged if name.startswith("rollout/")}
    rare = (
        {"online/return", "online/success", "train/novelty_loss", "train/decoder_loss"} if stage == "online" else set()
    )
    declared = set(STAGES[stage].metrics)
    assert declared - rare <= logged - played <= declared
    assert played == (RolloutEvaluation.metrics(stage, WAYS, True) if watched else set())
