"""The agent: a skill every H steps, an action every step (section 4.4).

```
 observations (E, O) ─► policy ─► codes (E,)   at each environment's own reset, then every H of its steps
             └────────► decoder(z_code, s) ─► actions (E, A)                                    every step
```
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from dds_lightning.envs.flatten import numbers
from dds_lightning.errors import UserError
from dds_lightning.saving.fingerprint import cure_of_old, same, told_apart
from dds_lightning.saving.golden import golden_answers

if TYPE_CHECKING:
    from dds_lightning.online.parts import RawActions
    from dds_lightning.online.sac import SACModule
    from dds_lightning.policy import PolicyModule
    from dds_lightning.skill import SkillModule

AgentSelection = Literal["sample", "greedy", "argmax_q", "random", "fixed"]


class DDSAgent(nn.Module):
    """A skill model and a policy that act together.

    ```python
    agent = DDSAgent.load("checkpoints/pointmaze-large")
    agent.reset(num_envs=1, seed=0)
    action = agent.act(observation)  # in the environment's units, inside its box
    ```

    The same seed gives the same actions: the agent has its own random stream. Networks are put in evaluation mode and
    used where they are; nothing is copied.

    Args:
        skill: Decoder and skills, discrete or continuous; `RawActions` for an agent without.
        policy: Chooses skills; None for an agent whose `selection` is `random` or `fixed`.
        selection: `sample` from the policy, `greedy` its likeliest code, `argmax_q` the critic's best
            supported code, `random` any code with equal chance, `fixed` the codes of `fixed_codes`.
        temperature: Divides the policy's logits before sampling.
        noise_scale: Factor on the decoder's noise; None takes the skill model's setting.
        fixed_codes: With `fixed`, environment e plays code `fixed_codes[e % len(fixed_codes)]`.
        seed: Seed of the random stream until `reset` is given one.
        hold: Steps for which a skill is held before the next is chosen; None: for H steps, as it was learnt.

    Raises:
        UserError: The parts do not fit each other, or a setting is outside its range.
    """

    def __init__(
        self,
        skill: SkillModule | RawActions,
        policy: PolicyModule | SACModule | None = None,
        selection: AgentSelection = "sample",
        temperature: float = 1.0,
        noise_scale: float | None = None,
        fixed_codes: ArrayLike | None = None,
        seed: int = 0,
        hold: int | None = None,
    ) -> None:
        super().__init__()
        self.skill: SkillModule = skill  # type: ignore[assignment]  # what shows codes asks for the kinds it can show
        self.policy: PolicyModule | None = policy  # type: ignore[assignment]
        self.discrete = bool(getattr(skill, "discrete", True))
        self.selection, self.temperature = selection, float(temperature)
        self._noise_scale = noise_scale
        self.horizon = int(skill.horizon)
        self.num_skills = int(skill.num_skills) if self.discrete else 0
        self.hold = self.horizon if hold is None else int(hold)
        self.observation_dim = int(skill.hparams["observation_dim"])
        self.action_dim = int(skill.hparams["action_dim"])
        self.fixed_codes = None if fixed_codes is None else np.asarray(fixed_codes, dtype=np.int64)
        self._refuse_settings()
        self._refuse_strangers()
        self.eval()
        self._seed = int(seed)
        self._generator: torch.Generator | None = None
        self._begin(0)

    def _refuse_settings(self) -> None:
        choices, codes, last = get_args(AgentSelection), self.fixed_codes, self.num_skills - 1
        if not self.discrete and self.selection in ("fixed", "argmax_q"):
            raise UserError(f"selection is '{self.selection}', which needs codes, but the skills are continuous")
        if self.selection not in choices:
            raise UserError(f"selection is '{self.selection}', expected one of {', '.join(choices)}")
        if not 0 < self.temperature < np.inf:
            raise UserError(f"temperature is {self.temperature}, expected more than 0 ('greedy' is the limit)")
        if self._noise_scale is not None and not 0 <= self._noise_scale < np.inf:
            raise UserError(f"noise_scale is {self._noise_scale}, expected 0 or more")
        if not 1 <= self.hold <= self.horizon:
            raise UserError(f"hold is {self.hold}, expected 1 to {self.horizon}, the steps that these skills last")
        if self.policy is None and self.selection not in ("random", "fixed"):
            raise UserError(f"selection '{self.selection}' needs a policy; use 'random' or 'fixed' without")
        if (self.selection == "fixed") != (codes is not None):
            raise UserError(f"selection is '{self.selection}' and fixed_codes is {codes}: give both or none")
        if codes is not None and (codes.ndim != 1 or not len(codes) or codes.min() < 0 or codes.max() > last):
            raise UserError(f"fixed_codes is {codes}, expected a list of codes of 0 to {last}")

    def _refuse_strangers(self) -> None:
        """Refuse a policy that was not trained on these skills."""
        if self.policy is None:
            return
        theirs: Any = {"num_skills": getattr(self.policy, "num_skills", None), **self.policy.hparams}
        for name in ("num_skills", "observation_dim"):
            if (mine := getattr(self, name)) != theirs[name]:
                raise UserError(
                    f"{name} is {mine} in the skill model and {theirs[name]} in the policy: they do not belong together"
                )
        learnt_with = getattr(self.policy, "skill_hash", None)
        if learnt_with and not same(learnt_with, found := self.skill.fingerprint(), self.policy.OF_DECODER):
            there, here = told_apart(learnt_with, found)
            raise UserError(
                f"the policy was trained on the codes of skill model {there}, this one is {here}: they do not "
                "belong together; give the skills that it was trained with, or train a policy on these with "
                f"`dds policy fit --data.skill SKILL.ckpt`{cure_of_old(learnt_with, found, self.policy.OF_DECODER)}"
            )

    # ---------------------------------------------------------------- acting

    def variant(self, selection: AgentSelection | None = None, **settings: Any) -> DDSAgent:
        """Return an agent with other settings on the same networks, with its own clocks and random stream.

        Args:
            selection: As in the constructor; this agent's by default.
            **settings: `temperature`, `noise_scale`, `fixed_codes`, `seed`, `hold`, as in the constructor.
        """
        selection = selection or self.selection
        given: dict[str, Any] = {"temperature": self.temperature, "noise_scale": self._noise_scale, "seed": self._seed}
        given |= {"fixed_codes": self.fixed_codes if selection == "fixed" else None, "hold": self.hold}
        return DDSAgent(self.skill, self.policy, selection, **{**given, **settings})

    @property
    def noise_scale(self) -> float:
        """Factor on the decoder's noise: this agent's, or the skill model's where it was given none."""
        return float(self.skill.hparams["noise_scale"] if self._noise_scale is None else self._noise_scale)

    @property
    def num_envs(self) -> int:
        """Environments since the last reset."""
        return len(self._codes)

    @property
    def codes(self) -> NDArray[Any]:
        """(E,) code or (E, D) skill in use in each environment; 0 before the first act."""
        return self._codes.copy()

    @property
    def decided(self) -> NDArray[np.bool_]:
        """(E,) whether the last act chose a new skill there."""
        return self._decided.copy()

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.parameters()).device

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Restart all clocks.

        Args:
            num_envs: E.
            seed: Seed of the random stream; by default the stream continues, as in gymnasium.
        """
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}, expected at least 1")
        if seed is not None:
            self._seed, self._generator = int(seed), None
        self._begin(num_envs)

    def _begin(self, count: int) -> None:
        width = () if self.discrete else (int(self.skill.hparams["skill_dim"]),)
        self._codes: NDArray[Any] = np.zeros((count, *width), np.float32 if width else np.int64)  # code or skill in use
        self._clock = np.zeros(count, dtype=np.int64)  # (E,) steps until the next choice
        self._decided = np.zeros(count, dtype=bool)  # (E,) whether the last act chose a new one

    @torch.inference_mode()
    def act(
        self,
        observations: ArrayLike,
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """Act once in every environment.

        Args:
            observations: (E, O), or (O,) for a single environment.
            restarted: (E,) environments whose episode has just begun: their skill clock restarts. Not
                needed right after `reset`.
            rows: The environments that `observations` belong to, ascending, when some are left out.

        Returns:
            (E, A) float32, or (A,) for a single environment; the environment's units, inside its box.

        Raises:
            UserError: Shapes do not fit, or observations are no finite numbers.
        """
        batch = numbers(observations)
        single, x = batch.ndim == 1, self.observe(np.atleast_2d(batch))
        if not self.num_envs:
            self.reset(len(x) if rows is None else int(np.max(rows)) + 1)
        rows = np.arange(self.num_envs) if rows is None else np.asarray(rows)
        if len(x) != len(rows):
            raise UserError(f"{len(x)} observations for {len(rows)} environments: reset({len(x)}) first")
        if restarted is not None and np.shape(restarted) != rows.shape:
            raise UserError(f"restarted is {np.shape(restarted)}, expected ({len(rows)},)")
        actions = self.decode(x, self.choose(x, restarted, rows))
        return actions[0] if single else actions

    def observe(self, observations: NDArray[np.float32]) -> Tensor:
        """Move observations (n, O) to the networks' device.

        Raises:
            UserError: They have another shape, or are not finite.
        """
        observations = numbers(observations)
        if observations.ndim != 2 or observations.shape[1] != self.observation_dim:
            told = f"observations are {observations.shape}, expected (environments, {self.observation_dim})"
            raise UserError(f"{told}: this agent was trained on another environment, or the observations are not flat")
        return torch.from_numpy(np.ascontiguousarray(observations)).to(self.device)

    def choose(self, observations: Tensor, restarted: NDArray[np.bool_] | None, rows: NDArray[np.intp]) -> NDArray[Any]:
        """Advance the clocks of `rows`, with a new choice where one has run out: (n, O) to codes (n,) or skills."""
        if restarted is not None:
            self._clock[rows[restarted]] = 0
        due = self._clock[rows] == 0  # (n,)
        self._decided[:] = False
        if due.any():
            late = rows[due]
            chosen = observations if due.all() else observations[torch.from_numpy(due).to(observations.device)]
            self._codes[late] = self._pick(chosen, late)
            self._clock[late], self._decided[late] = self.hold, True
        self._clock[rows] -= 1
        return self._codes[rows]

    def _pick(self, observations: Tensor, rows: NDArray[np.intp]) -> NDArray[Any]:
        """Codes (m,) or skills (m, D) for the m environments whose skill has run out."""
        if self.fixed_codes is not None:
            return self.fixed_codes[rows % len(self.fixed_codes)]
        stream = self.generator()
        if self.selection == "random" and self.discrete:
            chosen = torch.randint(self.num_skills, (len(rows),), generator=stream, device=stream.device)
        elif self.selection == "random":  # from the prior of continuous skills
            chosen = torch.randn(len(rows), self._codes.shape[1], generator=stream, device=stream.device)
        else:
            assert self.policy is not None
            self.policy.eval() if self.policy.training else None
            choose: Any = getattr(self.policy, "codes" if self.discrete else "choose")
            chosen = choose(observations, self.selection, self.temperature, stream)
        return chosen.cpu().numpy()

    def decode(self, observations: Tensor, codes: NDArray[Any]) -> NDArray[np.float32]:
        """Actions (n, A) of codes (n,) or skills (n, D) in observations (n, O)."""
        self.skill.eval() if self.skill.training else None
        index = torch.from_numpy(codes).to(observations.device)
        actions = self.skill.decode(observations, index, self.noise_scale, self.generator())
        return actions.float().cpu().numpy()

    def generator(self) -> torch.Generator:
        """The agent's random stream, on the networks' device."""
        if self._generator is None or self._generator.device.type != self.device.type:
            self._generator = torch.Generator(self.device).manual_seed(self._seed)
        return self._generator

    @property
    def group_key(self) -> tuple[int, float | None]:
        """Agents with equal keys can act in one decoder batch, see `actors.AgentGroup`."""
        return id(self.skill), self._noise_scale

    # ---------------------------------------------------------------- files

    def golden(self) -> dict[str, list[list[float]]]:
        """Answers of the networks to fixed questions, see `saving.golden`."""
        return golden_answers(self.skill, self.policy)

    def save(
        self,
        directory: str | Path,
        *,
        metrics: dict[str, Any] | None = None,
        card: str | None = None,
        **about: Any,
    ) -> Path:
        """Publish the agent as a directory that `load` reads, atomically.

        Args:
            directory: Where to write; an earlier published directory there is replaced.
            metrics: Scores to keep beside the weights.
            card: Text of README.md; a short one by default.
            **about: Plain facts for config.yaml, for example `task="pointmaze-large-diverse"`.

        Returns:
            The directory.

        Raises:
            UserError: The directory holds something that was not published.
        """
        from dds_lightning.saving.published import publish

        modules: Any = {part.STAGE: part for part in self.children() if hasattr(part, "STAGE")}  # not of raw actions
        acting = {"selection": self.selection, "temperature": self.temperature, "noise_scale": self._noise_scale}
        acting["fixed_codes"] = None if self.fixed_codes is None else self.fixed_codes.tolist()
        acting |= {} if self.hold == self.horizon else {"hold": self.hold}
        return publish(directory, modules, {**about, "agent": acting, "golden": self.golden()}, metrics, card)

    @classmethod
    def load(cls, directory: str | Path, **settings: Any) -> Self:
        """Load a published agent, without its data set, on the CPU.

        Args:
            directory: As written by `save` or `dds run`, or `hf:OWNER/NAME` on the Hub.
            **settings: Override `selection`, `temperature`, `noise_scale`, `fixed_codes`, `seed`, `hold`.

        Raises:
            UserError: Files are missing, changed, of a newer version, or do not fit; the message names them.
        """
        from dds_lightning.online.parts import published_parts
        from dds_lightning.saving.hub import is_hub, pull
        from dds_lightning.saving.published import load_published

        directory = pull(str(directory)) if is_hub(directory) else directory
        published = load_published(directory)
        skill, policy = published_parts(published)
        acting = {**published.acting(), **settings}
        if acting["selection"] != "fixed":
            acting.pop("fixed_codes", None)
        try:
            return cls(skill, policy, **acting)
        except TypeError as error:
            raise UserError(f"{directory}: an agent setting that this version does not know: {error}") from None
        except UserError as error:
            raise error if settings else UserError(f"{directory}: {error}") from None  # the caller's may be to blame
