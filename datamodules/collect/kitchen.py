"""Kitchen data: a scripted arm does four subtasks an episode, in varying orders, with noise.

Every episode starts from the environment's own state and does four of the seven subtasks: in `kitchen-complete` always
the task's, in order; in `kitchen-partial` any, among them sometimes the task's; in `kitchen-mixed` any but the task's
four together. It ends (truncation) when they are done or given up, at the environment's time limit, or (termination)
when the environment says that all of the task's are done. Rewards are the environment's, 1 when a subtask of the task
is done for the first time. A set has at least the steps asked for: the last episode is complete.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from datamodules.collect.collecting import Collector, DataSetPlan
from datamodules.collect.kitchen_moves import SCRIPTS, KitchenController
from datamodules.collect.recording import Episode
from dds_lightning.envs.build import build_env
from dds_lightning.envs.kitchen import SUBTASKS, kitchen_layout
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

SEQUENCE_LENGTH = 4
"""Subtasks of an episode, as in the human demonstrations."""

ORDER = (
    ("microwave",),
    ("kettle",),
    ("bottom burner", "top burner"),
    ("light switch", "slide cabinet"),
    ("hinge cabinet",),
)
"""Earlier groups are done first, members of one group in any order. The open hinge cabinet would block the slide
cabinet's handle, so it comes last."""

AIMED_AT = frozenset({"kettle", "bottom burner", "light switch", "slide cabinet"})
"""With the microwave, the subtasks of `kitchen-partial` and `kitchen-mixed`."""

SHORTEST_EPISODE = 60
"""No four subtasks take fewer steps; bounds the number of episodes of a set."""


