"""An environment whose action is a skill: it plays the skill to its end and counts as one step.

```
 action k or z ─► decoder(z, s) ─► a ─► env ─┐   H times, or until the episode ends
                        └────── s ◄──────────┘
 reward: sum of gamma^i r_i      info: steps taken, discount of the bootstrap, the environment's own return
```
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, get_args

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from dds_lightning.envs.semi_mdp import Discount, fold
from dds_lightning.errors import UserError

if TYPE_CHECKING:
    from dds_lightning.skill import SkillModule

BOUND = 2.5
"""Half the width of the box of continuous skills: 99 % of PointMaze's segments have theirs within 2.6."""
START, WHOLE = np.zeros(1, np.int64), 2**31


class SkillEnv(gym.Wrapper[NDArray[np.float32], Any, NDArray[np.float32], Any], gym.utils.RecordConstructorArgs):
    """Any environment with flat observations, acted on by skills.

    The action is a code (`Discrete(K)`) where skills are discrete, a skill vector (`Box` of D numbers) where they
    are continuous, and the environment's own without a skill model. A reward is the same fold as in relabelled data.

    `info` has what the environment says after the last step, and `steps` (h, fewer than H where the episode ended
    inside the skill), `discount` (factor on the bootstrap), `env_return` (sum of the environment's rewards), `success`
    (whether any step said so) and, where the environment tells its position, `positions` (H, 2), NaN
    after the last step.

    The same seed and the same actions give the same episode: the decoder's noise has its own stream.

    Args:
        env: The environment; its spaces must be those that the skills were trained in.
        skill: The skill model; None passes the environment's actions through, one step each.
        gamma: Discount of a step.
        discount: How the bootstrap is discounted, see `envs.semi_mdp`.
        reward_scale: The reward of a step is ``reward_scale * (reward + reward_shift)``.
        reward_shift: See `reward_scale`.
        noise_scale: Factor on the decoder's noise; None takes the skill model's setting.
        bound: The box of continuous skills reaches from -bound to bound.

    Raises:
        UserError: Environment and skill model do not fit each other, or a setting is outside its range.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        skill: SkillModule | None = None,
        *,
        gamma: float = 0.99,
        discount: Discount = "per_skill",
        reward_scale: float = 1.0,
        reward_shift: float = 0.0,
        noise_scale: float | None = None,
        bound: float = BOUND,
    ) -> None:
        """Check that everything fits."""
        gym.utils.RecordConstructorArgs.__init__(
            self,
            _disable_deepcopy=True,  # the copies that `spec.make()` builds share the skill model
            skill=skill,
            gamma=gamma,
            discount=discount,
            reward_scale=reward_scale,
            reward_shift=reward_shift,
            noise_scale=noise_scale,
            bound=bound,
        )
        gym.Wrapper.__init__(self, env)
        for name, fine, value, expected in (
            ("gamma", 0 < gamma <= 1, gamma, "a discount in (0, 1]"),
            ("discount", discount in get_args(Discount), discount, " or ".join(get_args(Discount))),
            ("noise_scale", noise_scale is None or noise_scale >= 0, noise_scale, "None or 0 or more"),
            ("bound", bound > 0, bound, "positive"),
        ):
            if not fine:
                raise UserError(f"{name} is {value}, expected {expected}")
        self.skill = None if skill is None else skill.eval()
        self.horizon = 1 if skill is None else int(skill.horizon)
        self.gamma, self.discount, self.noise_scale = gamma, discount, noise_scale
        self.reward_scale, self.reward_shift = reward_scale, reward_shift
        self._generator = torch.Generator().manual_seed(0)
        self._seeds = np.random.default_rng()
        self._episode_seed = 0
        self._taken: list[Any] = []  # actions of the episode in progress
        self._observation: Any = None
        if skill is None:
            return
        _refuse_misfit(env, skill)
        if skill.discrete:
            self.action_space = gym.spaces.Discrete(int(skill.num_skills))
        else:
            self.action_space = gym.spaces.Box(-bound, bound, (int(skill.hparams["skill_dim"]),), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; without a seed, the next one of this environment's own stream."""
        if seed is not None:
            self._seeds = np.random.default_rng(seed)
        self._episode_seed = int(self._seeds.integers(WHOLE)) if seed is None else int(seed)
        self._generator.manual_seed(self._episode_seed)
        self._taken = []
        self._observation, info = self.env.reset(seed=self._episode_seed, options=options)
        return self._observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play one skill to its end, or to the end of the episode."""
        self.begin(action)
        while not self.over:
            self.advance(decode(self.skill, [self], self._generator)[0] if self.skill is not None else action)
        return self.finish()

    # ---------------------------------------------------------------- a skill step by step, for a batch of environments

    def begin(self, action: Any) -> None:
        """Start a skill; `advance` plays its steps and `finish` gives what `step` returns.

        Raises:
            UserError: It is no skill of the model, or no episode has begun.
        """
        if self._observation is None:
            raise UserError("no episode has begun: call reset() before the first skill")
        self.chosen = action if self.skill is None else _refuse_no_skill(action, self.action_space)
        self.over = False
        self._rewards: list[float] = []
        self._positions: list[Any] = []
        self._success = False

    def advance(self, primitive: Any) -> None:
        """Take one step of the skill that was begun."""
        self._observation, reward, terminated, truncated, info = self.env.step(primitive)
        self._taken.append(primitive)
        self._rewards.append(float(reward))
        self._success = self._success or bool(info.get("success", False))
        if "position" in info:
            self._positions.append(info["position"])
        self._ended, self._info = (bool(terminated), bool(truncated)), info
        self.over = any(self._ended) or len(self._rewards) == self.horizon

    def finish(self) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fold the steps of the skill into one."""
        steps = len(self._rewards)
        learning = self.reward_scale * (np.asarray(self._rewards) + self.reward_shift)  # (h,)
        (folded,), (factor,) = fold(learning, START, np.array([steps]), self.gamma, self.discount)
        info = {**self._info, "steps": steps, "discount": float(factor)}
        info |= {"env_return": sum(self._rewards), "success": self._success}
        if self._positions:  # always H rows, because `gymnasium.vector` stacks the arrays of its environments
            unplayed = [np.full_like(self._positions[0], np.nan, np.float64)] * (self.horizon - len(self._positions))
            info["positions"] = np.asarray([*self._positions, *unplayed])
        return self._observation, float(folded), *self._ended, info

    @property
    def observation(self) -> Any:
        """What the environment showed last."""
        return self._observation

    # ---------------------------------------------------------------- taking up an episode again

    def state_dict(self) -> dict[str, Any]:
        """The episode in progress, as plain values and tensors: its seed, what was done, and the random streams.

        Actions stand in for the simulator's state, which not every environment can save: the same seed and actions
        lead to the same state.
        """
        return {
            "seed": self._episode_seed,
            "taken": torch.as_tensor(np.asarray(self._taken)),  # (t, A)
            "observation": torch.as_tensor(np.asarray(self._observation)),
            "decoder": self._generator.get_state(),
            "seeds": _plain(self._seeds.bit_generator.state),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Play the episode again up to where `state_dict` was taken.

        Raises:
            UserError: The environment did not come to the same state.
        """
        observation, _ = self.env.reset(seed=state["seed"])
        self._episode_seed, self._taken = state["seed"], list(state["taken"].numpy())
        for taken in self._taken:
            observation = self.env.step(taken)[0]
        if not np.array_equal(observation, state["observation"].numpy()):
            raise UserError(
                f"the episode of seed {state['seed']} did not come back to its state after {len(self._taken)} steps: "
                "it is not the environment of the checkpoint, or the same seed does not give the same episode there"
            )
        self._observation = observation
        self._generator.set_state(state["decoder"])
        self._seeds.bit_generator.state = state["seeds"]


def _refuse_no_skill(action: Any, space: gym.Space[Any]) -> NDArray[Any]:
    """The action as an array, a code () or a skill vector (D,), if it is one of the space."""
    found = np.asarray(action)
    if isinstance(space, gym.spaces.Discrete):
        if found.shape or found.dtype.kind not in "iu" or not 0 <= found < space.n:
            raise UserError(f"the action is {action}, expected a code from 0 to {space.n - 1}, an integer")
    elif found.shape != space.shape or found.dtype.kind not in "iuf" or not np.isfinite(found).all():
        raise UserError(f"the action is {action}, expected a skill vector of {space.shape[0]} finite numbers")  # type: ignore[index]
    return found


@torch.inference_mode()
def decode(skill: Any, envs: Sequence[SkillEnv], generator: torch.Generator) -> NDArray[np.float32]:
    """The next actions (n, A) of the skills that n environments are playing, as one batch.

    Args:
        skill: The skill model of all of them.
        envs: In the middle of a skill.
        generator: Of the decoder's noise.
    """
    there = skill.device
    observations = torch.from_numpy(np.stack([env.observation for env in envs]).astype(np.float32)).to(there)
    chosen = torch.from_numpy(np.stack([env.chosen for env in envs])).to(there)
    skills = chosen.long() if skill.discrete else chosen.float()
    return skill.decode(observations, skills, envs[0].noise_scale, generator).cpu().numpy()


def _refuse_misfit(env: gym.Env[Any, Any], skill: SkillModule) -> None:
    """Refuse an environment that is not of the skill model's robot, or whose episodes are shorter than a skill."""
    name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
    width, number = int(skill.hparams["observation_dim"]), int(skill.hparams["action_dim"])
    seen, acts = env.observation_space, env.action_space
    if not isinstance(seen, gym.spaces.Box) or len(seen.shape) != 1:
        raise UserError(
            f"the observations of {name} are {seen}, expected a flat Box: wrap it in FlattenObservation, or take the "
            "environment of a task"
        )
    if seen.shape != (width,):
        raise UserError(
            f"the skill model has observation_dim {width}, {name} has {seen.shape[0]}: it was trained on another "
            "robot; give a skill model of this one"
        )
    if not isinstance(acts, gym.spaces.Box) or acts.shape != (number,):
        raise UserError(f"the skill model acts with {number} numbers, {name} takes {acts}: give a skill model for it")
    for bound, own, trained in (("low", acts.low, skill.action_box.low), ("high", acts.high, skill.action_box.high)):
        if not np.allclose(own, trained.cpu().numpy()):
            raise UserError(
                f"the actions of {name} have {bound} bounds {own.tolist()}, the skill model's have {trained.tolist()}: "
                "rescale the environment's actions (RescaleAction), or train skills for it"
            )
    longest = None if env.spec is None else env.spec.max_episode_steps
    if longest is not None and skill.horizon > longest:
        raise UserError(
            f"a skill lasts {skill.horizon} steps, an episode of {name} at most {longest}: take skills with a shorter "
            "horizon, or longer episodes"
        )


def _plain(state: Any) -> Any:
    """The state of a NumPy stream with plain values only, for checkpoints that run no code."""
    if isinstance(state, dict):
        return {name: _plain(value) for name, value in state.items()}
    return state if isinstance(state, str) else int(state)
