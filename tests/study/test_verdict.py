"""The verdict on spoilt runs: it names the stage that was spoilt, by the number that shows it."""

import re

import pytest

from dds_lightning.study.verdict import verdict

SCORES = {"agent": 50.0, "data_mean": 70.0, "data_best": 109.0, "single": 60.0, "clone": 40.0}
EVIDENCE = {
    "ends_early": 0.5,
    "terminates": 0.5,
    "codes_used": 16,
    "num_skills": 16,
    "beta_loss": 1.9,
    "share_loss": 2.7,
    "critic_rank": 0.7,
    "policy_shift": 0.3,
    "expected_fall": 0.08,
    "fidelity": 0.2,
    "fidelity_clone": 0.4,
}


@pytest.mark.parametrize(
    ("spoilt", "stage", "text"),
    [
        ({"terminates": 0.0}, "data", "Data: 50 % of the episodes end early, but none by a termination"),
        ({"way_share": 1.02}, "data", "Data: too slow to arrive. .* takes 102 % of the steps"),
        ({"codes_used": 4}, "skill", "Skills: only 4 of 16 codes are in use"),
        (
            {"overfit": 0.6, "lowest_step": 4000},
            "skill",
            "Skills: overfit. Held-out loss rose by 60 % since step 4,000 while .* Collect more data, or lower --skill",
        ),
        (
            {"beta_loss": 8.8, "critic_rank": 0.05},
            "policy",
            r"heart\. .* likely by it \(8.8 nats\) than by their plain shares \(2.7\)\. Raise --policy.model.dropout",
        ),
        ({"critic_rank": 0.05}, "policy", r"Critic: .* \(correlation 0.05, expected above 0.3\)"),
        ({"policy_shift": 0.0}, "policy", "the same as the data's .* raise --policy.model.alpha"),
        ({"policy_shift": 0.95}, "policy", "nearly always the critic's best .* lower --policy.model.alpha"),
        ({}, "skill", "Skills: the agent scores 50.0; 90 % of the data's best episode: 98.1. Not converged: held-out"),
    ],
)
def test_the_first_stage_that_does_not_do_its_work_is_named(spoilt, stage, text):
    found = verdict(SCORES, {**EVIDENCE, **spoilt})
    assert found.stage == stage
    assert re.search(text, found.text)


def test_what_reaches_the_data_needs_no_mending_whatever_else_was_measured():
    found = verdict({**SCORES, "agent": 100.0}, {**EVIDENCE, "codes_used": 4})
    assert found == (None, "Nothing to mend: the agent scores 100.0, the best episode of the data 109.0.")


def test_what_was_not_measured_is_not_asked():
    found = verdict({"agent": 10.0, "single": 30.0}, {})
    assert found.text == (
        "Skills: the agent scores 10.0; one skill alone: 30.0. Train them longer with --skill.trainer.max_steps."
    )
    assert verdict({"agent": 28.0, "single": 30.0}, {}).stage is None  # within chance
