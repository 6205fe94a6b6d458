"""Evaluate by rollouts while training, without changing the training by a bit."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback, ModelCheckpoint

from dds_lightning.agent import AgentSelection, DDSAgent
from dds_lightning.callbacks.average import AverageWeights
from dds_lightning.callbacks.resume import undisturbed
from dds_lightning.envs.pool import EnvPool
from dds_lightning.errors import UserError, refuse_seed
from dds_lightning.online.parts import RawActions
from dds_lightning.online.sac import SACModule
from dds_lightning.policy import PolicyModule
from dds_lightning.rollout.actors import Contestant, single_skills
from dds_lightning.rollout.play import rollout
from dds_lightning.rollout.result import RolloutResult
from dds_lightning.rollout.schedule import slots_needed
from dds_lightning.skill import SkillModule
from dds_lightning.tasks import Task, get_task


def _measured(success: bool) -> list[str]:
    return [*(["success"] if success else []), "score"]


class RolloutEvaluation(Callback):
    """Play episodes now and then, and log how they went.

    Logged for the first way of choosing skills: `rollout/score` (normalised, 0 to 100), `rollout/length` (steps)
    and, where the task measures it, `rollout/success` (per cent of the episodes); for each further way the
    same under `rollout/<selection>/`. While skills are trained the way is `random` skills, and
    `rollout/best_skill_score` and `rollout/best_skill_success` are those of the best single skill alone.

    The values are there before a `ModelCheckpoint` looks, so `monitor: rollout/score` keeps the best of any task
    (what was chosen by playing in the test environment is an optimistic figure: report the last as well).
    Evaluation happens in one of two places:

    | setting               | when                               | the checkpoint that keeps the best       |
    |-----------------------|------------------------------------|------------------------------------------|
    | `every_n_validations` | at the end of the validation epoch | `ModelCheckpoint` as it is               |
    | `every_n_steps`       | after the optimiser step; no       | `ModelCheckpoint` with                   |
    |                       | validation is needed               | `every_n_train_steps` a multiple of it   |

    Every evaluation starts from the same seeds. The agent has its own random stream, the global
    streams and every module's mode are restored, and the environments live in other processes: training ends
    with the same bits as without this callback.

    Args:
        task: Name of the task (`dds tasks`); null takes the data module's.
        episodes: Episodes for each way of choosing skills.
        every_n_steps: Optimiser steps between two evaluations; null evaluates at validations.
        every_n_validations: Validations between two evaluations, the first one included.
        selections: Ways of choosing skills while a policy is trained, the one to monitor first.
        temperature: Temperature of `sample`.
        noise_scale: Factor on the decoder's noise; null takes the skill model's setting.
        skill: Skill checkpoint for a policy; null takes the data module's.
        episodes_per_skill: Episodes of each single skill while skills are trained; 0 leaves them out.
        seed: Seed of environments and agent.
        slots: Number of environments.
        workers: Number of processes; null for one per core.

    Raises:
        UserError: A setting is outside its range, or a `ModelCheckpoint` would read stale values.
    """

    def __init__(
        self,
        task: str | None = None,
        episodes: int = 20,
        every_n_steps: int | None = None,
        every_n_validations: int = 1,
        selections: Sequence[AgentSelection] | AgentSelection = ("sample",),
        temperature: float = 1.0,
        noise_scale: float | None = None,
        skill: str | None = None,
        episodes_per_skill: int = 1,
        seed: int = 0,
        slots: int = 64,
        workers: int | None = None,
    ) -> None:
        """Check the settings; environments are created at the first evaluation."""
        for name, value, least in (
            ("episodes", episodes, 1),
            ("every_n_steps", 1 if every_n_steps is None else every_n_steps, 1),
            ("every_n_validations", every_n_validations, 1),
            ("episodes_per_skill", episodes_per_skill, 0),
            ("slots", slots, 1),
        ):
            if value < least:
                raise UserError(f"rollout evaluation: {name} is {value}, expected {least} or more")
        refuse_seed("rollout evaluation: seed", seed)
        if not selections:
            raise UserError("rollout evaluation: selections is empty, expected for example [sample]")
        self.task: Task | None = get_task(task) if task else None
        self.episodes, self.episodes_per_skill = episodes, episodes_per_skill
        self.every_n_steps, self.every_n_validations = every_n_steps, every_n_validations
        self.selections = (selections,) if isinstance(selections, str) else tuple(selections)
        self.temperature, self.noise_scale = temperature, noise_scale
        self.skill_path, self.seed, self.slots, self.workers = skill, seed, slots, workers
        self.history: list[dict[str, float]] = []
        self.last: RolloutResult | None = None
        self._validations = 0
        self._evaluated_step = 0
        self._pool: EnvPool | None = None
        self._skill: SkillModule | None = None

    def show(self, trainer: pl.Trainer, result: RolloutResult) -> None:
        """Show what was played; called on the first process after each evaluation, for a subclass to use."""

    # ---------------------------------------------------------------- when

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Find the task, and refuse checkpoints that would read the metric at other steps."""
        self.task = self.task or getattr(getattr(trainer, "datamodule", None), "task", None)
        if self.task is None:
            raise UserError("rollout evaluation: task is missing; give the name of a task (`dds tasks` lists them)")
        if stage != "fit" or self.every_n_steps is None:
            return
        for callback in trainer.checkpoint_callbacks:
            if not isinstance(callback, ModelCheckpoint) or not str(callback.monitor).startswith("rollout/"):
                continue
            every = getattr(callback, "_every_n_train_steps", 0)
            if every < 1 or every % self.every_n_steps:
                looks = f"every {every} steps" if every else "after validations"
                raise UserError(
                    f"ModelCheckpoint monitors {callback.monitor}, new every {self.every_n_steps} steps, but "
                    f"looks {looks}: give it every_n_train_steps: {self.every_n_steps}, or let the rollout "
                    "evaluation happen at validations (every_n_steps: null)"
                )

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Evaluate when `every_n_steps` optimiser steps have passed."""
        step = trainer.global_step
        if self.every_n_steps is None or step // self.every_n_steps == self._evaluated_step // self.every_n_steps:
            return
        averages = (one for one in trainer.callbacks if isinstance(one, AverageWeights))  # type: ignore[attr-defined]
        average = next(averages, None)  # what plays is what a checkpoint of this step holds
        with average.shown(trainer, pl_module) if average else nullcontext():
            values = self._evaluate(trainer, pl_module)
        pl_module.log_dict(values, on_step=True, on_epoch=False, logger=False)
        for logger in trainer.loggers:  # here, as Lightning would log only every log_every_n_steps
            logger.log_metrics(values, step=step)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate at every `every_n_validations`-th validation."""
        if self.every_n_steps is not None or trainer.sanity_checking:
            return
        if trainer.state.fn == "validate" or self._validations % self.every_n_validations == 0:
            pl_module.log_dict(self._evaluate(trainer, pl_module), rank_zero_only=False)
        self._validations += 1

    # ---------------------------------------------------------------- what

    def contestants(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> list[Contestant]:
        """Return who plays; override it to evaluate another module.

        The first contestant's values are logged as `rollout/score` and so on, those of further ones under their
        name.
        """
        if isinstance(pl_module, SkillModule):
            agent = DDSAgent(pl_module, None, "random", noise_scale=self.noise_scale)
            players = [Contestant("random", agent, self.episodes)]
            if self.episodes_per_skill and pl_module.discrete:
                players.append(single_skills(agent, self.episodes_per_skill, "best_skill"))
            return players
        if isinstance(pl_module, (PolicyModule, SACModule)):
            agents = [
                DDSAgent(self._skill_model(trainer, pl_module), pl_module, way, self.temperature, self.noise_scale)
                for way in self.selections
            ]
            return [Contestant(agent.selection, agent, self.episodes) for agent in agents]
        raise UserError(
            f"rollout evaluation knows SkillModule, PolicyModule and SACModule, not {type(pl_module).__name__}: "
            "override its `contestants`"
        )

    def _skill_model(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> Any:
        if isinstance(pl_module, SACModule) and pl_module.hparams.space == "raw":
            return RawActions(pl_module)
        if isinstance(pl_module, SACModule) and pl_module.follower is not None:
            return pl_module.follower.skill
        if self._skill is None:
            if self.skill_path is not None:
                self._skill = SkillModule.load(self.skill_path)
            else:
                skill = getattr(getattr(trainer, "datamodule", None), "skill", None)
                if not isinstance(skill, SkillModule):
                    raise UserError("rollout evaluation: skill is missing; give the skill checkpoint")
                self._skill = copy.deepcopy(skill)  # the data module keeps using its own
        return self._skill.to(pl_module.device)

    def _evaluate(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, float]:
        """Play on the first process, and send the values to all."""
        values: dict[str, float] = {}
        with undisturbed(pl_module):
            if trainer.is_global_zero:
                values = self._play(trainer, pl_module)
            values = trainer.strategy.broadcast(values)
        self._evaluated_step = trainer.global_step
        self.history.append({"step": float(trainer.global_step), **values})
        return values

    def _play(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, float]:
        assert self.task is not None, "setup comes first"
        players = self.contestants(trainer, pl_module)
        if self._pool is None or self._pool.closed:
            self._pool = EnvPool(self.task, slots_needed(players, self.slots), self.workers)
        result = rollout(self.task, players, seed=self.seed, slots=self.slots, progress=False, pool=self._pool)
        self.last = result
        self.show(trainer, result)
        measured = _measured(self.task.measures_success)
        values: dict[str, float] = {}
        for rank, row in enumerate(result.summary().to_dict("records")):
            name = str(row["actor"])
            if name == "best_skill":
                singles = RolloutResult(result.task, result.episodes[result.episodes["actor"] == name])
                alone = singles.summary("label")
                values |= {f"rollout/best_skill_{key}": float(alone[key].max()) for key in measured}
                continue
            prefix = "rollout" if rank == 0 else f"rollout/{name}"
            values |= {f"{prefix}/{key}": float(row[key]) for key in (*measured, "length")}
        return values

    @staticmethod
    def metrics(stage: str, selections: Sequence[str], measures_success: bool) -> set[str]:
        """Names of what may be logged while a stage trains, for settings that are checked before anything is made."""
        measured = _measured(measures_success)
        if stage == "skill":
            return {f"rollout/{key}" for key in (*measured, "length", *(f"best_skill_{key}" for key in measured))}
        prefixes = ["rollout", *(f"rollout/{way}" for way in selections[1:])]
        return {f"{prefix}/{key}" for prefix in prefixes for key in (*measured, "length")}

    # ---------------------------------------------------------------- state and end

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs to evaluate at the same steps, and the values so far."""
        return {"validations": self._validations, "step": self._evaluated_step, "history": list(self.history)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._validations, self._evaluated_step = state_dict["validations"], state_dict["step"]
        self.history = list(state_dict["history"])

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Close the environments."""
        self._close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Close the environments."""
        self._close()

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.close()
            self._pool = None
