"""`dds evaluate` on a run that kept its best checkpoint beside the last."""

import pytest
import torch

from dds_lightning.agent import DDSAgent
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from dds_lightning.study.contestants import BEST_AGENT
from dds_lightning.study.evaluate import evaluate

TASK = "pointmaze-umaze-diverse"
FACTS = {"monitor": "rollout/score", "value": 1.0, "step": 3, "evaluations": 2}


@pytest.fixture(scope="module")
def agent():
    torch.manual_seed(0)
    sizes = {"hidden_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 4}
    return DDSAgent(SkillModule(4, 2, horizon=5, num_skills=2, **sizes), PolicyModule(4, 2, hidden_dims=[8]))


@pytest.mark.parametrize("noise", [0.5, 0.25])
def test_the_protocol_is_the_last_checkpoints_and_a_line_says_where_the_bests_differs(agent, tmp_path, noise):
    agent.variant(noise_scale=0.5).save(tmp_path / "agent", task=TASK)
    agent.variant(noise_scale=noise).save(tmp_path / BEST_AGENT, task=TASK, checkpoint=FACTS)
    report = evaluate(tmp_path, episodes=1, selection=["greedy"], workers=0)
    assert report.data["protocol"]["noise_scale"] == 0.5
    assert report.data["protocol"]["best"] == FACTS
    assert report.data["results"]["checkpoint"].tolist() == ["last", "best"]
    assert "last and best checkpoint, decoder noise 0.5 (ddpm)" in report.text[0]
    differing = [line for line in report.text[1:] if "decoder noise" in str(line)]
    assert len(differing) == (noise != 0.5)
    assert all("best checkpoint, decoder noise 0.25 (ddpm)" in line for line in differing)
