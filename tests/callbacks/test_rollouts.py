"""Evaluating while training: the training stays the same to the bit, and the best checkpoint is found."""

from dataclasses import replace

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger

from datamodules.loader import TensorLoader
from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.resume import ExactResume
from dds_lightning.callbacks.rollouts import RolloutEvaluation
from dds_lightning.errors import UserError
from dds_lightning.policy import PolicyModule
from dds_lightning.rollout.actors import Contestant
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import get_task

TASK = replace(get_task("pointmaze-umaze-diverse"), max_episode_steps=25)
K, H = 3, 4


def tiny_skill():
    return SkillModule(
        4, 2, horizon=H, num_skills=K, skill_dim=4, hidden_dim=8, encoder_layers=1, encoder_heads=2, dropout=0.3
    )


class Segments(pl.LightningDataModule):
    """Random segments, and the statistics that the skill model asks for."""

    task = TASK

    def __init__(self):
        super().__init__()
        rng = torch.Generator().manual_seed(0)
        self.data = {
            "observations": torch.randn(48, H, 4, generator=rng),
            "actions": torch.rand(48, H, 2, generator=rng) * 2 - 1,
        }

    def statistics(self):
        return {
            "observation_mean": torch.zeros(4),
            "observation_std": torch.ones(4),
            "action_low": -torch.ones(2),
            "action_high": torch.ones(2),
        }

    def loader(self, shuffle):
        return TensorLoader(lambda i: {k: v[i] for k, v in self.data.items()}, 48, 8, shuffle=shuffle, seed=1)

    def train_dataloader(self):
        return self.loader(True)

    def val_dataloader(self):
        return self.loader(False)


class Transitions(Segments):
    """Random semi-MDP transitions under the skills of a model."""

    def __init__(self):
        super().__init__()
        rng = torch.Generator().manual_seed(0)
        self.skill = tiny_skill()
        self.skill.normaliser.fit(torch.zeros(4), torch.ones(4))
        self.skill.bottleneck.start_from(torch.randn(32, 4, generator=rng))
        self.data = {
            "observations": torch.randn(48, 4, generator=rng),
            "codes": torch.randint(K, (48,), generator=rng),
            "rewards": torch.rand(48, generator=rng),
            "next_observations": torch.randn(48, 4, generator=rng),
            "discounts": torch.full((48,), 0.9),
            "dones": torch.zeros(48),
        }

    def statistics(self):
        return {
            "observation_mean": torch.zeros(4),
            "observation_std": torch.ones(4),
            "code_share": torch.full((K,), 1 / K),
            "reward_range": (0.0, 1.0),
            "max_discount": 0.9,
        }


def fit(tmp_path, callbacks, module=tiny_skill, data=Segments, steps=12, ckpt=None, **settings):
    pl.seed_everything(0, verbose=False)
    model = module()
    settings = {"enable_checkpointing": any(isinstance(c, ModelCheckpoint) for c in callbacks), **settings}
    trainer = pl.Trainer(
        max_steps=steps, accelerator="cpu", logger=CSVLogger(tmp_path, ""), enable_progress_bar=False,
        enable_model_summary=False, default_root_dir=tmp_path, callbacks=callbacks, **settings,
    )  # fmt: skip
    trainer.fit(model, data(), ckpt_path=ckpt)
    return model, trainer


def evaluation(**settings):
    return RolloutEvaluation(**{"episodes": 3, "workers": 0, "slots": 4, **settings})


