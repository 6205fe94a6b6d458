"""`dds record`: episodes of an agent as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dds_lightning.agent import DDSAgent
from dds_lightning.console.reports import Report, table
from dds_lightning.errors import UserError, lacks_extra
from dds_lightning.interpret.draw.video import SUFFIXES, Footage, episode_pictures, write_video
from dds_lightning.rollout.result import RolloutPath
from dds_lightning.rollout.schedule import episode_seed
from dds_lightning.study.contestants import agent_directory
from dds_lightning.study.evaluate import refuse_other_task
from dds_lightning.study.loose import loose_task
from dds_lightning.tasks import Task
from dds_lightning.tasks.env import open_env


def record(
    place: Path, out: Path, *, episodes: int = 1, task: str | None = None, seed: int = 0, **acting: Any
) -> Report:
    """Play and show episodes; arguments and JSON keys are those of `dds record`.

    Raises:
        UserError: There is no agent, it does not fit the task, or a setting cannot work.
    """
    if out.suffix not in SUFFIXES:
        raise UserError(f"--out is {out}, expected a name that ends in {' or '.join(SUFFIXES)}")
    if episodes < 1:
        raise UserError(f"--episodes is {episodes}, expected at least 1")
    source = agent_directory(place)
    wanted = loose_task(task, str(source))
    if wanted is None:
        raise UserError(f"{source} does not say which task it is for: give --task; `dds tasks` lists them")
    agent = DDSAgent.load(source, seed=seed, **acting)
    refuse_other_task(agent, source, wanted)
    footage, rows = play_footage(agent, wanted, episodes, seed)
    pictures, fps, how = episode_pictures(wanted, footage)
    path = write_video(out, pictures, fps)
    shown = pd.DataFrame(rows)
    lines: list[Any] = [table(shown), f"{len(pictures)} pictures, {how}, in {path}"]
    if how == "drawn":
        lines.append("drawn, not rendered: where a graphics driver is, MUJOCO_GL=egl, osmesa or glfw names it")
    if path != out:
        lines.append(str(lacks_extra("nothing encodes MP4 here", "video")))
    return Report({"file": path, "task": wanted.name, "seed": seed, "pictures": how, "results": shown}, lines)


def play_footage(agent: DDSAgent, task: Task, episodes: int, seed: int) -> tuple[list[Footage], list[dict[str, Any]]]:
    """Play one episode after the other, with the environment seeds of `dds evaluate`."""
    footage, rows = [], []
    with open_env(task) as env:
        data = getattr(env.unwrapped, "data", None)
        for number in range(episodes):
            observation, info = env.reset(seed=episode_seed(seed, number))
            agent.reset(1, seed=episode_seed(seed, number))
            positions, codes, qpos = [info.get("position", (np.nan, np.nan))], [], []
            total, success, over = 0.0, False, False
            while not over:
                qpos += [] if data is None else [data.qpos.copy()]
                observation, reward, terminated, truncated, info = env.step(agent.act(observation))
                positions.append(info.get("position", (np.nan, np.nan)))
                codes.append(int(agent.codes[0]) if agent.discrete else -1)
                total, success, over = total + float(reward), success or info["success"], terminated or truncated
            qpos += [] if data is None else [data.qpos.copy()]
            path = RolloutPath(np.array(positions, np.float32), np.array(codes, np.int16))
            row = {
                "episode": number,
                "return": total,
                "score": float(task.normalised_score(total)),
                "steps": len(codes),
            }
            rows.append({**row, "success": success} if task.measures_success else row)
            end = "goal reached" if success else f"score {row['score']:.0f}"
            title = f"{task.name}, episode {number}: {end}"
            footage.append(Footage(path, np.array(qpos) if qpos else None, title))
    return footage, rows
