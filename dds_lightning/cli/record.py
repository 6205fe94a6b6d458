"""The command `dds record`: the signature is the command line, the docstring the help."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from dds_lightning.console.reports import Report
from dds_lightning.saving.places import is_hub, refuse_no_folder


def record(
    agent: str,
    episodes: int = 1,
    out: str | None = None,
    task: str | None = None,
    selection: Literal["sample", "greedy", "argmax_q", "random"] | None = None,
    temperature: float | None = None,
    noise_scale: float | None = None,
    seed: int = 0,
) -> Report:
    """Record episodes of an agent as a video.

    MuJoCo renders them where a graphics driver works; otherwise mazes are drawn from above, and bodies as stick
    figures. Without an encoder for MP4 the video is a GIF.

    With --json: `file`, `task`, `seed`, `pictures` (rendered or drawn) and `results`, a row for each episode.

    Args:
        agent: A run of `dds run`, a published directory, or hf:OWNER/NAME.
        episodes: Episodes to play, one after the other.
        out: The file, which ends in .mp4 or .gif; without it NAME.mp4 in the current folder.
        task: Name of the task; without it the one the agent was made for.
        selection: How skills are chosen; without it as the agent does.
        temperature: Temperature of `sample`; without it the agent's.
        noise_scale: Factor on the decoder's noise; without it the agent's.
        seed: Seed of the environments and of the agent.
    """
    if not is_hub(agent):
        refuse_no_folder(agent)
    from dds_lightning.saving.hub import pull
    from dds_lightning.study.record import record as make

    place = pull(agent) if is_hub(agent) else Path(agent)
    name = Path(agent.removeprefix("hf:")).resolve().name
    chosen = {"selection": selection, "temperature": temperature, "noise_scale": noise_scale}
    acting = {key: value for key, value in chosen.items() if value is not None}
    return make(place, Path(out or f"{name}.mp4"), episodes=episodes, task=task, seed=seed, **acting)