def same(one, other):
    return all(torch.equal(*pair) for pair in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


@pytest.mark.parametrize("settings", [{"every_n_steps": 5}, {"every_n_validations": 1}])
@pytest.mark.parametrize(
    ("module", "data"),
    [(tiny_skill, Segments), (lambda: PolicyModule(4, K, hidden_dims=[8], extraction="joint"), Transitions)],
    ids=["skill", "policy"],
)
def test_training_is_the_same_to_the_bit_with_and_without(tmp_path, module, data, settings):
    plain, _ = fit(tmp_path / "plain", [], module, data)
    callback = evaluation(**settings)
    watched, trainer = fit(tmp_path / "watched", [callback], module, data)
    assert [row["step"] for row in callback.history] == ([5, 10] if "every_n_steps" in settings else [6, 12])
    assert same(plain, watched)
    assert watched.training == plain.training
    for name in ("success", "score", "length"):
        assert f"rollout/{name}" in trainer.callback_metrics
    assert 0 <= callback.history[0]["rollout/success"] <= 100
    assert callback.history[0]["rollout/length"] == 25


def test_between_validations_the_average_plays_that_the_checkpoint_holds(tmp_path):
    """Its story: the training's own weights played, and `best.ckpt` kept averages that nobody had seen play."""
    played, held = [], []

    class Plays(RolloutEvaluation):
        def _play(self, trainer, pl_module):
            played.append({name: value.clone() for name, value in pl_module.state_dict().items()})
            return {"rollout/score": 0.0}

    class Saves(pl.Callback):
        def on_train_batch_end(self, trainer, pl_module, *_):
            if trainer.global_step in (5, 10):
                trainer.save_checkpoint(tmp_path / "now.ckpt")
                held.append(torch.load(tmp_path / "now.ckpt", weights_only=True))

    average = AverageWeights(0.9)
    watched, _ = fit(tmp_path / "watched", [Plays(task=TASK.name, every_n_steps=5), average, Saves()])
    plain, _ = fit(tmp_path / "plain", [AverageWeights(0.9)])
    assert same(watched, plain)
    assert len(played) == len(held) == 2
    for seen, checkpoint in zip(played, held, strict=True):
        assert all(torch.equal(value, checkpoint["state_dict"][name]) for name, value in seen.items())
        own = checkpoint["current_model_state"]["decoder.net.output.weight"]
        assert not torch.equal(seen["decoder.net.output.weight"], own)


def test_the_skill_stage_tells_of_random_and_single_skills(tmp_path):
    callback = evaluation(episodes_per_skill=2)
    fit(tmp_path, [callback], steps=6)
    assert set(callback.history[0]) >= {"rollout/success", "rollout/best_skill_success", "rollout/best_skill_score"}
    table = callback.last.episodes
    assert table["actor"].value_counts().to_dict() == {"random": 3, "best_skill": 2 * K}
    assert sorted(table["label"].unique()) == ["random", "skill 0", "skill 1", "skill 2"]


def test_a_task_without_success_logs_scores_alone(tmp_path):
    callback = evaluation(selections=["sample", "greedy"], every_n_steps=3)
    data = Transitions()
    data.task = replace(TASK, measures_success=False)
    fit(tmp_path, [callback], lambda: PolicyModule(4, K, hidden_dims=[8]), lambda: data, steps=3)
    ways = {f"rollout/{key}" for key in ("score", "length", "greedy/score", "greedy/length")}
    assert set(callback.history[0]) == {"step", *ways}
    skills = evaluation(every_n_steps=3)
    segments = Segments()
    segments.task = data.task
    fit(tmp_path, [skills], data=lambda: segments, steps=3)
    assert set(skills.history[0]) == {"step", "rollout/score", "rollout/length", "rollout/best_skill_score"}


def test_the_policy_stage_logs_every_way_and_the_data_modules_skill_stays_put(tmp_path):
    module = Transitions()
    before = {name: value.clone() for name, value in module.skill.state_dict().items()}
    module.skill.train()
    callback = evaluation(selections=["greedy", "sample", "argmax_q"], temperature=0.5)
    fit(tmp_path, [callback], lambda: PolicyModule(4, K, hidden_dims=[8]), lambda: module, steps=6)
    assert {"rollout/success", "rollout/sample/success", "rollout/argmax_q/score"} <= set(callback.history[0])
    assert module.skill.training
    assert all(torch.equal(value, module.skill.state_dict()[name]) for name, value in before.items())


class Better(RolloutEvaluation):
    """Plays an actor that reaches what the test says, evaluation after evaluation."""

    scores = (10.0, 90.0, 40.0, 60.0)

    def _play(self, trainer, pl_module):
        return {"rollout/success": self.scores[len(self.history)]}


@pytest.mark.parametrize("validates", [True, False])
def test_model_checkpoint_keeps_the_best(tmp_path, validates):
    settings = {} if validates else {"every_n_steps": 6}
    steps = {} if validates else {"every_n_train_steps": 6, "save_on_train_epoch_end": False}
    best = ModelCheckpoint(tmp_path, "{step}", monitor="rollout/success", mode="max", save_top_k=1, **steps)
    callback = Better(task=TASK.name, **settings)
    fit(tmp_path, [callback, best], steps=24, limit_val_batches=1.0 if validates else 0)
    assert [row["step"] for row in callback.history] == [6, 12, 18, 24]
    assert best.best_model_path.endswith("step=12.ckpt")
    assert float(best.best_model_score) == 90.0
    logged = (tmp_path / "version_0" / "metrics.csv").read_text()
    assert "rollout/success" in logged
    assert all(f"{score}" in logged for score in Better.scores)


def test_every_second_validation(tmp_path):
    callback = Better(task=TASK.name, every_n_validations=2)
    best = ModelCheckpoint(tmp_path, "{step}", monitor="rollout/success", mode="max", save_top_k=1)
    fit(tmp_path, [callback, best], steps=24)
    assert [row["step"] for row in callback.history] == [6, 18]
    assert best.best_model_path.endswith("step=18.ckpt")


def test_a_checkpoint_that_would_look_at_stale_values_is_refused(tmp_path):
    for wrong in ({}, {"every_n_train_steps": 4}):
        best = ModelCheckpoint(tmp_path, monitor="rollout/success", **wrong)
        with pytest.raises(UserError, match=r"new every 6 steps, but looks .*every_n_train_steps: 6"):
            fit(tmp_path, [evaluation(every_n_steps=6), best])


def test_a_resumed_run_evaluates_at_the_same_moments(tmp_path):
    straight = evaluation(every_n_steps=5)
    model, _ = fit(tmp_path, [straight, ExactResume()], steps=17)
    save = ModelCheckpoint(tmp_path, "{step}", every_n_train_steps=1, save_top_k=-1, save_on_train_epoch_end=False)
    fit(tmp_path, [evaluation(every_n_steps=5), ExactResume(), save], steps=10)
    for step in (9, 10):
        again = evaluation(every_n_steps=5)
        resumed, _ = fit(tmp_path, [again, ExactResume()], steps=17, ckpt=tmp_path / f"step={step}.ckpt")
        assert again.history == straight.history
        assert [row["step"] for row in again.history] == [5, 10, 15]
        assert same(resumed, model)


def test_environments_are_kept_between_evaluations_and_closed_at_the_end(tmp_path, monkeypatch):
    made = []
    import dds_lightning.callbacks.rollouts as module

    class Pool(module.EnvPool):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(module, "EnvPool", Pool)
    fit(tmp_path, [evaluation(every_n_steps=3)])
    assert len(made) == 1
    assert made[0].closed

    class Crash(pl.Callback):
        def on_train_batch_end(self, trainer, *_):
            if trainer.global_step == 7:
                raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fit(tmp_path, [evaluation(every_n_steps=3), Crash()])
    assert len(made) == 2
    assert made[1].closed


class Waiter:
    """Does nothing, and says so."""

    def reset(self, num_envs, seed=None):
        pass

    def act(self, observations, restarted, rows):
        return np.zeros((len(rows), 2), np.float32)


def test_other_modules_bring_their_own_contestants(tmp_path):
    class Other(pl.LightningModule):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(4, 1)

        def training_step(self, batch, batch_idx):
            return self.layer(batch["observations"]).square().mean()

        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), 0.1)

    with pytest.raises(UserError, match="not Other: override its `contestants`"):
        fit(tmp_path, [evaluation(every_n_steps=3)], Other, steps=3)

    class Mine(RolloutEvaluation):
        def contestants(self, trainer, pl_module):
            return [Contestant("waiter", Waiter(), 2)]

    callback = Mine(every_n_steps=3, workers=0)
    fit(tmp_path, [callback], Other, steps=3)
    assert callback.history == [{"step": 3.0, "rollout/success": 0.0, "rollout/score": 0.0, "rollout/length": 25.0}]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"every_n_steps": -1}, "every_n_steps is -1"),
        ({"every_n_validations": 0}, "every_n_validations is 0"),
        ({"selections": []}, "selections is empty"),
        ({"task": "pointmaze-huge"}, "no task 'pointmaze-huge'"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(UserError, match=message):
        RolloutEvaluation(**settings)
