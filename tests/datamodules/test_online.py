"""Online training on the command line: the same bits after an interruption, half prior data, agents that act."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from datamodules.online import OnlineDataModule
from dds_lightning.agent import DDSAgent
from dds_lightning.errors import UserError
from dds_lightning.online.parts import checkpoint_parts
from dds_lightning.online.replay import Replay
from dds_lightning.online.sac import SACModule
from dds_lightning.skill import SkillModule
from tests.fits import TASK, of_data, skill_of, told

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
SPACES = ["discrete", "continuous", "raw"]
QUIET = ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false", "--trainer.accelerator=cpu"]
TINY = ["--data.batch_size=16", "--data.random_steps=60", "--data.num_envs=2", "--data.updates=0.1"]
TINY += ["--model.hidden_dims=[16]", "--trainer.log_every_n_steps=5", "--trainer.limit_val_batches=0"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return of_data(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def skills(data, tmp_path_factory):
    """Untrained, as good as any here: checkpoints of a discrete and a continuous skill model."""
    root = tmp_path_factory.mktemp("skills")
    gaussian = skill_of(data, root / "continuous", 1, "--model.bottleneck=gaussian")
    return {"discrete": skill_of(data, root / "discrete", 1), "continuous": gaussian}


def words(space, skills):
    return ["--data.actions=raw"] if space == "raw" else [f"--data.skill={skills[space]}"]


def fit(dds, space, skills, out, steps, *more, task=TASK):
    places = [f"--checkpoint.dirpath={out}", f"--trainer.default_root_dir={out}", f"--trainer.max_steps={steps}"]
    answer = dds("online", "fit", *QUIET, *TINY, f"--data.task={task}", *words(space, skills), *places, *more)
    assert answer.status == 0, answer.err
    return out / "last.ckpt"


def content(path):
    """Weights and everything that was collected."""
    checkpoint = torch.load(path, weights_only=True)
    (state,) = checkpoint["loops"]["fit_loop"]["state_dict"]["combined_loader"]
    return checkpoint["state_dict"], state["replay"]["rows"], state


@pytest.mark.parametrize("space", SPACES)
def test_a_training_that_was_stopped_goes_on_to_the_bit(dds, skills, tmp_path, space):
    through = fit(dds, space, skills, tmp_path / "through", 30)
    stopped = fit(dds, space, skills, tmp_path / "stopped", 13)
    resumed = fit(dds, space, skills, tmp_path / "stopped", 30, f"--ckpt_path={stopped}")
    (weights, rows, state), (other, other_rows, _) = content(through), content(resumed)
    assert all(torch.equal(value, other[name]) for name, value in weights.items())
    assert all(torch.equal(value, other_rows[name]) for name, value in rows.items())
    assert len(rows["rewards"]) == state["collector"]["decisions"]
    assert state["collector"]["steps"] >= 60 + 30 / 0.1


def test_a_decoder_that_follows_goes_on_to_the_bit_and_acts_in_the_agent(dds, data, skills, tmp_path):
    (spec,) = [word.partition("=")[2] for word in data if word.startswith("--data.data=")]
    more = ["--model.follow=1e-3", f"--data.data={spec}", f"--data.cache={tmp_path / 'relabel'}"]
    through = fit(dds, "discrete", skills, tmp_path / "through", 20, *more)
    stopped = fit(dds, "discrete", skills, tmp_path / "stopped", 9, *more)
    resumed = fit(dds, "discrete", skills, tmp_path / "stopped", 20, *more, f"--ckpt_path={stopped}")
    (weights, rows, _), (other, other_rows, _) = content(through), content(resumed)
    assert all(torch.equal(value, other[name]) for name, value in weights.items())
    assert all(torch.equal(value, other_rows[name]) for name, value in rows.items() if "step" not in name)
    assert (rows["steps"] >= 1).all()
    places = [f"--trainer.default_root_dir={tmp_path}", "--model.follow=1e-3", "--data.prior_share=1", *more[1:]]
    answer = dds("online", "fit", *QUIET, *TINY, f"--data.task={TASK}", *words("discrete", skills), *places)
    assert "data.prior_share 1.0 leaves no collected transition in a batch for the decoder" in told(answer.err)
    before, module = SkillModule.load(skills["discrete"]), SACModule.load(through)
    skill, _ = checkpoint_parts(str(skills["discrete"]), str(through))
    assert torch.equal(skill.bottleneck.vectors, before.bottleneck.vectors)
    assert skill.fingerprint() == module.skill_hash != before.fingerprint()
    assert "train/decoder_loss" in (tmp_path / "through" / "logs" / "version_0" / "metrics.csv").read_text()
    given = ["--skill", skills["discrete"], "--policy", through, "--task", TASK]
    published = dds("publish", "-", tmp_path / "agent", *given, "--json")
    assert published.status == 0, published.err
    assert DDSAgent.load(tmp_path / "agent").skill.fingerprint() == module.skill_hash


@pytest.mark.parametrize("space", ["continuous", "raw"])
def test_playing_while_training_changes_no_bit(dds, skills, tmp_path, space):
    settings = {"episodes": 1, "every_n_steps": 5, "workers": 0}
    watching = json.dumps({"class_path": "dds_lightning.callbacks.RolloutEvaluation", "init_args": settings})
    watched = fit(dds, space, skills, tmp_path / "watched", 10, f"--trainer.callbacks+={watching}")
    (weights, rows, _), (other, other_rows, _) = (
        content(watched),
        content(fit(dds, space, skills, tmp_path / "not", 10)),
    )
    assert all(torch.equal(value, other[name]) for name, value in weights.items())
    assert torch.equal(rows["rewards"], other_rows["rewards"])
    assert "rollout/success" in (tmp_path / "watched" / "logs" / "version_0" / "metrics.csv").read_text()


def test_everything_logged_is_there(dds, skills, tmp_path):
    fit(dds, "discrete", skills, tmp_path, 10)
    logged = (tmp_path / "logs" / "version_0" / "metrics.csv").read_text().splitlines()
    for name in ("online/env_steps", "online/episodes", "online/cells", "train/q_loss", "train/alpha", "train/entropy"):
        assert name in logged[0]


@pytest.mark.parametrize("space", SPACES)
def test_an_agent_of_every_space_is_published_and_evaluated(dds, skills, tmp_path, space):
    module = SACModule.load(fit(dds, space, skills, tmp_path / "fit", 5))
    place = tmp_path / "agent"
    given = [] if space == "raw" else ["--skill", skills[space]]
    published = dds("publish", "-", place, *given, "--policy", tmp_path / "fit" / "last.ckpt", "--task", TASK, "--json")
    assert published.status == 0, published.err
    assert published.json["golden"] == 0
    agent = DDSAgent.load(place, selection="greedy")
    x = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    agent.reset(3, seed=0)
    first = agent.act(x)
    expected = module.choose(torch.from_numpy(x), "greedy").detach().numpy()
    assert np.allclose(agent.codes, expected)
    assert first.shape == (3, 2)
    assert (np.abs(first) <= 1).all()
    if space == "raw":
        assert np.allclose(first, expected)
    else:
        agent.act(x + 1)
        assert np.allclose(agent.codes, expected)  # held for H steps
    played = dds("evaluate", place, "--episodes=2", "--workers=0", "--json")
    assert played.status == 0, played.err
    assert [row["episodes"] for row in played.json["results"]] == [2, 2]


def test_prior_data_are_half_of_every_batch(dds, data, skills, tmp_path):
    (spec,) = [word.partition("=")[2] for word in data if word.startswith("--data.data=")]
    settings = {"random_steps": 20, "num_envs": 1, "batch_size": 32, "cache": str(tmp_path)}
    module = OnlineDataModule(TASK, str(skills["discrete"]), data=spec, **settings)
    module.prepare_data()
    module.setup("fit")
    for number in range(50):
        row = {
            "observations": torch.full((4,), 100.0),
            "actions": number % 4,
            "rewards": 7.0,
            "discounts": 0.5,
            "dones": 0.0,
        }
        module.loader.replay.add(**row, next_observations=torch.zeros(4))
    batch = module.loader._batch()
    own = batch["observations"][:, 0] == 100
    assert own.tolist() == [True] * 16 + [False] * 16
    assert (batch["rewards"][own] == 7).all()
    assert batch["actions"].dtype == torch.int64
    where = (module.prior.observations == batch["observations"][-1]).all(dim=1)
    assert batch["rewards"][-1] in module.prior.rewards[where]
    module.teardown("fit")
    fit(dds, "discrete", skills, tmp_path / "fit", 5, f"--data.data={spec}", f"--data.cache={tmp_path}")


def test_a_full_replay_forgets_the_oldest():
    replay = Replay(3, 1, 0)
    for number in range(5):
        wide = torch.full((1,), float(number))
        replay.add(observations=wide, actions=number, rewards=0, next_observations=wide, discounts=1, dones=0)
    assert sorted(replay.columns["actions"].tolist()) == [2, 3, 4]
    other = Replay(3, 1, 0)
    other.load_state_dict(replay.state_dict())
    assert other.columns["actions"].tolist() == replay.columns["actions"].tolist()
    assert (other.next, len(other)) == (2, 3)
    with pytest.raises(UserError, match=r"data\.replay_size is 4, the checkpoint's replay has 3"):
        Replay(4, 1, 0).load_state_dict(replay.state_dict())
    with pytest.raises(UserError, match=r"has actions of \(\) .* it is of another task or another action space"):
        Replay(3, 1, 2).load_state_dict(replay.state_dict())


def test_a_damaged_replay_is_refused_with_what_is_wrong():
    def state():
        replay, wide = Replay(5, 1, 0, num_codes=4), torch.ones(1)
        for number in range(3):
            replay.add(observations=wide, actions=number, rewards=0, next_observations=wide, discounts=1, dones=0)
        return replay.state_dict()

    def refused(state, sentence):
        with pytest.raises(UserError, match=rf"the replay in the checkpoint is damaged \({sentence}"):
            Replay(5, 1, 0, num_codes=4).load_state_dict(state)

    Replay(5, 1, 0, num_codes=4).load_state_dict(state())
    rows = state()["rows"]
    refused({**state(), "rows": {n: c for n, c in rows.items() if n != "rewards"}}, "it lacks rewards")
    refused({**state(), "rows": {**rows, "dones": rows["dones"][:2]}}, "dones has 2 rows, rewards has 3")
    refused({**state(), "rows": {**rows, "rewards": rows["rewards"] + torch.nan}}, "rewards has numbers that are not")
    refused({**state(), "rows": {**rows, "actions": rows["actions"] + 2}}, "codes run from 2 to 4, expected 0 to 3")
    refused({**state(), "next": 10**9}, "its next row is 1000000000, with 3 of 5 rows")


def test_a_collection_of_other_environments_is_not_taken_up(skills):
    def loader(count):
        module = OnlineDataModule(TASK, str(skills["discrete"]), random_steps=20, num_envs=count)
        module.setup("fit")
        return module.loader

    state = loader(2).state_dict()
    with pytest.raises(UserError, match=r"data\.num_envs is 3, but the checkpoint has begun of 2 environments"):
        loader(3).load_state_dict(state)
    state["collector"]["visits"] = torch.zeros(2, 2, dtype=torch.int64)
    with pytest.raises(UserError, match=r"map of visits has \(2, 2\) cells, the task's maze \(5, 5\)"):
        loader(2).load_state_dict(state)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "data.skill is missing: give a skill checkpoint"),
        (["--data.actions=raw", "--data.updates=0"], "data.updates is 0.0, expected positive"),
        (["--data.actions=raw", "--data.random_steps=0"], "data.random_steps is 0, expected at least 1"),
        (["--data.actions=raw", "--data.data=local:x"], "data.data is local:x, but raw choices have no codes"),
        (["--data.actions=raw", "--data.reward_scale=auto"], "data.reward_scale is auto, expected a number or null"),
        (
            ["--data.skill={discrete}", "--data.task=hopper-medium"],
            r"pointmaze-umaze-diverse \(pointmaze\), but data.task is hopper-medium \(hopper\), another robot",
        ),
        (
            [f"--data.skill={CHECKPOINTS / 'walker2d-medium-expert'}", "--data.task=halfcheetah-medium"],
            r"\(walker2d\), but data.task is halfcheetah-medium \(halfcheetah\), another robot: give skills of that",
        ),
        (
            [
                *("--data.skill={discrete}", "--data.data=local:x"),
                *("--data.prior_rewards=unknown", "--data.prior_share=0.999"),
            ],
            "data.prior_rewards is unknown, expected known, or a smaller data.prior_share: rewards are learnt from",
        ),
        (
            ["--data.skill={discrete}", "--ckpt_path={discrete}", "--model.offline=b.ckpt"],
            "--ckpt_path is .*last.ckpt and --model.offline is b.ckpt: the first continues a training",
        ),
        (["--data.skill={discrete}", "--data.noise_scale=-1"], "data.noise_scale is -1.0, expected null or 0 or more"),
        (
            ["--data.skill={discrete}", "--trainer.accumulate_grad_batches=2", "--trainer.max_steps=1"],
            "trainer.accumulate_grad_batches is 2, expected 1: data.updates counts batches",
        ),
    ],
)
def test_bad_input_gets_one_sentence(dds, skills, tmp_path, arguments, sentence):
    given = [word.format(**skills) for word in arguments]
    answer = dds("online", "fit", *QUIET, f"--trainer.default_root_dir={tmp_path}", f"--data.task={TASK}", *given)
    assert answer.status == 2
    assert re.search(sentence, told(answer.err)), answer.err
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_of_another_task_or_other_skills_is_refused(dds, data, skills, tmp_path):
    checkpoint = fit(dds, "discrete", skills, tmp_path / "fit", 2)
    common = ["online", "fit", *QUIET, *TINY, f"--ckpt_path={checkpoint}", f"--trainer.default_root_dir={tmp_path}"]
    other = dds(*common, "--data.task=pointmaze-medium-diverse", f"--data.skill={skills['discrete']}")
    assert "--data.task is 'pointmaze-medium-diverse', but checkpoint" in told(other.err)
    seven = skill_of(data, tmp_path / "seven", 1, "--model.num_skills=7")
    more = dds(*common, f"--data.task={TASK}", f"--data.skill={seven}")
    assert "was trained with choices 4, the data have 7" in told(more.err)


def test_prior_data_stay_the_same_in_a_training_that_goes_on(dds, data, skills, tmp_path):
    (spec,) = [word.partition("=")[2] for word in data if word.startswith("--data.data=")]
    prior = [f"--data.data={spec}", f"--data.cache={tmp_path / 'relabel'}"]
    common = ["online", "fit", *QUIET, *TINY, f"--data.task={TASK}", f"--data.skill={skills['discrete']}"]
    common.append(f"--trainer.default_root_dir={tmp_path}")
    with_them = fit(dds, "discrete", skills, tmp_path / "with", 2, *prior)
    answer = dds(*common, f"--ckpt_path={with_them}")
    assert "data.data is not given, but the checkpoint's training had pointmaze" in told(answer.err)
    without = fit(dds, "discrete", skills, tmp_path / "without", 2)
    answer = dds(*common, *prior, f"--ckpt_path={without}")
    assert "but the checkpoint's training had none as prior data: give the same" in told(answer.err)


def test_an_agent_whose_decoder_followed_is_fine_tuned_with_its_own_skills(dds, skills, tmp_path):
    followed = fit(dds, "discrete", skills, tmp_path / "followed", 5, "--model.follow=1e-3")
    given = ["--skill", skills["discrete"], "--policy", followed, "--task", TASK]
    assert dds("publish", "-", tmp_path / "agent", *given).status == 0
    place, more = tmp_path / "agent", f"--model.init_from={tmp_path / 'agent'}"
    tuned = fit(dds, "discrete", {"discrete": place}, tmp_path / "tuned", 2, more)
    assert SACModule.load(tuned).skill_hash == SACModule.load(followed).skill_hash
    common = ["online", "fit", *QUIET, *TINY, f"--data.task={TASK}", f"--trainer.default_root_dir={tmp_path}"]
    answer = dds(*common, f"--data.skill={skills['discrete']}", more)
    assert "was trained on the codes of skill model" in told(answer.err)
    plain = fit(dds, "discrete", skills, tmp_path / "plain", 2)
    answer = dds(
        *common,
        f"--data.skill={skills['discrete']}",
        f"--model.init_from={plain}",
        "--model.follow=1e-3",
        "--trainer.max_steps=2",
        f"--checkpoint.dirpath={tmp_path / 'last'}",
    )
    assert answer.status == 0, answer.err
    assert "start anew" not in answer.err


def test_nothing_is_held_out_online(dds, skills, tmp_path):
    checkpoint = fit(dds, "raw", skills, tmp_path, 1)
    answer = dds("online", "validate", *QUIET, f"--data.task={TASK}", "--data.actions=raw", f"--ckpt_path={checkpoint}")
    assert "online training has no held-out data: measure the agent with `dds evaluate`" in told(answer.err)


def test_skills_of_an_agent_without_policy_are_drawn_from_their_prior(skills):
    agent = DDSAgent(SkillModule.load(skills["continuous"]), None, "random", seed=1)
    agent.reset(400)
    agent.act(np.zeros((400, 4), np.float32))
    assert abs(agent.codes.std() - 1) < 0.05
    with pytest.raises(UserError, match="selection is 'fixed', which needs codes, but the skills are continuous"):
        agent.variant("fixed", fixed_codes=[0])
    assert json.dumps(agent.golden())
