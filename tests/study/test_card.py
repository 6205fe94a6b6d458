"""The card tells what a stranger must know before using an agent."""

import pandas as pd

from dds_lightning.study.card import agent_card
from dds_lightning.tasks import get_task


def test_the_card_names_task_score_seed_data_settings_and_command():
    episodes = pd.DataFrame(
        {
            "actor": ["AWR policy, sampled"] * 4 + ["random skills"] * 2,
            "label": ["AWR policy, sampled"] * 4 + ["random skills"] * 2,
            "episode": [0, 1, 2, 3, 0, 1],
            "success": [True, True, True, False, False, False],
            "score": [100.0, 100.0, 100.0, 0.0, 0.0, 0.0],
            "length": [300, 310, 320, 800, 800, 800],
        }
    )
    settings = {
        "skill": {
            "model": {"num_skills": 16, "skill_dim": 64},
            "trainer": {"max_steps": 2500},
            "data": {"batch_size": 128, "horizon": 10},
        },
        "policy": {"model": {"tau": 0.9}, "trainer": {"max_steps": 12000}, "data": {"batch_size": 256}},
    }
    card = agent_card(
        get_task("pointmaze-large-diverse"),
        episodes,
        seed=3,
        data={"source": "collected", "steps": 1000},
        settings=settings,
        command="dds run pointmaze-large-diverse --seed=3",
    )
    for text in (
        "AWR policy, sampled: 75.0 % of\n4 episodes",
        "95 % interval 30.1 to 95.4",
        "seed 3",
        "- steps: 1000",
        "skill: 2,500 steps, batches of 128; num_skills 16",
        "policy: 12,000 steps, batches of 256; tau 0.9",
        "`dds run pointmaze-large-diverse --seed=3`",
        "| random skills | 2 | 0.0 |",
        "a skill every 10 steps",
    ):
        assert text in card