@dataclass(frozen=True)
class KitchenRecipe:
    """How the data are made.

    Attributes:
        action_noise: Standard deviation of the Gaussian noise on every action entry.
        waypoint_noise: Standard deviation (metres, each axis) of where the hand goes; half of it where it grasps,
            up to twice where it approaches.
        speed_noise: Each subtask is done up to this share slower or faster.
        aimed_share: Share of episodes that are meant to do the microwave and at least two more of the subtasks of
            `kitchen-partial` and `kitchen-mixed`. The others do any other four.
        tries: How often a subtask that fails is tried.
    """

    action_noise: float = 0.1
    waypoint_noise: float = 0.008
    speed_noise: float = 0.15
    aimed_share: float = 0.7
    tries: int = 3

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if not 0.0 <= self.action_noise < math.inf:
            raise UserError(f"action_noise: got {self.action_noise}, expected a number of at least 0")
        if not 0.0 <= self.waypoint_noise <= 0.1:
            raise UserError(f"waypoint_noise: got {self.waypoint_noise}, expected 0 to 0.1 metres")
        for name in ("speed_noise", "aimed_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UserError(f"{name}: got {getattr(self, name)}, expected 0 to 1")
        if self.tries < 1:
            raise UserError(f"tries: got {self.tries}, expected at least 1")


QUIET = KitchenRecipe(action_noise=0.0, waypoint_noise=0.0, speed_noise=0.0)
"""The behaviour at its best."""


def _plan(task: Task, seed: int, steps: int, recipe: KitchenRecipe) -> DataSetPlan:
    recorder = _Recorder(task, seed, steps, recipe)
    env, _ = recorder.kitchen()
    return DataSetPlan(
        recorder,
        env,
        algorithm="scripted moves of the hand, damped least-squares inverse kinematics",
        description=_description(task, seed, recipe),
        settings={"moves": hashlib.sha256(repr(SCRIPTS).encode()).hexdigest()[:16]},
        trim=lambda episodes: _until(episodes, steps),
    )


def _until(episodes: Iterable[Episode], steps: int) -> Iterator[Episode]:
    """Complete episodes until they have `steps` steps in all; what was recorded beyond that is dropped."""
    for episode in episodes:
        yield episode
        steps -= len(episode["rewards"])
        if steps <= 0:
            return


def draw_subtasks(task: Task, rng: np.random.Generator, aimed_share: float) -> tuple[str, ...]:
    """What an episode does, in order.

    Args:
        task: Of the kitchen.
        rng: Draws.
        aimed_share: As in `KitchenRecipe`.

    Returns:
        `SEQUENCE_LENGTH` names.
    """
    if task.base_name == "kitchen-complete":
        return tuple(task.subtasks)
    aimed = rng.random() < aimed_share
    choices = [
        set(chosen)
        for chosen in itertools.combinations(SUBTASKS, SEQUENCE_LENGTH)
        if ("microwave" in chosen and len(AIMED_AT.intersection(chosen)) >= 2) == aimed
        and not (task.base_name == "kitchen-mixed" and set(chosen) == set(task.subtasks))
    ]
    chosen = choices[int(rng.integers(len(choices)))]
    return tuple(group[i] for group in ORDER for i in rng.permutation(len(group)) if group[i] in chosen)


class _Recorder:
    """Records round i of a data set, one episode, which depends on (seed, i) alone."""

    def __init__(self, task: Task, seed: int, steps: int, recipe: KitchenRecipe) -> None:
        self.task, self.seed, self.steps, self.recipe = task, seed, steps, recipe
        self.rounds = -(-steps // SHORTEST_EPISODE)
        self._kitchen: tuple[gym.Env[Any, Any], KitchenController] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kitchen": None}  # each process makes its own

    def kitchen(self) -> tuple[gym.Env[Any, Any], KitchenController]:
        if self._kitchen is None:
            task = self.task
            env = build_env(task.env_id, max_episode_steps=task.max_episode_steps, **task.env_options)
            self._kitchen = env, _controller(env, task, self.recipe.tries)
        return self._kitchen

    def __call__(self, number: int) -> list[Episode]:
        (env, controller), recipe = self.kitchen(), self.recipe
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        seen, info = env.reset(seed=int(rng.integers(2**31)))
        _start(controller, self.task, rng, recipe)
        rows = [_row(seen, info, controller)]
        actions, rewards = [], []
        ends: list[tuple[bool, bool]] = []
        while not (ends and any(ends[-1])):
            action = controller.act(kitchen_layout(seen["observation"]))
            if action is None:
                ends[-1] = (False, True)  # nothing left to do
                break
            noisy = action + recipe.action_noise * rng.standard_normal(len(action))
            actions.append(np.clip(noisy, -1.0, 1.0).astype(np.float32))
            seen, reward, terminated, truncated, info = env.step(actions[-1])
            rewards.append(reward)
            ends.append((terminated, truncated))
            rows.append(_row(seen, info, controller))
        terminations, truncations = np.array(ends, bool).T
        return [
            {
                "observations": _stacked([row[0] for row in rows]),
                "actions": np.array(actions),
                "rewards": np.array(rewards),
                "terminations": terminations,
                "truncations": truncations,
                "infos": {
                    "subtasks_done": np.array([row[1] for row in rows]),
                    "subtask": np.array([row[2] for row in rows]),
                },
            }
        ]


def _row(seen: Any, info: dict[str, Any], controller: KitchenController) -> tuple[Any, int, int]:
    doing = list(SUBTASKS).index(controller.subtask) if controller.subtask else -1
    return seen, len(info["episode_task_completions"]), doing


def _stacked(rows: list[Any]) -> Any:
    """Arrays of observations, in the same nested dictionaries as single observations."""
    if isinstance(rows[0], dict):
        return {key: _stacked([row[key] for row in rows]) for key in rows[0]}
    return np.array(rows)


def _controller(env: gym.Env[Any, Any], task: Task, tries: int) -> KitchenController:
    inner: Any = env.unwrapped
    return KitchenController(inner.model, task.step_seconds, tries=tries)


def _start(controller: KitchenController, task: Task, rng: np.random.Generator, recipe: KitchenRecipe) -> None:
    controller.start(
        draw_subtasks(task, rng, recipe.aimed_share),
        rng,
        waypoint_noise=recipe.waypoint_noise,
        speed_noise=recipe.speed_noise,
    )


def _description(task: Task, seed: int, recipe: KitchenRecipe) -> str:
    return (
        f"A scripted Franka arm does four subtasks an episode in {task.env_id}; rewards count those of {task.name}. "
        f"Moves of the hand relative to handles, inverse kinematics, action noise {recipe.action_noise}, waypoints "
        f"off by {recipe.waypoint_noise} m, speeds by {recipe.speed_noise:.0%}. infos/subtask is what the arm tries "
        f"({', '.join(f'{i} {name}' for i, name in enumerate(SUBTASKS))}, -1 nothing). Seed {seed}."
    )


class KitchenDemonstrator:
    """The behaviour as an actor: does the task's subtasks in every kitchen of a batch."""

    def __init__(self, task: Task | str, recipe: KitchenRecipe | None = None) -> None:
        """Prepare for `task`.

        Args:
            task: A kitchen task or its name.
            recipe: None is the behaviour at its best, doing the task's subtasks in order; `KitchenRecipe()` is
                the data's behaviour, with its noise and its choice of subtasks.
        """
        self.task, self.recipe = get_task(task), recipe
        self._env = build_env(self.task.env_id)
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Prepare for new episodes in `num_envs` environments; `seed` fixes the noise."""
        self._rng = np.random.default_rng(seed)
        # How much a controller draws depends on its progress: a stream for each keeps the others' draws in place.
        self._rngs = self._rng.spawn(num_envs)
        tries = (self.recipe or QUIET).tries
        self._controllers = [_controller(self._env, self.task, tries) for _ in range(num_envs)]
        for row in range(num_envs):
            self._restart(row)

    def _restart(self, row: int) -> None:
        if self.recipe is None:
            self._controllers[row].start(tuple(self.task.subtasks))
        else:
            _start(self._controllers[row], self.task, self._rngs[row], self.recipe)

    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """As `Actor.act`.

        Args:
            observations: (n, 60).
            restarted: (n,) True where an episode has just begun; None means nowhere.
            rows: (n,) their environments; None means all of them.

        Returns:
            (n, 9) in the box.
        """
        every = len(self._controllers)
        rows = np.arange(every) if rows is None else rows
        actions = np.empty((len(rows), self.task.action_dim))
        for i, (row, observation) in enumerate(zip(rows.tolist(), observations, strict=True)):
            if restarted is not None and restarted[i]:
                self._restart(row)
            action = self._controllers[row].act(observation[:30])
            actions[i] = self._controllers[row].rest() if action is None else action
        noise = (self.recipe or QUIET).action_noise * self._rng.standard_normal((every, actions.shape[1]))[rows]
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)


COLLECTOR = Collector("kitchen", None, 137_000, KitchenRecipe, _plan, KitchenDemonstrator)
collect_kitchen = COLLECTOR.collect
