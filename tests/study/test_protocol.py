"""One line says how a score was measured, and which checkpoint it is of."""

import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from dds_lightning.agent import DDSAgent
from dds_lightning.callbacks.best import BestCheckpoint
from dds_lightning.callbacks.rollouts import RolloutEvaluation
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.skill import SkillModule
from dds_lightning.study.contestants import best_label, best_ways
from dds_lightning.study.protocol import best_facts, full_name, heading, paper_line, protocol, start_value
from dds_lightning.tasks import get_task

SMALL = {"hidden_dim": 8, "encoder_layers": 1, "encoder_heads": 2, "decoder_blocks": 1, "skill_dim": 4}


def agent(task, **settings):
    skill = SkillModule(task.observation_dim, task.action_dim, horizon=7, num_skills=2, **SMALL, **settings)
    return DDSAgent(skill, PolicyModule(task.observation_dim, 2, hidden_dims=[8]))


def test_the_line_names_everything_that_a_score_depends_on():
    task = get_task("hopper-medium")
    how = protocol(task, agent(task, noise_scale=0.5, sampler="ddim"), episodes=20, seed=4, temperature=0.7)
    assert heading(how) == (
        "hopper-medium@v4 (Hopper-v4): 20 episodes each, seed 4, last checkpoint, decoder noise 0.5 (ddim), "
        "temperature 0.7, a skill every 7 steps"
    )
    assert (how["score_min"], how["score_max"], how["paper_score"]) == (-20.272305, 3234.3, 84.7)
    assert how["best"] is None


def test_the_noise_of_the_agent_goes_before_that_of_its_skills_and_a_plain_decoder_has_none():
    task = get_task("kitchen-complete")
    quiet = agent(task).variant("random", noise_scale=0.0)
    assert "kitchen-complete (FrankaKitchen-v1)" in heading(protocol(task, quiet, episodes=1, seed=0))
    assert "decoder noise 0 (ddpm)" in heading(protocol(task, quiet, episodes=1, seed=0))
    plain = protocol(task, agent(task, decoder="mlp"), episodes=1, seed=0)
    assert plain["sampler"] is None
    assert "decoder without noise" in heading(plain)


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("antmaze-large-play", "antmaze-large-play@d4rl"),
        ("antmaze-large-play@robotics", "antmaze-large-play@robotics"),
        ("kitchen-mixed", "kitchen-mixed"),
    ],
)
def test_a_task_is_told_with_its_variant(name, full):
    assert full_name(get_task(name)) == full
    assert get_task(full).env_id == get_task(name).env_id


def test_the_papers_score_stands_with_whose_data_it_is_from():
    line = paper_line(get_task("antmaze-medium-play@robotics"))
    assert line.startswith("The paper reports 88.5")
    assert "D4RL's data" in line
    assert paper_line(get_task("kitchen-complete")) is None


@pytest.mark.parametrize(
    "key", [BestCheckpoint("rollout/score").state_key, "BestCheckpoint{'monitor': 'rollout/score'}"]
)
def test_how_the_best_was_chosen_is_read_from_its_files(tmp_path, key):
    history = [{"step": 5.0, "rollout/score": 10.0}, {"step": 10.0, "rollout/score": 30.0}, {"step": 15.0, "x": 1.0}]
    other = {ModelCheckpoint(monitor="x").state_key: {"monitor": "x", "best_model_score": 1.0}}
    kept = other | {key: {"monitor": "rollout/score", "best_model_score": 30.0}}
    played = {RolloutEvaluation("pointmaze-umaze-diverse").state_key: {"history": history}}
    best = {"state_dict": {}, "global_step": 10, "callbacks": kept}
    last = {"state_dict": {}, "global_step": 20, "callbacks": {**kept, **played}}
    for name, checkpoint in (("best", best), ("last", last)):
        torch.save(checkpoint, tmp_path / f"{name}.ckpt")
    facts = best_facts(tmp_path / "last.ckpt", tmp_path / "best.ckpt")
    torch.save({**last, "callbacks": played}, tmp_path / "other.ckpt")
    with pytest.raises(UserError, match="was not kept as a best checkpoint"):
        best_facts(tmp_path / "last.ckpt", tmp_path / "other.ckpt")
    assert facts == {"monitor": "rollout/score", "value": 30.0, "step": 10, "evaluations": 2}
    assert best_label(facts) == "best of 2 evaluations while training, step 10: optimistic"
    assert (
        best_label({**facts, "monitor": "val/q_loss", "evaluations": None}) == "best val/q_loss while training, step 10"
    )
    ways = best_ways(agent(get_task("hopper-medium")), 3, facts)
    assert [way.name.partition(" (")[0] for way in ways] == ["AWR policy, sampled", "AWR policy, greedy"]
    assert [way.actor.selection for way in ways] == ["sample", "greedy"]


def test_the_critics_promise_at_the_start_is_its_mean_over_the_episodes_starts():
    task = get_task("pointmaze-umaze-diverse")
    player = agent(task)
    player.policy.value_range.copy_(torch.tensor([-10.0, 0.0]))
    found = start_value(task, player, seed=2, episodes=3)
    env = task.make_env()
    from dds_lightning.rollout.schedule import episode_seed

    starts = np.stack([env.reset(seed=episode_seed(2, i))[0] for i in range(3)])
    env.close()
    expected = player.policy.v(torch.from_numpy(starts)).mean().item()
    assert found == {"mean": pytest.approx(expected), "low": -10.0, "high": 0.0}
    assert start_value(task, DDSAgent(player.skill, selection="random"), seed=2) is None
