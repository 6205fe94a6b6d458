"""Collects transitions in a few environments at once, and knows how the episodes went."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dds_lightning.errors import UserError
from dds_lightning.online.replay import Replay
from dds_lightning.online.skill_env import SkillEnv, decode

Choose = Callable[[NDArray[np.float32], torch.Generator], NDArray[Any]]
"""Observations (E, O) to codes (E,) or numbers (E, D)."""
LATEST = 20
"""Episodes behind a running mean."""


class Collector:
    """Plays decisions in E environments side by side: their skills share one decoder batch.

    Episode i of environment e starts from a seed of its own, so that a training that continues goes on with the same
    episodes.

    Args:
        envs: The environments, on one skill model.
        seed: Seed of episodes, choices and the decoder's noise.
        cell_of: Position (n, 2) to rows and columns of a map (n, 2); None where nothing is mapped.
        cells: Rows and columns of the map.
    """

    def __init__(
        self,
        envs: Sequence[SkillEnv],
        seed: int,
        cell_of: Callable[[NDArray[Any]], NDArray[np.int64]] | None = None,
        cells: tuple[int, int] = (0, 0),
    ) -> None:
        self.envs, self.seed, self.cell_of = list(envs), seed, cell_of
        self.generator = torch.Generator().manual_seed(seed)
        self.steps = self.decisions = 0
        self.begun = [0] * len(self.envs)  # episodes
        self.returns = [0.0] * len(self.envs)  # of the episodes in progress
        self.success = [False] * len(self.envs)
        self.finished: deque[tuple[float, float, float]] = deque(maxlen=LATEST)  # return, success, step
        self.visits = np.zeros(cells, np.int64)
        self._started = False

    def collect(self, replay: Replay, choose: Choose) -> None:
        """Let every environment make one decision, and write the transitions."""
        if not self._started:
            self._started = True
            for number in range(len(self.envs)):
                self._begin(number)
        before = np.stack([env.observation for env in self.envs]).astype(np.float32)
        chosen = choose(before, self.generator)
        for env, action in zip(self.envs, chosen, strict=True):
            env.begin(action)
        seen: list[list[Any]] = [[] for _ in self.envs]  # (h, O) what was seen in each step
        done: list[list[Any]] = [[] for _ in self.envs]  # (h, A) what was done in it
        while numbers := [number for number, env in enumerate(self.envs) if not env.over]:
            playing = [self.envs[number] for number in numbers]
            skill = playing[0].skill
            acts = decode(skill, playing, self.generator) if skill else [env.chosen for env in playing]
            for number, env, primitive in zip(numbers, playing, acts, strict=True):
                seen[number].append(env.observation)
                done[number].append(primitive)
                env.advance(primitive)
        for number, (env, observation, action) in enumerate(zip(self.envs, before, chosen, strict=True)):
            after, reward, terminated, truncated, info = env.finish()
            facts = {"discounts": info["discount"], "dones": float(terminated), "rewards": reward}
            steps = {"step_observations": seen[number], "step_actions": done[number], "steps": len(done[number])}
            replay.add(observations=observation, actions=action, next_observations=after, **facts, **steps)
            self._note(number, info)
            if terminated or truncated:
                self.finished.append((self.returns[number], float(self.success[number]), float(self.steps)))
                self._begin(number)

    def _note(self, number: int, info: dict[str, Any]) -> None:
        self.steps += info["steps"]
        self.decisions += 1
        self.returns[number] += info["env_return"]
        self.success[number] |= info["success"]
        if self.cell_of is not None and "positions" in info:
            rows, columns = self.cell_of(info["positions"][: info["steps"]]).T
            np.add.at(self.visits, (rows, columns), 1)

    def _begin(self, number: int) -> None:
        words = np.random.SeedSequence([self.seed, number, self.begun[number]]).generate_state(1)
        self.envs[number].reset(seed=int(words[0] >> 1))
        self.begun[number] += 1
        self.returns[number], self.success[number] = 0.0, False

    def summary(self) -> dict[str, float]:
        """Steps and episodes so far, and the mean return and success (per cent) of the latest episodes."""
        values = {"env_steps": float(self.steps), "episodes": float(sum(self.begun) - len(self.envs))}
        if self.finished:
            latest = np.array(self.finished)
            values |= {"return": latest[:, 0].mean(), "success": 100.0 * latest[:, 1].mean()}
        if self.visits.size:
            values["cells"] = float((self.visits > 0).sum())
        return values

    def close(self) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()

    def state_dict(self) -> dict[str, Any]:
        """Everything that a training that continues needs to collect the same transitions."""
        return {
            "envs": [env.state_dict() for env in self.envs] if self._started else [],
            "generator": self.generator.get_state(),
            "steps": self.steps,
            "decisions": self.decisions,
            "begun": list(self.begun),
            "returns": list(self.returns),
            "success": list(self.success),
            "finished": [list(row) for row in self.finished],
            "visits": torch.from_numpy(self.visits.copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken; episodes in progress are played again up to there.

        Raises:
            UserError: It is of another number of environments, of another map, or damaged.
        """
        counts = {name: len(state[name]) for name in ("begun", "returns", "success", *(["envs"] * bool(state["envs"])))}
        for name, count in counts.items():
            if count != len(self.envs):
                raise UserError(
                    f"data.num_envs is {len(self.envs)}, but the checkpoint has {name} of {count} environments: give "
                    "the same number, or an earlier checkpoint if this one is damaged"
                )
        if (shape := tuple(state["visits"].shape)) != self.visits.shape:
            raise UserError(
                f"the checkpoint's map of visits has {shape} cells, the task's maze {self.visits.shape}: give that "
                "task, or an earlier checkpoint if this one is damaged"
            )
        self._started = bool(state["envs"])
        for env, own in zip(self.envs, state["envs"], strict=bool(state["envs"])):
            env.load_state_dict(own)
        self.generator.set_state(state["generator"])
        self.steps, self.decisions = state["steps"], state["decisions"]
        self.begun, self.returns, self.success = list(state["begun"]), list(state["returns"]), list(state["success"])
        self.finished = deque((tuple(row) for row in state["finished"]), maxlen=LATEST)
        self.visits = state["visits"].numpy().copy()
